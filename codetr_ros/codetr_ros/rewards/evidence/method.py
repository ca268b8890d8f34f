"""The method `evidence`: step rewards as the posterior mean of a Bayesian regression on scores.

    f(x) = sum_b phi_b(x) . w_b,  w_b ~ N(0, lam_b I),  x = (s', a, s' - s)
    r_t = f(x_t) + N(0, v_r),  level(R) = F(r_1, ..., r_m) + N(0, v_0)

It takes no gradient steps: in each phase with new scores `prepare` fits it in closed form, or in
a few rounds of Gauss-Newton where F is not linear. A label is f(x_t) plus one number for all of a
segment's steps, such that F(labels) is the level of the score: labels explain each score exactly,
and where the regression knows nothing they are the even spread: docs/methods.md#evidence.

A close relative is GP-LRR (arXiv 2503.17409), whose leave-one-out likelihood is followed by
gradients; here the evidence is made large in closed form. The modules of this package state what
is from our trial of the method and what is decided here.
"""

import copy
from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit
from torch import Tensor

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.judgements import Pairs
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64, I64
from codetr_ros.rewards.base import ModelFacts, Predictor, RewardModelError, segment_steps
from codetr_ros.rewards.evidence import links, saving
from codetr_ros.rewards.evidence.choice import choose
from codetr_ros.rewards.evidence.features import PIECE, Features, ends_of, step_inputs
from codetr_ros.rewards.evidence.link import Link
from codetr_ros.rewards.evidence.maxima import SoftMax
from codetr_ros.rewards.evidence.model import Model, of_steps
from codetr_ros.rewards.evidence.pairs import fit_pairs
from codetr_ros.rewards.evidence.sample import Sample, Sampler, chosen
from codetr_ros.rewards.evidence.uncertainty import (
    Uncertainty,
    deviations,
    levels,
    step_deviations,
)
from codetr_ros.rewards.evidence.verdicts import are_verdicts, require_few_values
from codetr_ros.seeding import generator
from codetr_ros.system.states import check_state

CLOSE = 0.05
"""Of the likeliest link's probability: from such a share on the next one is mixed in."""
SECOND = 'second.'
"""What the names of that one's tensors begin with."""
ZEROS = ('zero', SECOND + 'zero')
NEWEST, NEWEST_STEPS = 64, 1000
"""The newest segments, and their steps, of which metrics state how sure the fit is."""
SHOWN = 5
"""Features in a summary: those with which the step reward changes most."""


