"""Records of bags that an older version wrote, as this version has them."""

from dataclasses import replace
from typing import TypeVar

from codetr_ros.records import PROTOCOL_VERSION, Record, RunSpec, TaskSpec

RecordT = TypeVar('RecordT', bound=Record)


def as_now(record: RecordT) -> RecordT:
    """The same record, announced in the protocol of this version.

    What an older version left out has its default already, and no meaning has changed since.
    """
    if isinstance(record, (RunSpec, TaskSpec)) and record.protocol_version < PROTOCOL_VERSION:
        return replace(record, protocol_version=PROTOCOL_VERSION)
    return record
