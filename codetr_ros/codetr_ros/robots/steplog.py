"""Makes records of the steps of a robot, as they become whole.

The newest whole step is kept back until it is known whether the episode goes on: what ends an
episode of a robot (a stop, a silent sensor) is seen a step later, and the last step must carry it.
"""

from collections.abc import Callable, Iterable

import numpy as np

from codetr_ros.records import F32, MESSAGE_BYTES, Transitions

CHUNK_SECONDS = 1.0
"""Whole steps are published at the latest after so long: whoever scores waits for them."""


class StepLog:
    """The steps of one source, cut into records, phases and episodes.

    Args:
        run_id: of the records.
        source: their source.
        steps_of: the steps of a phase.
    """

    def __init__(self, run_id: str, source: str, steps_of: Callable[[int], int]) -> None:
        self._run_id = run_id
        self._source = source
        self._steps_of = steps_of
        self._steps: list[tuple[F32, F32]] = []  # whole and not given out: observation, action
        self._after: F32 = np.empty(0, np.float32)  # the observation after them
        self._sequence = 0
        self._written = 0  # steps of the episode that were given out
        self._taken = 0  # steps of the phase that were given out
        self._since = 0.0  # when the oldest of the steps became whole [s]
        self.phase = 0
        self.episode = -1
        self.total = 0  # whole steps of the run

    @property
    def length(self) -> int:
        """Whole steps of the episode."""
        return self._written + len(self._steps)

    @property
    def left(self) -> int:
        """Steps that the phase still lacks."""
        return self._steps_of(self.phase) - self._taken - len(self._steps)

    def restore(self, records: Iterable[Transitions]) -> None:
        """Go on behind records that a node before this one has given out, in their order.

        An episode that was under way is over: nobody saw how it went on.

        Args:
            records: of the last phase at the least.
        """
        for record in records:
            if record.phase != self.phase:
                self.phase, self._taken = record.phase, 0
            self._taken += record.steps
            self._sequence = record.sequence + 1
            self.episode = record.episode
            if record.phase_end:
                self.phase, self._taken = record.phase + 1, 0
        self.total = sum(map(self._steps_of, range(self.phase))) + self._taken

    def begin(self) -> None:
        """Begin an episode."""
        self.episode += 1
        self._written = 0

    def add(self, observation: F32, action: F32, after: F32, now: float) -> list[Transitions]:
        """Add a whole step; returns the records that are due.

        Args:
            observation: (O,) before it.
            action: (A,) as it was commanded.
            after: (O,) the observation after it.
            now: seconds.
        """
        if not self._steps:
            self._since = now
        self._steps.append((observation, action))
        self._after = after
        self.total += 1
        ready = len(self._steps) - 1
        due = self._steps_of(self.phase) - self._taken
        if ready >= due:
            return [self._give(due)]
        room = max(1, MESSAGE_BYTES // (4 * (len(observation) + len(action))) - 1)
        if ready and (now - self._since >= CHUNK_SECONDS or ready >= room):
            self._since = now
            return [self._give(ready)]
        return []

    def end(self, terminated: bool = False) -> list[Transitions]:
        """End the episode; returns its last record. One without a whole step never was.

        Args:
            terminated: whether it has ended in a terminal state; else it was cut off.
        """
        if self._steps:
            return [self._give(len(self._steps), terminated, not terminated)]
        self.episode -= 1
        return []

    def _give(self, count: int, terminated: bool = False, truncated: bool = False) -> Transitions:
        mine, self._steps = self._steps[:count], self._steps[count:]
        after = self._steps[0][0] if self._steps else self._after
        ends = self._taken + count == self._steps_of(self.phase)
        record = Transitions(
            run_id=self._run_id,
            source=self._source,
            sequence=self._sequence,
            phase=self.phase,
            episode=self.episode,
            first_step=self._written,
            steps=count,
            observations=np.stack([*(observation for observation, _ in mine), after]),
            actions=np.stack([action for _, action in mine]),
            terminated=terminated,
            truncated=truncated,
            phase_end=ends,
            scores_due=0,
        )
        self._sequence += 1
        self._written += count
        self._taken += count
        if ends:
            self.phase += 1
            self._taken = 0
        return record
