"""The newest episode of a run, step by step, with what was inferred of its rewards."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from codetr_ros.records import (
    F32,
    CompositeReward,
    Record,
    StepRewards,
    Transitions,
    TrueRewards,
)

MOST_HELD = 500
"""Episodes that wait for their labels; the oldest are let go first, which only delays the picture.
"""
MOST_CURVES = 12
"""Numbers of an observation or an action that are shown."""
DIGITS = 5


@dataclass
class _Parts:
    """What has arrived of an episode."""

    chunks: list[Transitions] = field(default_factory=list)
    scores: list[CompositeReward] = field(default_factory=list)
    true: list[TrueRewards] = field(default_factory=list)
    labels: dict[int, F32] = field(default_factory=dict)  # by the first of their steps

    @property
    def ended(self) -> bool:
        last = self.chunks[-1] if self.chunks else None
        return last is not None and (last.terminated or last.truncated)

    @property
    def steps(self) -> int:
        return max((chunk.first_step + chunk.steps for chunk in self.chunks), default=0)

    def taken(self) -> tuple[F32, F32]:
        """Observations before the steps (T, O), and actions (T, A)."""
        observations = {chunk.first_step: chunk.observations[:-1] for chunk in self.chunks}
        actions = {chunk.first_step: chunk.actions for chunk in self.chunks}
        return _steps(self.steps, observations), _steps(self.steps, actions)


class NewestEpisode:
    """Finds the newest episode that has ended, and prefers one whose steps have labels.

    Records come in the order of their publication.
    """

    def __init__(self) -> None:
        self._held: dict[tuple[str, int], _Parts] = {}  # the oldest first
        self._labelled: tuple[str, int] | None = None  # the newest that has ended with labels
        self.changes = 0

    def receive(self, record: Record) -> None:
        """Note a record of the run, of any kind."""
        if isinstance(record, Transitions):
            parts = self._parts(record.source, record.episode)
            parts.chunks.append(record)
            self.changes += parts.ended
        elif isinstance(record, CompositeReward):
            self._parts(record.source, record.episode).scores.append(record)
        elif isinstance(record, TrueRewards):
            self._parts(record.source, record.episode).true.append(record)
        elif isinstance(record, StepRewards):
            self._label(record)

    def _parts(self, source: str, episode: int) -> _Parts:
        parts = self._held.get((source, episode))
        if parts is None:
            while len(self._held) >= MOST_HELD:
                del self._held[next(key for key in self._held if key != self._labelled)]
            parts = self._held[source, episode] = _Parts()
        return parts

    def _label(self, record: StepRewards) -> None:
        held = [episode for source, episode in self._held if source == record.source]
        if not held:
            return
        ends = np.cumsum(record.lengths, dtype=np.int64)
        for row in np.flatnonzero(record.episodes >= min(held)):
            parts = self._held.get((record.source, int(record.episodes[row])))
            if parts is not None:
                labels = record.labels[ends[row] - record.lengths[row] : ends[row]]
                parts.labels[int(record.first_steps[row])] = labels
        self._find()

    def _find(self) -> None:
        """Find the newest that has labels, and let go of all before it."""
        for key in reversed(self._held):
            if self._held[key].ended and self._held[key].labels:
                self._labelled = key
                self.changes += 1
                for older in list(self._held):
                    if older == key:
                        break
                    if self._held[older].ended:
                        del self._held[older]
                return

    def _shown(self) -> tuple[str, int] | None:
        ended = (key for key in reversed(self._held) if self._held[key].ended)
        return self._labelled or next(ended, None)

    def arrays(self) -> tuple[str, int, F32, F32] | None:
        """Source and number of the episode, all observations before its steps (T, O), and all
        actions (T, A); None if no episode has ended yet, or its first steps are not known.
        """
        key = self._shown()
        if key is None:
            return None
        parts = self._held[key]
        if sum(chunk.steps for chunk in parts.chunks) != parts.steps:
            return None
        return (*key, *parts.taken())

    def document(self) -> dict[str, Any] | None:
        """The episode for a page: lists of numbers, None where a step has none; None if no episode
        has ended yet.

        `observations` and `actions` have a list for each number of them, the first `MOST_CURVES`.
        An observation is that before the step. `inferred` is in the unit of the labels.
        """
        key = self._labelled or next(
            (k for k in reversed(self._held) if self._held[k].ended), None
        )
        if key is None:
            return None
        parts = self._held[key]
        steps = parts.steps
        observations, actions = parts.taken()
        return {
            'source': key[0],
            'episode': key[1],
            'phase': parts.chunks[-1].phase,
            'steps': steps,
            'terminated': parts.chunks[-1].terminated,
            'inferred': _plain(_steps(steps, parts.labels)),
            'true': _plain(_steps(steps, {t.first_step: t.rewards for t in parts.true})),
            'scores': [
                {
                    'first_step': score.first_step,
                    'length': score.length,
                    'value': float(score.value) if np.isfinite(score.value) else None,
                    'scorer': score.scorer,
                }
                for score in parts.scores
            ],
            'observations': [_plain(column) for column in observations.T[:MOST_CURVES]],
            'observation_size': observations.shape[1],
            'actions': [_plain(column) for column in actions.T[:MOST_CURVES]],
            'action_size': actions.shape[1],
        }


def _steps(count: int, parts: Mapping[int, F32]) -> F32:
    """An array with a row for each step, NaN where no part has it."""
    shape = next((part.shape[1:] for part in parts.values()), ())
    whole = np.full((count, *shape), np.nan, np.float32)
    for first, part in parts.items():
        room = max(0, count - first)
        whole[first : first + len(part)] = part[:room]
    return whole


def _plain(values: F32) -> list[float | None]:
    rounded = [float(f'{value:.{DIGITS}g}') for value in values.tolist()]
    return [value if np.isfinite(value) else None for value in rounded]
