"""Reward recovery over a run: do the labels of the day agree with the true step rewards?

An observer of a run in process, where true rewards and labels pass by in one place. Nothing comes
back from it: neither learner nor reward model can see what it sees.
"""

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import F32, I64, Record, StepRewards, TrueRewards


class _Source:
    """The newest steps of one source, in a ring: row r lies in slot r % capacity."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        # np.empty takes memory page by page as steps arrive, not at once
        self._true = np.empty(capacity, np.float32)
        self._labels = np.empty(capacity, np.float32)  # NaN: not labelled
        self._segments = np.empty(capacity, np.int64)  # row of the segment's first step
        self._rows = np.zeros(64, np.int64)  # by episode: the row of its first step
        self._end = 0

    def append(self, record: TrueRewards) -> None:
        """Steps that follow on those before."""
        if record.episode >= len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        if record.first_step == 0:
            self._rows[record.episode] = self._end
        rewards = record.rewards[-self._capacity :]
        self._end += len(record.rewards)
        slots = np.arange(self._end - len(rewards), self._end) % self._capacity
        self._true[slots] = rewards
        self._labels[slots] = np.nan

    def label(self, record: StepRewards) -> None:
        """Labels of segments; those of steps that are no longer held are left out.

        Steps are labelled with their whole segment the first time, and maybe some of them later.
        """
        lengths = record.lengths.astype(np.int64)
        firsts = self._rows[record.episodes] + record.first_steps
        segments = np.repeat(firsts, lengths)
        within = np.arange(len(segments)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        rows = segments + within
        held = rows >= self._end - self._capacity
        slots = rows[held] % self._capacity
        first = np.isnan(self._labels[slots])
        self._segments[slots[first]] = segments[held][first]
        self._labels[slots] = record.labels[held]

    def labelled(self) -> tuple[F32, F32, I64]:
        """Labels, true rewards and segments (T,) of the steps that have a label."""
        held = slice(min(self._end, self._capacity))
        there = ~np.isnan(self._labels[held])
        return self._labels[held][there], self._true[held][there], self._segments[held][there]


class Recovery:
    """Compares labels and true rewards whenever a policy is due for evaluation.

    What is compared are the newest labels of the newest `memory_steps` steps: what the policy
    learns from, but for steps that have no label yet. They take 16 bytes each.

    Args:
        settings: the run's settings.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._sources: dict[str, _Source] = {}
        self.rows: list[dict[str, float]] = []
        """For each evaluation with labels: `step`, `pearson`, `within` (Pearson after each
        segment's mean was taken from both), `spearman` (NaN where one side does not vary), and
        `steps`, how many were compared."""

    def receive(self, record: Record) -> None:
        """Take note of a record of the run, of whatever kind."""
        if isinstance(record, TrueRewards):
            if record.source not in self._sources:
                share = self._settings.memory_steps // self._settings.source_count
                self._sources[record.source] = _Source(max(1, share))
            self._sources[record.source].append(record)
        elif isinstance(record, StepRewards):
            if len(record.lengths):
                self._sources[record.source].label(record)
            if record.part == record.parts - 1 and self._settings.evaluated(record.phase):
                self._compare(self._settings.steps_after(record.phase))

    def _compare(self, step: int) -> None:
        from codetr_ros.recovery_metrics import flat_recovery  # scipy takes a second to import

        found = [source.labelled() for source in self._sources.values()]
        # the segments of several sources must not share a number
        far = np.int64(1) << 40
        labels, true = (np.concatenate([each[i] for each in found]) for i in (0, 1))
        segments = np.concatenate([each[2] + i * far for i, each in enumerate(found)])
        if len(labels):
            said = flat_recovery(labels, true, segments)
            self.rows.append(
                {
                    'step': step,
                    'pearson': said['pearson'],
                    'within': said['within_pearson'],
                    'spearman': said['spearman'],
                    'steps': len(labels),
                }
            )
