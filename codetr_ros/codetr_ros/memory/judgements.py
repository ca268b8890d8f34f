"""What scorers other than the simulator state of the segments of the memory D.

They come and go, score some segments and leave out others, correct themselves, and several may
score the same segment, each on a scale of its own. Before anything learns from a phase, `settle`
brings their scores to one scale and gives each segment one score, the weighted mean. With one
scorer that is its own score, to the bit.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.calibration import Scales, calibrate
from codetr_ros.memory.segments import Place, Segments
from codetr_ros.records import F64, I64, CompositeReward, Preference
from codetr_ros.records.numbering import Judgement

Predict = Callable[[SegmentBatch], F64]
"""The scores (B,) that a reward model expects of segments."""
PREDICTED = 256
"""Segments whose scores are predicted at a time."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Preferences between segments that are held; P of them."""

    first: I64  # (P,) ids
    second: I64  # (P,)
    outcomes: F64  # (P,) 1: the first is better, 0: the second, 0.5: both are as good

    def __len__(self) -> int:
        return len(self.outcomes)

    def digest(self) -> int:
        """A number by which other preferences are told from these."""
        arrays = (self.first, self.second, self.outcomes)
        digest = hashlib.sha256(b''.join(each.tobytes() for each in arrays)).digest()
        return int.from_bytes(digest[:8], 'little', signed=True)


@dataclass(frozen=True)
class ScorerFacts:
    """What is known of a scorer."""

    scores: int
    """Segments that have a score of it now."""
    preferences: int
    """Pairs that it has compared and that are held."""
    offset: float
    slope: float
    """A score of it is offset + slope * worth, on the scale of the first scorer."""
    noise: float
    """Standard deviation of its scores about that, on the same scale; NaN with a single scorer."""
    agreement: float
    """Correlation with the mean of the others' scores of the same segments; NaN: too few."""


