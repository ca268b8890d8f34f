"""What a regression on scores is made from: segments of the memory D as features, kept.

The features of a segment's steps do not change while the moments stay, so each segment is looked
at once. Its features are computed by itself: they have the same bits whatever else is looked at,
so that a run that is taken up again goes on to the bit.
"""

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64, I64
from codetr_ros.rewards.evidence.features import (
    PIECE,
    Features,
    Moments,
    ends_of,
    moments,
    step_inputs,
    sums,
)

V = TypeVar('V')

GATHERED = 256
"""Segments that are taken out of the memory at a time."""


@dataclass(frozen=True)
class Sample:
    """Scored segments, S of them, in the order of their ids."""

    scores: F64  # (S,)
    m: I64  # (S,) steps
    rows: Tensor  # features: (S, D) float64, segments' means, or (N, D) float32, of all steps
    terminates: bool = False  # some episode in the memory has ended in a terminal state

    @property
    def starts(self) -> I64:
        """Where among the steps each segment begins."""
        starts: I64 = np.cumsum(self.m) - self.m
        return starts

    def part(self, places: I64) -> 'Sample':
        """Some of the segments, of a sample without single steps."""
        rows = self.rows[torch.tensor(places)]
        return Sample(self.scores[places], self.m[places], rows, self.terminates)

    def steps(self) -> Tensor:
        """Features (N, D) of all steps, for links that ask for them."""
        assert self.rows.dtype == torch.float32, 'this sample was made without single steps'
        return self.rows

    def means(self) -> Tensor:
        """Mean features (S, D) of each segment, float64."""
        if self.rows.dtype == torch.float64:
            return self.rows
        parts = torch.split(self.rows, self.m.tolist())
        return torch.stack([part.mean(0, dtype=torch.float64) for part in parts])


def chosen(ids: I64, most: int, seed: int) -> I64:
    """The segments to learn from: all, or the newest half and a random half of the older ones.

    The random half is by a number that each id has for ever: who is in it stays in it.

    Args:
        ids: of all scored segments, source by source in the order of their numbers.
        most: segments.
        seed: of the random numbers.
    """
    if len(ids) <= most:
        return ids
    sources = ids >> 40
    ends = np.searchsorted(sources, sources, side='right')
    age = ends - np.arange(len(ids))  # 1 for the newest of each source
    order = np.lexsort((ids, age))
    newest, older = order[: most // 2], order[most // 2 :]
    kept = older[np.argsort(scrambled(ids[older], seed), kind='stable')[: most - most // 2]]
    some: I64 = ids[np.sort(np.concatenate([newest, kept]))]
    return some


def scrambled(ids: I64, seed: int) -> NDArray[np.uint64]:
    """A random number of each id, the same for ever (splitmix64; Steele et al., 2014)."""
    with np.errstate(over='ignore'):
        x = ids.astype(np.uint64) + np.uint64(seed + 1) * np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))


class Sampler:
    """Makes samples of one memory after the other, and keeps what is still of use.

    Args:
        features: what steps are looked at by.
    """

    def __init__(self, features: Features) -> None:
        self._features = features
        self._sums: dict[int, F64] = {}
        self._means: dict[int, Tensor] = {}
        self._steps: dict[int, Tensor] = {}
        self._memory: weakref.ref[Trajectories] | None = None
        self._sources: list[str] = []

    def forget(self) -> None:
        """Drop features: the moments are others."""
        self._means, self._steps = {}, {}

    def _attend(self, memory: Trajectories) -> None:
        """Drop everything where ids mean other segments than before."""
        sources = [source.name for source in memory.store.by_name()]
        same = self._memory is not None and self._memory() is memory
        if not same or sources != self._sources:
            self._memory, self._sources = weakref.ref(memory), sources
            self._sums = {}
            self.forget()

    def moments(self, memory: Trajectories, ids: I64) -> Moments:
        """Moments of the steps of some segments."""
        self._attend(memory)
        self._sums = _kept(self._sums, ids, lambda new: self._each(memory, new, self._added))
        total = np.sum(list(self._sums.values()), 0)
        return moments(total, memory.observation_size, memory.action_size)

    def sample(self, memory: Trajectories, ids: I64, steps: bool) -> Sample:
        """The features of some segments.

        Args:
            memory: holds them.
            ids: of the segments, ascending.
            steps: whether the features of single steps are asked for too.
        """
        self._attend(memory)
        scores, m = memory.segments.scores(ids), memory.segments.lengths(ids)
        if steps:
            self._steps = _kept(self._steps, ids, lambda new: self._each(memory, new, self._rows))
            rows = torch.cat(list(self._steps.values()))
            return Sample(scores, m, rows, memory.store.terminates)
        self._steps = {}  # a hundred times as large: not kept for a link that does without
        self._means = _kept(self._means, ids, lambda new: self._each(memory, new, self._mean))
        return Sample(scores, m, torch.stack(list(self._means.values())), memory.store.terminates)

    def _added(self, inputs: F32) -> F64:
        return sums(inputs[:, : self._features.inputs])

    def _rows(self, inputs: F32) -> Tensor:
        return torch.cat([self._features(piece) for piece in _pieces(inputs)])

    def _mean(self, inputs: F32) -> Tensor:
        parts = [self._features(piece).sum(0, dtype=torch.float64) for piece in _pieces(inputs)]
        return torch.stack(parts).sum(0) / len(inputs)

    def _each(self, memory: Trajectories, ids: I64, look: Callable[[F32], V]) -> list[V]:
        """What there is to see of each segment."""
        views: list[V] = []
        for i in range(0, len(ids), GATHERED):
            batch = memory.segments.batch(ids[i : i + GATHERED])
            ends = ends_of(batch) if self._features.ends else None
            for row, m in enumerate(batch.lengths.tolist()):
                states, actions = batch.observations[row, : m + 1], batch.actions[row, :m]
                own = None if ends is None else ends[row, :m]
                views.append(look(step_inputs(states[:-1], actions, states[1:], own)))
        return views


def gathered(steps: Tensor, slopes: F64, m: I64) -> Tensor:
    """sum_t J_t phi_t (S, D) of each segment, float64."""
    parts = torch.split(steps, m.tolist())
    factors = torch.split(torch.tensor(slopes.astype(np.float32)), m.tolist())
    sums = [factor @ part for factor, part in zip(factors, parts, strict=True)]
    return torch.stack(sums).double()


def _kept(before: dict[int, V], ids: I64, make: Callable[[I64], list[V]]) -> dict[int, V]:
    """What is known of some ids, in their order; `make` is asked for those that are new."""
    wanted = ids.tolist()
    new = [number for number in wanted if number not in before]
    made = dict(zip(new, make(np.array(new, np.int64)), strict=True)) if new else {}
    return {number: before[number] if number in before else made[number] for number in wanted}


def _pieces(inputs: F32) -> list[F32]:
    return [inputs[i : i + PIECE] for i in range(0, len(inputs), PIECE)]
