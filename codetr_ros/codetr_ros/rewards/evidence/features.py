"""What the reward of a step may depend on: fixed features of (s', a, s' - s), in blocks.

The formulas: docs/methods.md#evidence.

From the trial: the floors and the cut, the blocks, their scaling and their sizes, and that both
ends of a step are seen, as rewards are functions of both. Decided here:

* The trial had s in the place of s'. The two span the same functions, but scores of long segments
  cannot tell them apart, as the changes s' - s add up to the last observation less the first. Then
  the prior decides, and rewards are mostly functions of where a step has led to.
* Each feature that is a single component or its square has a variance of its own, so it is a block
  of its own. Rewards depend on few quantities, and scores then show soon on which (automatic
  relevance determination; MacKay, 1994; Neal, 1996). With one variance for all states, another
  for all actions and so on, as in the trial, it took 80 to 100 scores of a soft maximum over 100
  steps of HalfCheetah until credit within segments was above .9; now it takes 30 to 50.
* Rewards jump where an episode ends in a terminal state: a robot that falls loses what it earned
  by being upright, and no smooth function of (s', a, s' - s) can say so. A few short segments are
  then explained badly, and decide which kind of score is named. So such a step may have a feature
  of its own.
* Moments are those of the steps that are learnt from, and they are renewed only when they have
  moved by more than `DRIFT`, so that what was computed from them can be kept from phase to phase.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.records import F32, F64
from codetr_ros.seeding import generator

STATE_FLOOR, ACTION_FLOOR, CHANGE_FLOOR = 1e-2, 1e-2, 1e-3
"""Least deviations by which the components of s', a and s' - s are divided."""
CLIP = 10.0
"""Deviations from the mean at which standardised inputs are cut off."""
DRIFT = 0.1
"""Moments are renewed when a mean has moved by so many deviations, or a deviation by this share
of itself.
"""
PIECE = 4096
"""Steps whose features are computed at a time: it bounds the memory that this takes."""
STATE, STATE_ACTION, ALL = 0, 1, 2
FOURIER: tuple[tuple[int, float, int], ...] = (
    (STATE, 0.3, 200),
    (STATE, 0.7, 200),
    (STATE_ACTION, 1.0, 128),
    (ALL, 1.0, 128),
)
"""Blocks of random Fourier features: of which inputs, their length scale l, and their number."""


@dataclass(frozen=True)
class Moments:
    """Mean and deviation of each component of (s', a, s' - s)."""

    mean: F64  # (2 O + A,)
    std: F64  # (2 O + A,), floored

    def moved(self, other: 'Moments') -> bool:
        """Whether the other ones are so far from these that the features are to be renewed."""
        shift = np.abs(other.mean - self.mean) / self.std
        ratio = np.abs(np.log(other.std / self.std))
        return bool((shift > DRIFT).any() or (ratio > math.log1p(DRIFT)).any())


def sums(inputs: F32) -> F64:
    """What moments are made of, of some steps: their number, sums and sums of squares.

    Args:
        inputs: (m, 2 O + A).

    Returns:
        (1 + 2 (2 O + A),), to be added up over segments.
    """
    exact = inputs.astype(np.float64)
    return np.concatenate([[len(exact)], exact.sum(0), (exact * exact).sum(0)])


def moments(total: F64, observation_size: int, action_size: int) -> Moments:
    """Moments from what `sums` gave for all steps together."""
    count = (len(total) - 1) // 2
    mean = total[1 : 1 + count] / total[0]
    variance = np.maximum(total[1 + count :] / total[0] - mean * mean, 0.0)
    floors = [STATE_FLOOR] * observation_size + [ACTION_FLOOR] * action_size
    floors += [CHANGE_FLOOR] * observation_size
    return Moments(mean, np.maximum(np.sqrt(variance), floors))


class Features:
    """Features phi (N, D) of steps, D = 1 + 3 O + 2 A + 656, and one more for `ends`.

    1; s'; a; d = s' - s; squares of s' and of a; and four blocks of random Fourier features
    sqrt(2/count) cos(W z + b), W ~ N(0, 1/(l^2 n)), of n inputs z (Rahimi and Recht, 2007), whose
    sums of products are Gaussian kernels of length l sqrt(n). All s' together have about unit
    norm, and so have all a and so on, so that the variances of weights state how much of a reward
    they make up.

    Args:
        observation_size: O.
        action_size: A.
        seed: of the random features.
        ends: the last feature is 1 where a step led to a terminal state, and else 0.
    """

    def __init__(
        self, observation_size: int, action_size: int, seed: int, ends: bool = False
    ) -> None:
        self.ends = ends
        self._sizes = observation_size, action_size
        self.inputs = 2 * observation_size + action_size
        seen = [observation_size, observation_size + action_size, self.inputs]
        rng = generator(seed, 'evidence', 'features')
        count = sum(number for _, _, number in FOURIER)
        waves = np.zeros((self.inputs, count), np.float32)
        phases = np.empty(count, np.float32)
        at = 0
        for over, length, number in FOURIER:
            n, columns = seen[over], slice(at, at + number)
            waves[:n, columns] = rng.standard_normal((n, number)) / (length * math.sqrt(n))
            phases[columns] = rng.uniform(0, 2 * math.pi, number)
            at += number
        self.waves, self.phases = torch.tensor(waves), torch.tensor(phases)
        self.mean = torch.zeros(self.inputs, dtype=torch.float64)
        self.std = torch.ones(self.inputs, dtype=torch.float64)
        o, a = self._sizes
        fourier = [number for _, _, number in FOURIER]
        self._linear = _slices([1, o, a, o, o, a])[1:]
        self.blocks = _slices([1] * self._linear[-1].stop + fourier + [1] * ends)
        """Features whose weights share the variance of their prior."""
        self.size = self.blocks[-1].stop
        amplitudes = [np.full(number, math.sqrt(2 / number)) for _, _, number in FOURIER]
        self._amplitudes = torch.tensor(np.concatenate(amplitudes).astype(np.float32))

    @property
    def moments(self) -> Moments:
        """By which inputs are standardised."""
        return Moments(self.mean.numpy().copy(), self.std.numpy().copy())

    def effects(self, weights: Tensor) -> dict[str, float]:
        """By how much f changes with one deviation of each feature before the Fourier blocks.

        Args:
            weights: (D,).
        """
        o, a = self._sizes
        kinds = (("s'[{}]", o), ('a[{}]', a), ("(s'-s)[{}]", o), ("s'[{}]^2", o), ('a[{}]^2', a))
        names = [(kind.format(i), count) for kind, count in kinds for i in range(count)]
        linear = weights[1 : 1 + len(names)].tolist()
        pairs = zip(names, linear, strict=True)
        ends = {'terminal state': float(weights[-1])} if self.ends else {}
        return ends | {name: weight / math.sqrt(count) for (name, count), weight in pairs}

    def renew(self, new: Moments) -> None:
        """Standardise by other moments from now on."""
        self.mean, self.std = torch.tensor(new.mean), torch.tensor(new.std)

    def __call__(self, inputs: F32) -> Tensor:
        """Features (N, D) of steps, float32.

        Args:
            inputs: (N, 2 O + A), as `step_inputs` makes them; with a further column for `ends`.
        """
        flags, inputs = inputs[:, self.inputs :], inputs[:, : self.inputs]
        # torch.tensor copies into aligned memory: the last bits may depend on where arrays lie
        raw = torch.tensor(inputs)
        z = ((raw - self.mean.float()) / self.std.float()).clamp_(-CLIP, CLIP)
        o, a = self._sizes
        phi = torch.empty(len(z), self.size)
        s, u, d = z[:, :o], z[:, o : o + a], z[:, o + a :]
        linear = self._linear
        phi[:, 0] = 1
        phi[:, linear[0]] = s / math.sqrt(o)
        phi[:, linear[1]] = u / math.sqrt(a)
        phi[:, linear[2]] = d / math.sqrt(o)
        phi[:, linear[3]] = (s * s - 1) / math.sqrt(2 * o)
        phi[:, linear[4]] = (u * u - 1) / math.sqrt(2 * a)
        angles = torch.addmm(self.phases, z, self.waves)
        fourier = slice(linear[4].stop, linear[4].stop + len(self.phases))
        phi[:, fourier] = angles.cos_().mul_(self._amplitudes)
        if self.ends:
            phi[:, -1] = torch.tensor(flags[:, 0])
        return phi


def step_inputs(
    before: F32, actions: F32, after: F32, ends: NDArray[np.bool_] | None = None
) -> F32:
    """What is looked at of steps, (s', a, s' - s): (N, 2 O + A), and a column of `ends`.

    Args:
        before: (N, O) the observations s.
        actions: (N, A).
        after: (N, O) the observations s' that they led to.
        ends: (N,) which of these are terminal, for features that ask for it.
    """
    columns = [] if ends is None else [ends[:, None].astype(np.float32)]
    return np.concatenate([after, actions, after - before, *columns], 1)


def ends_of(batch: SegmentBatch) -> NDArray[np.bool_]:
    """Which steps (B, L) of segments led to a terminal state: none but the last can."""
    assert batch.terminated is not None, 'this batch does not come from a memory'
    ends = np.zeros(batch.actions.shape[:2], np.bool_)
    ends[np.arange(len(ends)), batch.lengths - 1] = batch.terminated
    return ends


def _slices(sizes: Sequence[int]) -> list[slice]:
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
