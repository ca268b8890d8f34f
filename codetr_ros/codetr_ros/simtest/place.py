"""Where a node of a simulated run is: its run, its pace, and who brings its messages to others."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from codetr_ros.config import Settings
from codetr_ros.records import RunSpec
from codetr_ros.simtest.world import World

if TYPE_CHECKING:
    from codetr_ros.simtest.process import Process


@dataclass(frozen=True)
class Packet:
    """A message on its way.

    Attributes:
        kind: what it carries.
        number: one for each message, by which a second copy shows.
        data: CDR; a record as it is for presences, which are many.
        stamp: when a presence was published [ns].
    """

    kind: type
    number: int
    data: Any
    stamp: int = 0


class Mail(Protocol):
    """Brings what a node publishes to the others."""

    def publish(self, sender: 'Process', packet: Packet) -> None:
        """Send a message to everybody who reads its kind."""

    def send(self, sender: 'Process', reader: str, packet: Packet) -> None:
        """Send a request or an answer to one node."""


@dataclass
class Pace:
    """How quickly a node works.

    Attributes:
        begins: when it starts [s].
        slice_seconds: what a slice takes, on average [s].
        stalls: when it takes no turn: from when, for how long [s].
    """

    begins: float = 0.0
    slice_seconds: float = 0.02
    stalls: list[tuple[float, float]] = field(default_factory=list)

    def stalled_until(self, now: float) -> float | None:
        """The end of the stall that it is in [s]; None if it is in none."""
        ends = [begin + length for begin, length in self.stalls if begin <= now < begin + length]
        return max(ends, default=None)


@dataclass(frozen=True)
class Place:
    """Where a node is, and who it is.

    Attributes:
        world: the world.
        mail: brings what it publishes.
        run: the run.
        settings: its settings.
        role: one of `records.ROLES`.
        name: its name.
        pace: how quickly it works.
        deadline: how long it waits for others [s].
        instance: which start of the node this is: 1, 2, ...
    """

    world: World
    mail: Mail
    run: RunSpec
    settings: Settings
    role: str
    name: str
    pace: Pace
    deadline: float
    instance: int = 1
