"""Records of bags that an older version wrote, as this version has them."""

from dataclasses import replace
from typing import TypeVar

from codetr_ros.records import PROTOCOL_VERSION, Commit, Record, RunSpec, TaskSpec
from codetr_ros.records.chain import Chain, states_digests

RecordT = TypeVar('RecordT', bound=Record)


def as_now(record: RecordT) -> RecordT:
    """The same record, announced in the protocol of this version.

    What an older version left out has its default already, and no meaning has changed since.
    """
    if isinstance(record, (RunSpec, TaskSpec)) and record.protocol_version < PROTOCOL_VERSION:
        return replace(record, protocol_version=PROTOCOL_VERSION)
    return record


class AsNow:
    """Makes the records of a run what this version would have recorded of it: commits without
    digests, of protocol 1, get those of what the bag has. Of other bags, nothing is computed.

    Args:
        lag: phases from the one learnt from to the first that acts by it; None: commits name no
            labels.
    """

    def __init__(self, lag: int | None) -> None:
        self._lag = lag
        self._chain: Chain | None = None

    def __call__(self, record: Record) -> Record:
        """The next record, in the order in which the run can have had them: an announcement, which
        states the protocol, before all else.
        """
        now = as_now(record)
        if now is not record and self._chain is None:
            self._chain = Chain(self._lag)
        if self._chain is None:
            return now
        if not isinstance(now, Commit):
            self._chain.note(now)
            return now
        if not states_digests(now):
            now = self._chain.completed(now)
        self._chain.follow(now)
        return now