class Evidence(Predictor):
    """Bayesian regression of scores on features of single steps, through a link.

    Everything is computed on the CPU, on the threads that torch may use: with other numbers of
    these the last bits may differ.
    """

    name: ClassVar[str] = 'evidence'
    group: ClassVar[str] = 'evidence'
    label_batch: int = 64

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__(settings, observation_size, action_size)
        self._own = settings.evidence
        self._features = Features(
            observation_size, action_size, settings.seed, self._own.terminal_feature
        )
        self._sampler = Sampler(self._features)
        self._model = self._new_model()
        self._second: Model | None = None  # of the link that is nearly as likely
        self._fits = 0
        self._seen = 0  # digest of the scores of the last fit
        self._begun_at = 0  # scores that there were when a fit was last begun anew; 0: never
        self._probability = 1.0
        self._margin = 0.0
        self._step_sd = self._segment_sd = 0.0

    def _new_model(self) -> Model:
        settings = self._settings
        link = links.make(settings.composite, settings.beta, settings.longest, self._ordinal)
        return Model(link, self._features.blocks)

    @property
    def _ordinal(self) -> bool:
        asked, settings = self._own.score_scale, self._settings
        given = settings.score_levels > 0 or settings.scored_elsewhere
        return asked == 'ordinal' or (asked == 'auto' and given)

    @property
    def version(self) -> int:
        """Fits so far: phases in which there were other scores than before."""
        return self._fits

    @property
    def link(self) -> Link:
        """From step rewards to scores: the known one, or the one chosen last."""
        return self._model.link

    def prepare(self, memory: Trajectories) -> None:
        """Fit to the scores that the memory holds, unless they are those of the last fit.

        Raises:
            RewardModelError: the regression has failed on numbers that are too large.
        """
        pairs = self._pairs(memory)
        all_ids = memory.segments.ids()
        scores = memory.segments.scores(all_ids)
        seen = memory.segments.digest() ^ (0 if pairs is None else pairs.digest())
        if self._fits and seen == self._seen:
            return
        ordinal = self._are_verdicts(memory, scores)
        if pairs is not None:
            self._fit_pairs(memory, pairs, ordinal)
            self._seen = seen
            return
        anew = len(all_ids) >= 2 * self._begun_at
        choosing = anew and self._own.link == 'choose'
        steps = choosing or not all(model.link.linear for _, model in self._mixture)
        ids = self._ids(memory, all_ids, steps)
        moments = self._sampler.moments(memory, ids)
        if not self._fits or self._features.moments.moved(moments):
            self._features.renew(moments)
            self._sampler.forget()
        sample = self._sampler.sample(memory, ids, steps)
        rng = generator(self._settings.seed, 'evidence', 'scales', self._fits)
        some = np.sort(rng.permutation(len(ids))[: self._own.scale_scores])
        try:
            if choosing:
                self._choose(sample, some, ordinal)
            else:
                self._model.measure(scores, memory.segments.lengths(all_ids), ordinal)
                self._model = self._fit(self._model, sample, some, anew, ordinal)
                if self._second is not None:
                    self._second = self._fit(self._second, sample, some, anew, ordinal)
        except FloatingPointError as error:
            raise RewardModelError(
                f'method {self.name!r}: the regression on {len(ids)} scores between '
                f'{scores.min():g} and {scores.max():g} has failed, {error}. Look for scores '
                'that are far off the others, or scale the rewards of the task'
            ) from None
        self.target_scale = self._model.scale if self._settings.target_scale == 'rms' else 1.0
        if anew:
            self._begun_at = len(all_ids)
        self._seen = seen
        self._fits += 1
        self._look_back(memory, ids)

    @property
    def uses_preferences(self) -> bool:  # type: ignore[override]
        """Whether the kind of score is known and linear in step rewards."""
        return self._own.link != 'choose' and self._model.link.linear

    def _are_verdicts(self, memory: Trajectories, scores: F64) -> bool:
        """Whether only the order of scores (S,) means anything.

        Raises:
            RewardModelError: the settings say so of the simulator's, which have many values.
        """
        if not self._ordinal:
            return False
        if memory.judgements is not None:
            return are_verdicts(scores, self._own.score_scale == 'ordinal')
        require_few_values(scores)
        return True

    def _pairs(self, memory: Trajectories) -> Pairs | None:
        """The preferences to learn from; None where there are none, or none can be used."""
        if memory.judgements is None or not self.uses_preferences:
            return None
        return memory.judgements.pairs() or None

    def _fit_pairs(self, memory: Trajectories, pairs: Pairs, ordinal: bool) -> None:
        scores = len(memory.segments.ids())
        if scores and self._model.scale == 1.0:  # that of preferences alone, which have no unit
            self._model = self._new_model()
        how = (self._features, self._sampler, memory, pairs, self._settings, self._fits)
        try:
            seen = fit_pairs(self._model, *how, ordinal)
        except FloatingPointError as error:
            raise RewardModelError(
                f'method {self.name!r}: the regression on {scores} scores and {len(pairs)} '
                f'preferences has failed, {error}. Look for scores that are far off the others'
            ) from None
        self.target_scale = self._model.scale if self._settings.target_scale == 'rms' else 1.0
        self._fits += 1
        self._look_back(memory, seen)

    def _look_back(self, memory: Trajectories, ids: I64) -> None:
        """How sure the fit is of what came last: of a bounded number of steps."""
        newest = ids[-NEWEST:]
        ends = np.cumsum(memory.segments.lengths(newest)[::-1])
        count = max(1, int((ends <= NEWEST_STEPS).sum()))
        batch = memory.segments.batch(newest[-count:], self.context)
        found = self.uncertainty(batch)
        self._step_sd = float(found.steps[segment_steps(batch)].mean())
        self._segment_sd = float(found.segments.mean())

    def _ids(self, memory: Trajectories, ids: I64, steps: bool) -> I64:
        """Segments to learn from: a bounded number, and of bounded steps if these are kept."""
        most = self._own.scores
        if steps:
            mean = float(memory.segments.lengths(ids).mean())
            most = min(most, max(2, int(self._own.steps / mean)))
        return chosen(ids, most, self._settings.seed)

    def _fit(self, before: Model, sample: Sample, some: I64, anew: bool, ordinal: bool) -> Model:
        """Go on from the last fit, and where `anew` begin anew beside it: the likelier one stays.

        Where F is not linear, a fit to few scores may lead to a place that later fits never leave.
        """
        fresh = Model(copy.copy(before.link), before.blocks)
        again = anew and before.fitted and not before.link.linear
        before.fit(sample, some, ordinal)
        if again:
            fresh.scale = before.scale
            fresh.fit(sample, some, ordinal)
        return fresh if again and fresh.evidence > before.evidence else before

    def _choose(self, sample: Sample, some: I64, ordinal: bool) -> None:
        choice = choose(sample, some, self._features.blocks, ordinal)
        best, second = choice.order[:2]
        self._model = choice.models[best]
        close = choice.probabilities[second] > CLOSE * choice.probabilities[best]
        self._second = choice.models[second] if close else None
        self._probability = choice.probabilities[best]
        self._margin = choice.margin

    @property
    def _mixture(self) -> list[tuple[float, Model]]:
        """The regressions of which labels are made, and the share of each."""
        if self._second is None:
            return [(1.0, self._model)]
        second = float(expit(self._second.evidence - self._model.evidence))
        return [(1 - second, self._model), (second, self._second)]

    # ------------------------------------------------------------------------------------------
    # asking

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) that explain each segment's score, 0 elsewhere.

        Where there is no score to explain, what is not known is not worth trying out: a step's
        reward is the lower, the less is known of it (`evidence.caution`).

        Raises:
            RewardModelError: `prepare` was never called.
        """
        self._require_prepared()
        inside = segment_steps(batch)
        m = batch.lengths - batch.context
        labels = np.zeros(inside.shape, np.float32)
        labels[inside] = sum(
            model.labels(self._f(batch, model), batch.values, m)
            * (share * model.scale / self.unit)
            for share, model in self._mixture
        )
        unscored = inside & np.isnan(batch.values)[:, None]
        if self._own.caution and unscored.any():
            labels[unscored] -= self._own.caution * self._doubt_beyond_usual(batch, unscored)
        return labels

    def _doubt_beyond_usual(self, batch: SegmentBatch, steps: NDArray[np.bool_]) -> F64:
        """How much less sure (N,) the likelier link is of steps than of the newest scored ones."""
        features = (self._features(piece) for piece in self._inputs(batch, steps))
        found = step_deviations(self._model, features) * (self._model.scale / self.unit)
        return found - self._step_sd

    def predict(self, batch: SegmentBatch) -> F64:
        """The composite rewards (B,) that the steps alone let expect, in the task's unit.

        Raises:
            RewardModelError: `prepare` was never called.
        """
        self._require_prepared()
        m = batch.lengths - batch.context
        parts = [share * model.scores(self._f(batch, model), m) for share, model in self._mixture]
        scores: F64 = np.sum(parts, 0)
        return scores

    def uncertainty(self, batch: SegmentBatch) -> Uncertainty:
        """How far the rewards of segments' steps may be off: ask for scores where it is large.

        With two links it is that of the likelier one.

        Raises:
            RewardModelError: `prepare` was never called.
        """
        self._require_prepared()
        inside = segment_steps(batch)
        features = [self._features(piece) for piece in self._inputs(batch, inside)]
        found = deviations(self._model, features, batch.lengths - batch.context)
        factor = self._model.scale / self.unit
        steps = np.zeros(inside.shape, np.float32)
        steps[inside] = found.steps * factor
        return Uncertainty(steps, found.segments * factor)

    def doubt(self, batch: SegmentBatch) -> F64:
        """Covariance (B, B) of what scores would reveal of levels, of the likelier link's weights.

        A number reveals its level. Of a verdict that can be foreseen nothing is learnt.
        """
        self._require_prepared()
        model, m = self._model, batch.lengths - batch.context
        features = [self._features(piece) for piece in self._inputs(batch, segment_steps(batch))]
        found = levels(model, features, m)
        revealed = found.covariance * (model.scale / self.unit) ** 2
        if model.verdicts is None:
            return revealed
        share = model.verdicts.revealed(found.mean, found.variance)
        return revealed * np.sqrt(np.outer(share, share))

    def step_deviations(self, batch: SegmentBatch) -> F32:
        """How far each label (B, L) may be off, one standard deviation."""
        return self.uncertainty(batch).steps

    @property
    def model(self) -> Model:
        """The fitted regression; of two links, that of the likelier one."""
        return self._model

    def mean(self, batch: SegmentBatch) -> F64:
        """The posterior mean (N,) of segments' steps, in units of the level scale.

        Raises:
            RewardModelError: `prepare` was never called.
        """
        self._require_prepared()
        return self._f(batch, self._model)

    def _f(self, batch: SegmentBatch, model: Model) -> F64:
        """The posterior mean (N,) of segments' steps, in units of the level scale."""
        weights = model.posterior.mean
        pieces = self._inputs(batch, segment_steps(batch))
        return np.concatenate([of_steps(self._features(piece), weights) for piece in pieces])

    def _inputs(self, batch: SegmentBatch, inside: NDArray[np.bool_]) -> Iterator[F32]:
        """What features are made of, of the steps (N,) of segments, in pieces."""
        before, after = batch.observations[:, :-1][inside], batch.observations[:, 1:][inside]
        ends = ends_of(batch)[inside] if self._features.ends else None
        inputs = step_inputs(before, batch.actions[inside], after, ends)
        for i in range(0, len(inputs), PIECE):
            yield inputs[i : i + PIECE]

    def metrics(self) -> dict[str, float]:
        """How well the regression knows the scores, after each phase."""
        if not self._fits:
            return {}
        model = self._model
        step_noise, score_noise = np.exp(model.theta[-2:]).tolist()
        factor = model.scale / self.unit
        known = {
            'evidence': model.evidence,
            'left_out_r2': model.left_out_r2,
            'step_sd': self._step_sd,
            'segment_sd': self._segment_sd,
            'step_noise_sd': step_noise**0.5 * factor,
            'score_noise_sd': score_noise**0.5 * factor,
            'link': float(links.NAMES.index(model.link.name)),
            'link_probability': self._probability,
            'link_margin': self._margin,
        }
        if model.verdicts is not None:
            known['verdict_noise_sd'] = model.verdicts.tau * factor
        if isinstance(model.link, SoftMax):
            known['beta'] = model.link.beta / model.scale
        return known

    def report(self) -> ModelFacts:
        """The link, how sure it is, and what rewards depend on most, for a run's summary."""
        if not self._fits:
            return {}
        factor, verdicts = self._model.scale / self.unit, self._model.verdicts
        effects = self._features.effects(self._model.posterior.mean)
        most = sorted(effects, key=lambda name: -abs(effects[name]))[:SHOWN]
        return {
            **self.metrics(),
            'link': self._model.link.name,
            **(
                {} if verdicts is None else {'thresholds': (verdicts.thresholds * factor).tolist()}
            ),
            **({} if self._second is None else {'mixed_with': self._second.link.name}),
            'link_is': 'chosen' if self._own.link == 'choose' else 'known',
            'depends_on': ', '.join(f'{name} {effects[name] * factor:+.2g}' for name in most),
        }

    # ------------------------------------------------------------------------------------------
    # saving

    def state(self) -> dict[str, Tensor]:
        """Features, moments, link, scales and posterior, and what has been seen."""
        counts = {'version': self._fits, 'seen': self._seen, 'begun_at': self._begun_at}
        numbers = {'link_probability': self._probability, 'link_margin': self._margin}
        numbers |= {'step_sd': self._step_sd, 'segment_sd': self._segment_sd}
        second: dict[str, Tensor] = {}
        if self._own.link == 'choose':
            counts['mixed'] = int(self._second is not None)
            second = saving.saved(self._second or self._new_model())
        return {
            **super().state(),
            **saving.saved(self._model),
            **{SECOND + name: tensor for name, tensor in second.items()},
            **{name: torch.tensor(n, dtype=torch.float64) for name, n in numbers.items()},
            **{name: torch.tensor(n, dtype=torch.int64) for name, n in counts.items()},
            'waves': self._features.waves.clone(),
            'phases': self._features.phases.clone(),
            'input_mean': self._features.mean.clone(),
            'input_std': self._features.std.clone(),
        }

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's or task's; nothing has changed then.
        """
        settings, features = self._settings, self._features
        own = self.state()
        # a model that was saved before there was one took every label for what it is
        state = {name: torch.zeros_like(own[name]) for name in own if name in ZEROS} | dict(state)
        check_state(f'reward method {self.name!r}', own, state, RewardModelError)
        how = (features.blocks, settings.beta, settings.longest)
        marked = {name: state[name] for name in state if name.startswith(SECOND)}
        other = {name.removeprefix(SECOND): tensor for name, tensor in marked.items()}
        try:
            model = saving.restored(state, *how)
            second = saving.restored(other, *how) if int(state.get('mixed', 0)) else None
        except ValueError as error:
            raise RewardModelError(f'state of method {self.name!r} refused: {error}') from None
        super().load_state(state)
        self._model, self._second = model, second
        self._fits, self._seen = int(state['version']), int(state['seen'])
        self._begun_at = int(state['begun_at'])
        self._probability = float(state['link_probability'])
        self._margin = float(state['link_margin'])
        self._step_sd, self._segment_sd = float(state['step_sd']), float(state['segment_sd'])
        features.waves, features.phases = state['waves'].clone(), state['phases'].clone()
        features.mean, features.std = state['input_mean'].clone(), state['input_std'].clone()
        self._sampler.forget()
