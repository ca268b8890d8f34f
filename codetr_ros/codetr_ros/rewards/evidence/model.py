"""A regression of scores on the features of their steps, through a link: fitted, and asked.

The formulas: docs/methods.md#evidence.

From the trial: the noise, the closed form where the link is linear, else Gauss-Newton rounds with
their number, steps and annealing, the learnt beta, and labels that explain each score. Decided
here: several annealings, and after a first fit, the scales are learnt in the first round only.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codetr_ros.records import F64, I64
from codetr_ros.rewards.evidence import duels as comparisons
from codetr_ros.rewards.evidence import scales
from codetr_ros.rewards.evidence.duels import Duels
from codetr_ros.rewards.evidence.link import Link, level_scale
from codetr_ros.rewards.evidence.maxima import SoftMax
from codetr_ros.rewards.evidence.regression import (
    Posterior,
    from_others,
    noise,
    posterior,
    prior_variances,
)
from codetr_ros.rewards.evidence.sample import Sample, gathered
from codetr_ros.rewards.evidence.scales import Evidence, Linear
from codetr_ros.rewards.evidence.verdicts import Verdicts

ROUNDS = (7, 1)
"""Gauss-Newton rounds of a first fit, after its first one, and of later fits."""
ITERATIONS = (40, 10)
"""Of the search for scales: at first, later."""
HEATS: tuple[tuple[float, ...], ...] = ((0.1, 0.3), (0.3,), ())
"""A soft maximum is annealed at the first fit: its beta by such factors. Few scores may lead to a
place that is not the best one, so there are several beginnings, of which the likeliest one stays.
"""
FEW = 200
"""Scores up to which a first fit has several beginnings."""
HEAT_ROUNDS = 3
"""Rounds with each of them."""
MOST_TURNS = 12
"""Of learning levels and the scale of verdicts: from both as they were fitted last, too, since
verdicts that have come since may have changed both.
"""
SETTLED = 0.1
"""Change [nats] of the likelihood of verdicts in a turn behind which there is no other one."""
IN_VAIN = 4
"""Turns that are not better than one before behind which there is no other one: fits whose links
are not linear may go back and forth for ever.
"""
AS_LIKELY = 1.0
"""Difference [nats] up to which the last of the turns is kept rather than the likeliest."""
LEAST_LEFT = (1e-3, 0.2)
"""Of 1 - leverage, where a verdict is predicted from the others: for links that are linear, and
for others. A few rounds of Gauss-Newton do not end where that would be exact, and without this and
the next two bounds such fits diverge.
"""
FARTHEST, SUREST = 4.0, 0.05
"""Deviations of levels: how far from their mean a verdict's level may be, and the least deviation
that it may have.
"""
STEPS = (1.0, 0.5, 0.25)
"""Step lengths of Gauss-Newton, of which the best one is taken."""


@dataclass(frozen=True)
class Targets:
    """What scores state of levels, in units of the level scale."""

    levels: F64  # (S,)
    noise: Tensor | float = 0.0  # (S,) variance that each has besides


class Model:
    """f(x) = sum_b phi_b(x) . w_b with step noise v_r and score noise v_0, given scores.

    Args:
        link: from step rewards to scores.
        blocks: of the features.
    """

    def __init__(self, link: Link, blocks: Sequence[slice]) -> None:
        self.link = link
        self.blocks = blocks
        self.scale = 0.0
        """The unit of levels: their root mean square at the first fit."""
        self.theta = scales.first(len(blocks))
        size = blocks[-1].stop
        self.posterior = Posterior(
            torch.zeros(size, dtype=torch.float64), torch.zeros(size, size, dtype=torch.float64)
        )
        self.fitted = False
        self.evidence = 0.0
        """Logarithm of the marginal likelihood of the scores from which scales are learnt."""
        self.left_out_r2 = 0.0
        """Of levels of these scores, each predicted from all others."""
        self.verdicts: Verdicts | None = None
        """The scale of the scores, where it is ordinal."""
        self.zero = 0.0
        """The step reward that labels take for nothing. Where scores are verdicts it is the mean
        of the steps that were judged, as no verdict is zero by itself: stars are positive numbers,
        and SAC, whose values begin at zero, would have to learn what all steps have in common
        before it can tell actions apart. That changes no policy's rank as long as episodes end by
        time alone. Where some end in a terminal state, it decides whether it pays to live on, and
        verdicts stay the numbers that they are.
        """

    def measure(self, scores: F64, m: I64, ordinal: bool) -> None:
        """Note what scores are, and freeze the unit of levels, the first time.

        Args:
            scores: (S,) of segments.
            m: (S,) their steps.
            ordinal: only the order of scores means anything.

        Raises:
            FloatingPointError: they are too large for float64.
        """
        self.link.ordinal = ordinal
        if not self.scale and not len(scores):  # preferences alone: their levels have no unit
            self.scale = 1.0
        if not self.scale:
            with np.errstate(over='ignore'):
                scale = level_scale(self.link.level(scores, m))
            if not math.isfinite(scale):
                raise FloatingPointError(f'the root mean square of their levels is {scale}')
            self.scale = scale
            self.link.measure(scale)

    def fit(
        self, sample: Sample, some: I64, ordinal: bool = False, duels: Duels | None = None
    ) -> None:
        """Learn from segments.

        Args:
            sample: the segments; with the features of steps, unless the link is linear.
            some: places of those from which the scales are learnt.
            ordinal: only the order of scores means anything.
            duels: preferences between segments, where the link is linear.

        Raises:
            FloatingPointError: numbers are too large for float64.
        """
        self.measure(sample.scores, sample.m, ordinal)
        levels = self.link.level(sample.scores, sample.m) / self.scale
        if duels is not None:
            self._fit_duels(sample, levels, some, duels, ordinal)
        elif ordinal:
            self._fit_verdicts(sample, levels, some)
        else:
            self.verdicts = None
            self._fit(sample, Targets(levels), some)
            slopes = self.link.log_slope(sample.scores, sample.m)[some]
            self.evidence += float(slopes.sum()) - len(some) * math.log(self.scale)
        judged = ordinal and len(sample.m) > 0 and not sample.terminates
        self.zero = self._mean_reward(sample) if judged else 0.0

    def _mean_reward(self, sample: Sample) -> float:
        """The mean step reward that the posterior mean lets expect."""
        if self.link.linear:
            means: F64 = (sample.means() @ self.posterior.mean).numpy()
            return float(np.average(means, weights=sample.m))
        return float(of_steps(sample.steps(), self.posterior.mean).mean())

    def _fit_duels(
        self, sample: Sample, levels: F64, some: I64, duels: Duels, ordinal: bool
    ) -> None:
        """Fit to scores and to what preferences state of differences: in turns.

        Where the scores are verdicts, their scale is learnt in the same turns.
        """
        count, scores = len(levels), sample.scores
        deviation = float(levels.std()) if count > 1 and levels.std() > 0 else 1.0
        places = torch.tensor(np.concatenate([some, count + np.arange(len(duels.outcomes))]))
        verdicts, turns, mean, variance = None, comparisons.TURNS, np.zeros(0), np.zeros(0)
        if ordinal:
            verdicts, mean, variance = self._begin_verdicts(sample, levels)
            turns = MOST_TURNS
        apart, apart_variance = duels.before(deviation)
        for turn in range(turns):
            targets = Targets(levels, torch.zeros(count, dtype=torch.float64))
            if verdicts is not None:
                targets = _sites(verdicts, scores, mean, variance)
            differences, left = duels.sites(apart, apart_variance, deviation)
            own = self._linear(sample, targets)
            data = Linear(
                torch.cat([own.rows, duels.rows]) if count else duels.rows,
                torch.cat([own.spread, duels.spread]),
                torch.tensor(np.concatenate([targets.levels, differences])),
                noise=torch.cat([torch.as_tensor(targets.noise), torch.tensor(left)]),
            )
            self.evidence, residuals = self._learn_scales(data.part(places), ITERATIONS)
            self.posterior = posterior(data, self.theta, self.blocks)
            self.fitted = True
            means, variances = from_others(data, self.theta, self.posterior, LEAST_LEFT[0])
            mean, variance = means[:count], variances[:count]
            apart, apart_variance = means[count:], variances[count:]
            if verdicts is not None and turn < turns - 1:
                verdicts, factor, shift = verdicts.followed(scores, levels, mean, variance)
                mean, variance = mean * factor + shift, variance * factor**2
                apart, apart_variance = apart * factor, apart_variance * factor**2
        about = targets.levels[some] - targets.levels[some].mean() if count else np.zeros(0)
        total, off = float(about @ about), residuals[: len(some)]
        self.left_out_r2 = 1 - float(off @ off) / total if total > 0 else 0.0
        self.verdicts = verdicts

    def _begin_verdicts(self, sample: Sample, levels: F64) -> tuple[Verdicts, F64, F64]:
        """Where the turns of learning a scale of verdicts begin.

        Returns:
            The scale, and mean and variance (S,) of the levels before their verdicts.
        """
        scores, known = sample.scores, self.verdicts
        if known is None or not np.array_equal(known.values, np.unique(scores)):
            verdicts = Verdicts.first(scores, levels)
            mean = np.full(len(scores), levels.mean())
        else:
            verdicts = known
            mean = self._predicted(sample)
        return verdicts, mean, np.full(len(scores), verdicts.spread)

    def _fit_verdicts(self, sample: Sample, levels: F64, some: I64) -> None:
        """Fit to what verdicts state of levels, and learn their scale: in turns."""
        scores = sample.scores
        verdicts, mean, variance = self._begin_verdicts(sample, levels)
        best, since, before = self, 0, -math.inf
        for turn in range(MOST_TURNS):
            if turn:
                verdicts, factor, shift = verdicts.followed(scores, levels, mean, variance)
                mean, variance = mean * factor + shift, variance * factor**2
            targets = _sites(verdicts, scores, mean, variance)
            self._fit(sample, targets, some)
            mean, variance = self._left_out(sample, targets)
            self.verdicts = verdicts
            self.evidence = verdicts.log_likelihood(scores, mean, variance)
            if not turn or self.evidence > best.evidence:
                best, since = self._as_it_is(), 0
            else:
                since += 1
            if abs(self.evidence - before) < SETTLED or since >= IN_VAIN:
                break
            before = self.evidence
        if best.evidence > self.evidence + AS_LIKELY:
            vars(self).update(vars(best))

    def _as_it_is(self) -> 'Model':
        """A copy that stays as it is: only the link changes in place."""
        made = copy.copy(self)
        made.link = copy.copy(self.link)
        return made

    def _fit(self, sample: Sample, targets: 'Targets', some: I64) -> None:
        places = torch.tensor(some)
        if self.link.linear:
            data = self._linear(sample, targets)
            self.evidence, residuals = self._learn_scales(data.part(places), ITERATIONS)
            self.posterior = posterior(data, self.theta, self.blocks)
        else:
            self.evidence, residuals = self._rounds(sample, targets, places)
        self.fitted = True
        y = targets.levels[some]
        about = y - y.mean()
        total = float(about @ about)
        self.left_out_r2 = 1 - float(residuals @ residuals) / total if total > 0 else 0.0

    def _linear(self, sample: Sample, targets: 'Targets') -> Linear:
        """The regression where F is the mean, or as much of it as a segment is of a whole one."""
        levels, spread = torch.tensor(targets.levels), torch.tensor(1 / sample.m)
        rows = sample.means()
        if self.link.ordinal:
            shares = torch.tensor(self.link.shares(sample.m))
            rows, spread = rows * shares[:, None], spread * shares**2
        return Linear(rows, spread, levels, noise=targets.noise)

    def _predicted(self, sample: Sample) -> F64:
        """Levels (S,) that the posterior mean lets expect."""
        if self.link.linear:
            predicted: F64 = (sample.means() @ self.posterior.mean).numpy()
            return predicted * self.link.shares(sample.m) if self.link.ordinal else predicted
        f = of_steps(sample.steps(), self.posterior.mean)
        return self.link.forward(f, sample.starts, sample.m)[0]

    def _left_out(self, sample: Sample, targets: 'Targets') -> tuple[F64, F64]:
        """Mean and variance (S,) of each level, as predicted from all other scores."""
        if self.link.linear:
            data, predicted = self._linear(sample, targets), self._predicted(sample)
        else:
            f = of_steps(sample.steps(), self.posterior.mean)
            predicted, slopes = self.link.forward(f, sample.starts, sample.m)
            data = self._linearised(sample, slopes, targets.levels, targets.noise)
        noises = noise(self.theta, data)
        variances = self.posterior.variances(data.rows)
        left = (1 - variances / noises).clamp_min_(LEAST_LEFT[not self.link.linear])
        off = targets.levels - predicted
        own = noises - data.noise  # of the level itself, which a verdict is about
        mean: F64 = targets.levels - off / left.numpy()
        return mean, (variances / left + own).numpy()

    @staticmethod
    def _linearised(
        sample: Sample, slopes: F64, targets: F64, own: Tensor | float, known: F64 | None = None
    ) -> Linear:
        """The regression with the slopes J (N,) of F."""
        return Linear(
            gathered(sample.steps(), slopes, sample.m),
            torch.tensor(np.add.reduceat(slopes * slopes, sample.starts)),
            torch.tensor(targets),
            None if known is None else torch.tensor(known),
            own,
        )

    def _rounds(self, sample: Sample, targets: 'Targets', places: Tensor) -> tuple[float, Tensor]:
        """Gauss-Newton, from where it stands, or from the best of several beginnings."""
        if self.fitted:
            return self._further(sample, targets, places, ROUNDS[1])
        several = isinstance(self.link, SoftMax) and len(sample.m) <= FEW
        before, begun = (self.link, self.theta, self.posterior), []
        for heats in HEATS if several else HEATS[:1]:
            self.fitted = False
            self.link, self.theta, self.posterior = copy.copy(before[0]), *before[1:]
            result = self._begin(sample, targets, places, heats)
            begun.append((result, (self.link, self.theta, self.posterior)))
        result, after = max(begun, key=lambda one: one[0][0])
        self.link, self.theta, self.posterior = after
        return result

    def _begin(
        self, sample: Sample, targets: 'Targets', places: Tensor, heats: Sequence[float]
    ) -> tuple[float, Tensor]:
        """A first fit: at first as if the score were a mean, then annealed."""
        self._round(sample, targets, places, first=True)
        self.fitted = True
        if isinstance(self.link, SoftMax):
            for self.link.heat in heats:
                for _ in range(HEAT_ROUNDS):
                    self._round(sample, targets, places)
            self.link.heat = 1.0
        return self._further(sample, targets, places, ROUNDS[0], learn=True)

    def _further(
        self, sample: Sample, targets: 'Targets', places: Tensor, rounds: int, learn: bool = False
    ) -> tuple[float, Tensor]:
        """Some rounds, in the first of which the scales are learnt, or in all of them."""
        for number in range(rounds - 1):
            self._round(sample, targets, places, learn=learn or number == 0)
        return self._round(sample, targets, places, learn=learn or rounds == 1, last=True)

    def _round(
        self,
        sample: Sample,
        targets: 'Targets',
        places: Tensor,
        first: bool = False,
        learn: bool = True,
        last: bool = False,
    ) -> tuple[float, Tensor]:
        """Linearise F at the present f, learn the scales, take the step that fits best.

        The posterior's covariance is that of the last round.
        """
        link, m, starts = self.link, sample.m, sample.starts
        if first:
            data = self._linear(sample, targets)
            result = self._learn_scales(data.part(places), ITERATIONS[:1])
            self.posterior = posterior(data, self.theta, self.blocks, spread=False)
            return result
        f = of_steps(sample.steps(), self.posterior.mean)
        level, slopes = link.forward(f, starts, m)
        z = targets.levels - level + np.add.reduceat(slopes * f, starts)
        learnt = isinstance(link, SoftMax) and link.learnt and link.heat == 1.0
        column = None
        if learnt:
            assert isinstance(link, SoftMax)
            column = link.beta_slope(f, starts, m)
            z = z + column * link.log_ratio
        data = self._linearised(sample, slopes, z, targets.noise, column)
        result = self._learn_scales(data.part(places), ITERATIONS if learn else (0, 0))
        new = posterior(data, self.theta, self.blocks, spread=last)
        noises = noise(self.theta, data).numpy()
        self._step(sample, targets.levels, f, new, noises, learnt)
        return result

    def _step(
        self, sample: Sample, y: F64, f: F64, new: Posterior, noises: F64, learnt: bool
    ) -> None:
        """Go as far towards the new weights as makes the penalised loss least."""
        link, size = self.link, self.blocks[-1].stop
        now = self.posterior.mean
        away = new.mean[:size] - now
        along = of_steps(sample.steps(), away)
        variances = prior_variances(self.theta, self.blocks)
        ratio = link.log_ratio if isinstance(link, SoftMax) else 0.0
        turn = float(new.mean[-1]) - ratio if learnt else 0.0
        losses = []
        for length in STEPS:
            if isinstance(link, SoftMax):
                link.move(ratio + length * turn)
                loss = link.log_ratio**2
            else:
                loss = 0.0
            off = y - link.forward(f + length * along, sample.starts, sample.m)[0]
            weights = now + length * away
            loss += float((off * off / noises).sum()) + float((weights**2 / variances).sum())
            losses.append(loss)
        best = STEPS[int(np.argmin(losses))]
        if isinstance(link, SoftMax):
            link.move(ratio + best * turn)
        self.posterior = Posterior(now + best * away, new.covariance[:size, :size])

    def _learn_scales(self, data: Linear, iterations: Sequence[int]) -> tuple[float, Tensor]:
        """The scales' evidence, and the residuals of scores that were left out."""
        evidence = Evidence(data, self.blocks)
        most = iterations[-1] if self.fitted else iterations[0]
        if most:
            self.theta, value = scales.learn(evidence, self.theta, most)
        else:
            value = -evidence(self.theta)[0]
        return value, evidence.left_out(self.theta)

    def labels(self, f: F64, scores: F64, m: I64) -> F64:
        """Step rewards (N,) that explain the scores, in units of `scale`; f without a score. From
        all of them `zero` is taken off.

        Args:
            f: (N,) of the segments' steps, one segment after the other.
            scores: (S,) of the segments; NaN where there is none.
            m: (S,) their steps.
        """
        missing = np.isnan(scores)
        level = self.due(f, np.where(missing, 0.0, scores), m)
        shift = self.link.shift(f, level, np.cumsum(m) - m, m)
        labels: F64 = f - self.zero + np.repeat(np.where(missing, 0.0, shift), m)
        return labels

    def due(self, f: F64, scores: F64, m: I64) -> F64:
        """The levels (S,) of scores; of verdicts, those to be expected of steps with rewards f."""
        if self.verdicts is None:
            return self.link.level(scores, m) / self.scale
        mean = self.link.forward(f, np.cumsum(m) - m, m)[0]
        return self.verdicts.expected(scores, mean, self.verdicts.spread)[0]

    def scores(self, f: F64, m: I64) -> F64:
        """The scores (S,) that step rewards f (N,) let expect, in the task's unit."""
        level = self.link.forward(f, np.cumsum(m) - m, m)[0]
        if self.verdicts is None:
            return self.link.score(level * self.scale, m)
        return self.verdicts.mean_value(level)


def _sites(verdicts: Verdicts, scores: F64, mean: F64, variance: F64) -> Targets:
    """What verdicts state of levels, within bounds."""
    levels, left = verdicts.sites(scores, mean, variance)
    deviation = math.sqrt(float(np.var(mean) + np.mean(variance)))
    middle, far = float(mean.mean()), FARTHEST * deviation
    levels = np.clip(levels, middle - far, middle + far)
    left = np.maximum(left, (SUREST * deviation) ** 2)
    return Targets(levels, torch.tensor(left))


def of_steps(steps: Tensor, weights: Tensor) -> F64:
    """The products phi . w (N,) of steps."""
    f: F64 = (steps @ weights.float()).double().numpy()
    return f
