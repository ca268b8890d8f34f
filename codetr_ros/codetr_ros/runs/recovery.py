"""Reward recovery over a run: do the current labels agree with the true step rewards?

This observer follows a run in process while it goes on, and reads a run over topics from its bag.
Nothing flows back: neither learner nor reward model can see what it sees.

What is measured: docs/methods.md#reward-recovery.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from codetr_ros.config import Settings
from codetr_ros.records import F32, I64, CompositeReward, Record, StepRewards, TrueRewards
from codetr_ros.runs.segments import Segment, spread_evenly


class RecoveryError(ValueError):
    """Labels that cannot be compared, for want of true rewards: the message names their source."""


class _Source:
    """The newest steps of one source, in a ring: row r lies in slot r % capacity."""

    def __init__(self, name: str, capacity: int) -> None:
        self._name = name
        self._capacity = capacity
        self._episode, self._steps = -1, 0  # the newest episode, and its steps so far
        # np.empty takes memory page by page as steps arrive, not at once
        self._true = np.empty(capacity, np.float32)
        self._labels = np.empty(capacity, np.float32)  # NaN: not labelled
        self._versions = np.empty(capacity, np.uint32)  # of the model that labelled
        self._segments = np.empty(capacity, np.int64)  # row of the segment's first step
        self._scores = np.empty(capacity, np.float32)  # of the segment that begins there, or NaN
        self._coming: deque[CompositeReward] = deque()  # scores of steps that are still to come
        self._rows = np.zeros(64, np.int64)  # by episode: the row of its first step
        self._end = 0

    @property
    def steps(self) -> int:
        """Steps whose true rewards have come so far."""
        return self._end

    def append(self, record: TrueRewards) -> None:
        """Append the steps that follow those before.

        Raises:
            RecoveryError: they do not follow them.
        """
        due = (self._episode, self._steps) if record.first_step else (self._episode + 1, 0)
        if (record.episode, record.first_step) != due:
            raise RecoveryError(
                f'of {record.source!r} true rewards are missing before episode {record.episode}, '
                f'step {record.first_step}: those before end with episode {self._episode}, '
                f'{self._steps} steps'
            )
        self._episode, self._steps = record.episode, record.first_step + len(record.rewards)
        if record.episode >= len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        if record.first_step == 0:
            self._rows[record.episode] = self._end
        rewards = record.rewards[-self._capacity :]
        self._end += len(record.rewards)
        slots = np.arange(self._end - len(rewards), self._end) % self._capacity
        self._true[slots] = rewards
        self._labels[slots] = np.nan
        self._scores[slots] = np.nan
        self._book()

    def score(self, record: CompositeReward) -> None:
        """Take the score of a segment, whose steps may still be to come."""
        self._coming.append(record)
        self._book()

    def _book(self) -> None:
        while self._coming and (
            (self._coming[0].episode, self._coming[0].first_step) < (self._episode, self._steps)
        ):
            record = self._coming.popleft()
            row = int(self._rows[record.episode]) + record.first_step
            if row >= self._end - self._capacity:
                self._scores[row % self._capacity] = record.value

    def label(self, record: StepRewards) -> None:
        """Take labels of segments; those of steps that are no longer held are left out.

        The first labels of a step come with its whole segment; later ones may come alone.

        Raises:
            RecoveryError: labels belong to steps without true rewards.
        """
        lengths = record.lengths.astype(np.int64)
        last = np.lexsort((record.first_steps, record.episodes))[-1]
        end = int(record.episodes[last]), int(record.first_steps[last] + lengths[last])
        if end > (self._episode, self._steps):
            raise RecoveryError(
                f'of {record.source!r} there are labels up to episode {end[0]}, {end[1]} steps, '
                f'and true rewards up to episode {self._episode}, {self._steps} steps'
            )
        firsts = self._rows[record.episodes] + record.first_steps
        segments = np.repeat(firsts, lengths)
        within = np.arange(len(segments)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        rows = segments + within
        held = rows >= self._end - self._capacity
        slots = rows[held] % self._capacity
        first = np.isnan(self._labels[slots])
        self._segments[slots[first]] = segments[held][first]
        self._labels[slots] = record.labels[held]
        self._versions[slots] = record.version

    def labelled(self, version: int | None) -> tuple[F32, F32, I64]:
        """Labels, true rewards and segments (T,) of the labelled steps, or only of those that a
        given version labelled.
        """
        held = slice(min(self._end, self._capacity))
        there = self._there(version)
        return self._labels[held][there], self._true[held][there], self._segments[held][there]

    def _there(self, version: int | None) -> NDArray[np.bool_]:
        held = slice(min(self._end, self._capacity))
        there = ~np.isnan(self._labels[held])
        if version is not None:
            there &= self._versions[held] == version
        return there

    def whole_segments(self, version: int | None) -> tuple[I64, F32]:
        """First rows (S,) of the labelled segments that are held whole, and their scores (S,), NaN
        where not known.
        """
        held = slice(min(self._end, self._capacity))
        firsts = np.unique(self._segments[held][self._there(version)])
        firsts = firsts[firsts >= self._end - self._capacity]
        return firsts, self._scores[firsts % self._capacity]

    def segment(self, first: int) -> Segment:
        """The segment that begins with this row, its labels in their own unit."""
        episodes = self._rows[: self._episode + 1]
        episode = int(np.searchsorted(episodes, first, side='right')) - 1
        last = int(self._rows[episode + 1]) if episode < self._episode else self._end
        slots = np.arange(first, last) % self._capacity
        slots = slots[~np.isnan(self._labels[slots]) & (self._segments[slots] == first)]
        score = float(self._scores[slots[0]])
        return Segment(
            source=self._name,
            episode=episode,
            first=first - int(episodes[episode]),
            value=None if np.isnan(score) else score,
            labels=self._labels[slots],
            true=self._true[slots],
        )


class Recovery:
    """Compares labels and true rewards whenever a policy is due for evaluation.

    It compares the labels that the policy learns from: those of the newest `memory_steps` steps up
    to the phase of the labels. If each phase labels all of the memory again, only the newest
    version counts, since other labels belong to steps that have left the memory. A step takes 24
    bytes. True rewards may come before labels of earlier phases: by as many phases as the run's
    simulators may be ahead of its learner, or by any number in a bag.

    Args:
        settings: the run's settings.
        recorded: the labels come from the run's bag, which may lack some (`record_relabels`).
            Evaluations without all labels are not compared.
    """

    def __init__(self, settings: Settings, recorded: bool = False) -> None:
        self._settings = settings
        self._recorded = recorded
        self._complete = True  # no label is lacking
        self._version: int | None = None  # of the last labels
        self._sources: dict[str, _Source] = {}
        self._coming: list[TrueRewards] = []  # of phases that are not labelled yet
        self.rows: list[dict[str, float]] = []
        """For each evaluation with labels: `step`, `pearson`, `within` (Pearson after subtracting
        each segment's mean from both), `spearman` (NaN if one side does not vary), `steps`, the
        number of compared steps, and mean and standard deviation of both sides: `true_mean`,
        `true_std`, `inferred_mean`, `inferred_std`, the latter in the unit of the labels."""
        self.segments: list[Segment] = []
        """Segments of the last comparison, from the lowest to the highest score, evenly chosen;
        labels in their own unit."""

    def receive(self, record: Record) -> None:
        """Note a record of the run, of any kind.

        Raises:
            RecoveryError: there are labels, but some true rewards are missing.
        """
        if isinstance(record, TrueRewards):
            if not self._recorded:
                # labelled by now, if ever: in a run without labels they must not pile up
                self._take_in(record.phase - self._settings.ahead)
            self._coming.append(record)
        elif isinstance(record, CompositeReward):
            self._source(record.source).score(record)
        elif isinstance(record, StepRewards):
            self._take_in(record.phase)
            self._note_version(record)
            if len(record.lengths):
                if not self._source(record.source).steps:
                    raise RecoveryError(f'{record.source!r} published no true rewards')
                self._source(record.source).label(record)
            if record.part == record.parts - 1 and self._settings.evaluated(record.phase):
                self._compare(self._settings.steps_after(record.phase), record.version)

    def _note_version(self, record: StepRewards) -> None:
        """A new version labels steps again. A bag has these labels only at evaluations, but it
        always has the first label of a step.
        """
        if record.version != self._version and self._version is not None:
            whole = self._settings.evaluated(record.phase) and self._settings.relabels_all
            self._complete = whole or not self._recorded or self._settings.record_relabels == 'all'
        self._version = record.version

    def _take_in(self, phase: int) -> None:
        """Take in the true rewards of the phases up to this one."""
        waiting, self._coming = self._coming, []
        for record in waiting:
            if record.phase > phase:
                self._coming.append(record)
                continue
            self._source(record.source).append(record)

    def _source(self, name: str) -> _Source:
        if name not in self._sources:
            share = self._settings.memory_steps // self._settings.source_count
            self._sources[name] = _Source(name, max(1, share))
        return self._sources[name]

    def _compare(self, step: int, version: int) -> None:
        if not self._complete:
            return
        # here, because scipy takes a second to import
        from codetr_ros.runs.recovery_metrics import flat_recovery

        only = version if self._settings.relabels_all else None
        columns = [source.labelled(only) for _, source in sorted(self._sources.items())]
        # segments of different sources must not share a number
        far = np.int64(1) << 40
        labels, true = (np.concatenate([each[i] for each in columns]) for i in (0, 1))
        segments = np.concatenate([each[2] + i * far for i, each in enumerate(columns)])
        if len(labels):
            correlations = flat_recovery(labels, true, segments)
            self.rows.append(
                {
                    'step': step,
                    'pearson': correlations['pearson'],
                    'within': correlations['within_pearson'],
                    'spearman': correlations['spearman'],
                    'steps': len(labels),
                    'true_mean': float(true.mean(dtype=np.float64)),
                    'true_std': float(true.std(dtype=np.float64)),
                    'inferred_mean': float(labels.mean(dtype=np.float64)),
                    'inferred_std': float(labels.std(dtype=np.float64)),
                }
            )
            self.segments = self._chosen(only)

    def _chosen(self, version: int | None) -> list[Segment]:
        """Segments from the lowest to the highest score; any, if no score is known."""
        sources = [source for _, source in sorted(self._sources.items())]
        held = [source.whole_segments(version) for source in sources]
        firsts = np.concatenate([rows for rows, _ in held])
        scores = np.concatenate([values for _, values in held])
        owners = np.repeat(np.arange(len(held)), [len(rows) for rows, _ in held])
        known = np.flatnonzero(~np.isnan(scores))
        if not len(known):
            known = np.arange(len(scores))
        chosen = known[spread_evenly(scores[known])]
        return [sources[int(owners[i])].segment(int(firsts[i])) for i in chosen]
