"""What a node has published lately, to be sent again to whom it did not reach."""

from collections.abc import Collection, Iterator

from codetr_ros.config import Settings
from codetr_ros.records import Presence, Record, RunSpec, StepRewards, TaskSpec
from codetr_ros.records.fields import type_name
from codetr_ros.records.identity import identity, phase_of

KEPT_PHASES = 6
"""Phases, beside those that may be under way, of which a node keeps what it has published: as far
as a learner may go back whose newest checkpoints are damaged."""
NOT_KEPT = (Presence, RunSpec)
"""Published again and again, or by other means."""
LABELS = type_name(StepRewards)

Published = tuple[Record, int]
"""A record, and when it was published [ns]."""


class Outbox:
    """Records that a node has published, by phase; of the newest phases only.

    Nobody publishes for a phase that was not permitted, and the learner permits one only when
    those that lie `lag` behind are committed. So a few phases more than `lag` cover all that any
    reader can lack, however long nothing has reached it. What the evaluator publishes, which
    nobody waits for, is small, and all of it is kept. So is what a source announces.

    Args:
        phase_steps: environment steps of a phase.
        phases: how many are kept; None: all.
    """

    def __init__(self, phase_steps: int, phases: int | None) -> None:
        self._phase_steps = phase_steps
        self._most = phases
        self._phases: dict[int, dict[object, Published]] = {}
        self._announced: dict[object, Published] = {}
        self._phase = 0  # of the last record that named one
        self._asked = -1  # the newest phase of which a reader has asked for the labels alone

    @classmethod
    def of(cls, role: str, settings: Settings) -> 'Outbox':
        """That of a role.

        Args:
            role: one of `records.ROLES`.
            settings: those of the run.
        """
        phases = None if role == 'evaluate' else settings.ahead + KEPT_PHASES
        return cls(settings.phase_steps, phases)

    @property
    def newest(self) -> int | None:
        """The newest phase of which something is kept; None if nothing is."""
        return max(self._phases, default=None)

    @property
    def owes(self) -> bool:
        """Whether one phase more would let go of labels that nobody has asked for. A learner that
        learns from phases again asks for those of one after the other.
        """
        if self._most is None or len(self._phases) < self._most:
            return False
        oldest = min(self._phases)
        return oldest >= self._asked and any(
            isinstance(record, StepRewards) for record, _ in self._phases[oldest].values()
        )

    def keep(self, record: Record, stamp: int) -> None:
        """Keep a record that is published.

        Args:
            record: the record.
            stamp: when it is published [ns].
        """
        if isinstance(record, NOT_KEPT):
            return
        phase = phase_of(record, self._phase_steps)
        if phase is not None:
            self._phase = phase
        key = type(record), identity(record)
        if isinstance(record, TaskSpec):
            self._announced[key] = record, stamp
        self._phases.setdefault(self._phase, {})[key, stamp] = record, stamp
        while self._most is not None and len(self._phases) > self._most:
            del self._phases[min(self._phases)]

    def read(self, phase: int, kinds: Collection[str] = ()) -> Iterator[Published]:
        """The records of a phase, in the order in which they were published. Announcements, where
        they are named, come before them, whenever they were published. Of a phase between others
        there may be none: not every policy is evaluated.

        Args:
            phase: the phase.
            kinds: types of the messages that are wanted; empty: all.

        Raises:
            KeyError: it lies before or behind all phases of which something is kept; the message
                names these.
        """
        if list(kinds) == [LABELS]:
            self._asked = max(self._asked, phase)
        if not min(self._phases, default=phase + 1) <= phase <= max(self._phases, default=phase):
            held = ', '.join(map(str, sorted(self._phases))) or 'none yet'
            raise KeyError(f'nothing of phase {phase} is kept; of these is: {held}')
        of_phase = self._phases.get(phase, {}).values()
        of_all_time = self._announced.values() if kinds else ()
        return (
            (record, stamp)
            for record, stamp in dict.fromkeys((*of_all_time, *of_phase))
            if not kinds or type_name(type(record)) in kinds
        )
