"""Messages as they lie in a bag, whatever its format."""

from collections.abc import Callable
from typing import NamedTuple

from codetr_ros.bags.errors import Damage, Place
from codetr_ros.bags.schemas import Definition

OnDamage = Callable[[Damage], None]
LIBRARY = 'codetr_ros'
"""What our recorder calls itself in a file."""


class Channel(NamedTuple):
    """A topic of a bag."""

    topic: str  # as the bag has it; `full_name` has the leading slash
    type: str  # such as codetr_msgs/msg/Transitions
    encoding: str  # of the messages, as declared: 'cdr' is the one that is read
    definition: Definition
    qos: str  # as YAML text, as the bag has it; may be empty
    numbered: bool = False  # its messages are numbered 0, 1, 2, ...: our recorder wrote them


class RawMessage(NamedTuple):
    """A message as it lies in a bag."""

    channel: Channel
    log_time: int  # [ns] when it was received
    publish_time: int  # [ns] the log time where the bag has none
    sequence: int  # as the file numbers it; 0 where it does not
    data: bytes | memoryview  # CDR; a view is valid until the next message is read
    place: Place
