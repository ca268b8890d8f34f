"""How the scores of a run went, phase by phase: for runs on a robot, which nobody evaluates."""

import csv
import io
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from codetr_ros.bags.dropped import undropped_entries
from codetr_ros.bags.reader import Bag
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.runs.run_summary import GivenScores


@dataclass
class ScoreCourse:
    """The scores per step of a run's segments, by the phase in which each began."""

    by_phase: dict[int, list[float]] = field(default_factory=dict)
    unknown: int = 0  # scores of steps that are not in the bag

    def mean(self, first: int, end: int) -> tuple[float, float, int]:
        """The mean score per step of the phases from `first` up to `end`, its standard error, and
        the number of scores.
        """
        values = [v for phase, vs in self.by_phase.items() if first <= phase < end for v in vs]
        if not values:
            return float('nan'), float('nan'), 0
        error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
        return float(np.mean(values)), float(error), len(values)

    def rows(self, warmup: int) -> list[GivenScores]:
        """The scores by phase, for a summary.

        Args:
            warmup: phases of the random policy.
        """
        return [
            GivenScores(
                phase=n, scores=len(values), per_step=float(np.mean(values)), random=n < warmup
            )
            for n, values in sorted(self.by_phase.items())
        ]

    def to_csv(self) -> str:
        """A line for each phase, as text."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        writer.writerow(('phase', 'scores', 'score per step'))
        for phase in sorted(self.by_phase):
            mean, _, count = self.mean(phase, phase + 1)
            writer.writerow((phase, count, repr(round(mean, 6))))
        return text.getvalue()


def score_course(bag: Bag) -> ScoreCourse:
    """Read the scores of a run.

    Raises:
        BagError: the bag cannot be read.
    """
    chunks: dict[tuple[str, int], list[tuple[int, int]]] = {}  # first step and phase
    scores: list[CompositeReward] = []
    ends: Counter[tuple[str, int]] = Counter()
    for entry in undropped_entries(bag, (Transitions, CompositeReward)):
        record = entry.record
        if isinstance(record, Transitions):
            key = record.source, record.episode
            chunks.setdefault(key, []).append((record.first_step, record.phase))
            ends[key] = max(ends[key], record.first_step + record.steps)
        elif isinstance(record, CompositeReward) and not np.isnan(record.value):
            scores.append(record)
    course = ScoreCourse()
    for score in scores:
        key = score.source, score.episode
        if score.first_step + score.length > ends[key]:
            course.unknown += 1
            continue
        phase = max((first, phase) for first, phase in chunks[key] if first <= score.first_step)[1]
        course.by_phase.setdefault(phase, []).append(score.value / score.length)
    return course