class Judgements:
    """Scores and preferences of all scorers, by segment.

    Args:
        segments: the segments of the memory.
    """

    def __init__(self, segments: Segments) -> None:
        self._segments = segments
        self._scores: dict[Place, dict[str, float]] = {}
        self._preferences: dict[tuple[str, Place, Place], float] = {}
        self._reference: str | None = (
            None  # the first scorer of the run, on whose scale worths are
        )
        self._scorers: set[str] = set()  # that have stated anything
        self._scales: tuple[list[str], Scales] | None = None
        self._pairs: Pairs | None = None
        self.counts: Counter[str] = Counter()
        """Corrections, and judgements that state that their scorer cannot tell."""

    # ------------------------------------------------------------------------------------------
    # changing

    def take(self, judgement: Judgement) -> None:
        """Take a score or a preference; a later one of the same scorer replaces the former.

        Raises:
            RecordError: there is no such segment.
        """
        if isinstance(judgement, Preference):
            self._prefer(judgement)
        else:
            self._score(judgement)
        self._scorers.add(judgement.scorer)
        self._pairs = None

    def _score(self, reward: CompositeReward) -> None:
        place = self._segments.place(
            reward.source, reward.episode, reward.first_step, reward.length, reward.scorer
        )
        of_segment = self._scores.setdefault(place, {})
        self._count(reward.value, reward.scorer in of_segment)
        of_segment[reward.scorer] = reward.value
        if self._reference is None and not np.isnan(reward.value):
            self._reference = reward.scorer

    def _prefer(self, preference: Preference) -> None:
        p, who = preference, preference.scorer
        first = self._segments.place(p.source, p.episode, p.first_step, p.length, who)
        second = self._segments.place(
            p.other_source, p.other_episode, p.other_first_step, p.other_length, who
        )
        outcome = p.outcome
        if second < first:  # either order is the same pair
            first, second, outcome = second, first, 1 - outcome
        key = (who, first, second)
        self._count(outcome, key in self._preferences)
        self._preferences[key] = outcome

    def _count(self, value: float, again: bool) -> None:
        self.counts['corrections'] += again
        self.counts['cannot tell'] += bool(np.isnan(value))

    def forget_evicted(self) -> None:
        """Drop what is of segments that the memory no longer holds."""
        self._pairs = None
        held = self._segments.holds
        self._scores = {place: of for place, of in self._scores.items() if held(place)}
        self._preferences = {
            key: outcome
            for key, outcome in self._preferences.items()
            if held(key[1]) and held(key[2])
        }

    def settle(self, predict: Predict | None = None) -> None:
        """Give each scored segment one score, from those of all its scorers.

        Args:
            predict: what the reward model expects, by which the scales of scorers that share few
                segments are told from what they scored; None: it knows nothing yet.
        """
        self._pairs = None  # ids change with the sources
        flat = list(self._flat())
        names = sorted({name for _, name, _ in flat})
        values = dict.fromkeys(self._scores, np.nan)
        self._scales = None
        if len(names) == 1:
            values |= {place: value for place, _, value in flat}
        elif names:
            places = sorted({place for place, _, _ in flat})
            number = {place: i for i, place in enumerate(places)}
            if self._reference not in names:  # what it scored has left the memory
                self._reference = max(names, key=lambda name: (_count_of(flat, name), name))
            scales = calibrate(
                np.array([names.index(name) for _, name, _ in flat]),
                np.array([number[place] for place, _, _ in flat]),
                np.array([value for _, _, value in flat]),
                names.index(self._reference),
                self._expected(places, predict),
            )
            self._scales = names, scales
            values |= dict(zip(places, scales.worths.tolist(), strict=True))
        self._segments.value(values)

    def _flat(self) -> Iterator[tuple[Place, str, float]]:
        for place, of_segment in sorted(self._scores.items()):
            for name, value in sorted(of_segment.items()):
                if not np.isnan(value):
                    yield place, name, value

    def _expected(self, places: list[Place], predict: Predict | None) -> F64 | None:
        if predict is None:
            return None
        ids = self._segments.ids_of(places)
        parts = [
            predict(self._segments.batch(ids[i : i + PREDICTED]))
            for i in range(0, len(ids), PREDICTED)
        ]
        expected: F64 = np.concatenate(parts)
        return expected

    # ------------------------------------------------------------------------------------------
    # reading

    def pairs(self) -> Pairs:
        """The preferences that are held, by scorer and segments."""
        if self._pairs is None:
            known = [(k, o) for k, o in sorted(self._preferences.items()) if not np.isnan(o)]
            self._pairs = Pairs(
                self._segments.ids_of([key[1] for key, _ in known]),
                self._segments.ids_of([key[2] for key, _ in known]),
                np.array([outcome for _, outcome in known], np.float64),
            )
        return self._pairs

    def judged(self) -> I64:
        """Ids of the segments of which somebody has stated anything, ascending."""
        places = set(self._scores)
        for _, first, second in self._preferences:
            places |= {first, second}
        return np.sort(self._segments.ids_of(sorted(places)))

    def facts(self) -> dict[str, ScorerFacts]:
        """What is known of each scorer, by name."""
        scores = Counter(name for _, name, _ in self._flat())
        pairs = Counter(key[0] for key, o in self._preferences.items() if not np.isnan(o))
        facts = {}
        for name in sorted(self._scorers):
            scale = (0.0, 1.0, np.nan, np.nan)
            if self._scales is not None and name in self._scales[0]:
                at, of = self._scales[0].index(name), self._scales[1]
                each = (of.offsets, of.slopes, of.noises, of.agreement)
                scale = tuple(float(values[at]) for values in each)  # type: ignore[assignment]
            facts[name] = ScorerFacts(scores[name], pairs[name], *scale)
        return facts


def _count_of(flat: list[tuple[Place, str, float]], name: str) -> int:
    return sum(each == name for _, each, _ in flat)
