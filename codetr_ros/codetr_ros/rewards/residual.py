"""CoDeTr on what is left: a transformer learns what single steps do not explain of the scores.

    level(R) = F(f(x_1) + g u_1, ..., f(x_m) + g u_m) + noise,    u_t = w_t rhat_t

f is the regression of method `evidence`, F its link, and u what CoDeTr's network makes of the
segment, 0 at first. rhat_t is linear in the causal state and in f(x_t).

What is left of scores is often a product of what two steps did, whose factors alone explain
nothing: no gradient leads there. A second head, which labels do without, learns the whole score
from the same causal states, where the factors do explain something.

Where scores depend on single steps alone there is nothing to learn, and what the network takes
from noise must not do harm. So a fifth of the scores is kept from it, and the gate g in [0, 1] is
how much of u these scores ask for: 0 unless they do so by two standard errors. Then labels are
those of `evidence`, bit for bit.

The formula beside its symbols: docs/methods.md#codetr-on-what-is-left. All of it is decided here.
"""

from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from codetr_ros.config import CodetrSettings, Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64, I64
from codetr_ros.rewards.base import ModelFacts, RewardMethod, RewardModelError, segment_steps
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.rewards.evidence.method import Evidence
from codetr_ros.rewards.evidence.sample import scrambled
from codetr_ros.rewards.transformer import RewardTransformer, initialise
from codetr_ros.system.states import check_state

SHARE = 5
"""One of so many scores is kept from the network."""
JUDGES = 256
"""The most scores by which the gate is set: the newest of those."""
EVERY = 10
"""Gradient steps between two settings of the gate."""
ERRORS = 2.0
"""Standard errors from 0 at which the gate begins to open."""
BASE = 'base.'
"""What the names of the regression's tensors begin with."""


class CodetrOnEvidence(Codetr):
    """CoDeTr with `codetr.base: evidence`: its rewards are added to those of the regression.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    base_group: ClassVar[str] = 'evidence'
    """The group of settings that shape what lies below the network."""
    network: 'TransformerAbove'

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        self._base = Evidence(settings, observation_size, action_size)
        self._gate = 0.0
        self._let_in = 0
        self._explained = 0.0  # of what the regression leaves of the held-out scores, by g u
        super().__init__(settings, observation_size, action_size)

    @property
    def uses_preferences(self) -> bool:  # type: ignore[override]
        """Whether the regression does."""
        return self._base.uses_preferences

    def set_aside(self, memory: Trajectories) -> dict[str, int]:
        """What the regression sets aside: the network does not learn from judgements itself."""
        return self._base.set_aside(memory)

    @property
    def version(self) -> int:
        """Fits of the regression, and gradient steps whose outcome the gate lets in."""
        return self._base.version + self._let_in

    def prepare(self, memory: Trajectories) -> None:
        """Fit the regression; freeze the moments of the observations, the first time."""
        self._base.prepare(memory)
        super().prepare(memory)
        self.target_scale = self._base.target_scale

    # ------------------------------------------------------------------------------------------
    # learning

    def _make_network(self, observation_size: int, action_size: int) -> 'TransformerAbove':
        return TransformerAbove(observation_size, action_size, self._positions, self._codetr)

    def gradient_step(self, memory: Trajectories, rng: np.random.Generator) -> dict[str, float]:
        """A step of AdamW on scores that are not held out; every so many set the gate anew."""
        metrics = super().gradient_step(memory, rng)
        opened = self._gate > 0
        if self.gradient_steps % EVERY == 0:
            self._judge(memory)
        self._let_in += opened or self._gate > 0
        return metrics

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        ids = memory.segments.ids()
        taught = ids[~held_out(ids)]
        if not len(taught):  # few scores, and by chance all of them held out
            yield {'reward_loss': 0 * self.network.reward.bias.sum()}
            return
        drawn = taught[rng.integers(0, len(taught), self._codetr.batch)]
        batch = memory.segments.batch(drawn, self.context)
        for part in self._parts(batch):
            inside = segment_steps(part)
            f = self._base.mean(part)
            due = self._due(part, f)
            weights, rewards, whole = self.network.heads(*self._inputs(part), self._beside(part))
            own = self._put(inside)
            squares = {
                'reward_loss': self._squares(part, due, f, (weights * rewards)[own]),
                'score_loss': self._squares(part, due, 0 * f, (weights * whole)[own]),
            }
            yield {name: value / len(drawn) for name, value in squares.items()}

    def _preference_terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        """None: the regression learns from preferences, the network from what it leaves."""
        yield from ()

    def _squares(self, batch: SegmentBatch, due: F64, f: F64, u: Tensor) -> Tensor:
        """The sum of squares of due levels (b,) less those of the step rewards f + u (N,)."""
        level, slopes = self._levels(batch, f + u.detach().cpu().double().numpy())
        off = self._put((level - due).astype(np.float32))  # (b,)
        segment = self._put(np.nonzero(segment_steps(batch))[0])  # (N,)
        # F is not torch's: its slopes at f + u make the gradient exact
        along = self._put(slopes.astype(np.float32)) * (u - u.detach())
        return off.index_add(0, segment, along).square().sum()

    def _beside(self, batch: SegmentBatch) -> Tensor:
        """What the regression makes of the segments' steps (B, L), 0 elsewhere."""
        inside = segment_steps(batch)
        f = np.zeros(inside.shape, np.float32)
        f[inside] = self._base.mean(batch)
        return self._put(f)

    def _due(self, batch: SegmentBatch, f: F64) -> F64:
        """The levels (B,) of the scores of segments whose steps have f (N,)."""
        return self._base.model.due(f, batch.values, batch.lengths - batch.context)

    def _levels(self, batch: SegmentBatch, rewards: F64) -> tuple[F64, F64]:
        """The levels (B,) of step rewards (N,), and their slopes (N,)."""
        m = batch.lengths - batch.context
        return self._base.model.link.forward(rewards, np.cumsum(m) - m, m)

    def _judge(self, memory: Trajectories) -> None:
        """Set the gate by the scores that are held out."""
        ids = memory.segments.ids()
        held = ids[held_out(ids)][-JUDGES:]
        left = found = np.empty(0)
        if len(held):
            batch = memory.segments.batch(held, self.context)
            f = self._base.mean(batch)
            w, rhat = self.components(batch)
            u = (w * rhat)[segment_steps(batch)].astype(np.float64)
            single = self._levels(batch, f)[0]
            left, found = self._due(batch, f) - single, self._levels(batch, f + u)[0] - single
        self._gate, self._explained = gate(left, found)

    # ------------------------------------------------------------------------------------------
    # asking

    def components(self, batch: SegmentBatch) -> tuple[F32, F32]:
        """Weights w and rewards rhat of what is left (B, L), before the gate."""
        self._require_prepared()
        self.network.eval()
        with torch.inference_mode():
            parts = [
                self.network.heads(*self._inputs(part), self._beside(part))[:2]
                for part in self._parts(batch)
            ]
        outside = ~segment_steps(batch)
        w, rhat = (torch.cat(each).cpu().numpy() for each in zip(*parts, strict=True))
        w[outside], rhat[outside] = 0, 0
        return w, rhat

    def label_passes(self, memory: Trajectories, ids: NDArray[np.int64]) -> Iterator[F32]:
        """Labels of whole segments."""
        yield from RewardMethod.label_passes(self, memory, ids)

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) that explain each segment's score, 0 elsewhere.

        Raises:
            RewardModelError: `prepare` was never called.
        """
        self._require_prepared()
        inside, m = segment_steps(batch), batch.lengths - batch.context
        rewards = self._base.mean(batch)
        if self._gate:
            w, rhat = self.components(batch)
            u = w * rhat if self._codetr.label == 'product' else rhat
            rewards = rewards + self._gate * u[inside]
        explained = self._base.model.labels(rewards, batch.values, m)
        labels = np.zeros(inside.shape, np.float32)
        labels[inside] = explained * (self._base.model.scale / self.unit)
        return labels

    def predict(self, batch: SegmentBatch) -> F64:
        """The composite rewards (B,) that the steps let expect, in the task's unit."""
        self._require_prepared()
        w, rhat = self.components(batch)
        u = (w * rhat)[segment_steps(batch)].astype(np.float64)
        rewards = self._base.mean(batch) + self._gate * u
        return self._base.model.scores(rewards, batch.lengths - batch.context)

    def doubt(self, batch: SegmentBatch) -> F64:
        """What the regression does not know of the levels of segments' scores (B, B)."""
        return self._base.doubt(batch)

    def metrics(self) -> dict[str, float]:
        """What the regression has to publish, the gate, and what it lets in explains."""
        return self._base.metrics() | {'gate': self._gate, 'gate_explains': self._explained}

    def report(self) -> ModelFacts:
        """What the regression reports, the gate, and what it lets in explains."""
        return {**self._base.report(), 'gate': self._gate, 'gate_explains': self._explained}

    # ------------------------------------------------------------------------------------------
    # saving

    def state(self) -> dict[str, Tensor]:
        """Network and gate, and the regression below."""
        numbers = {'gate': self._gate, 'gate_explains': self._explained}
        return {
            **super().state(),
            **{name: torch.tensor(n, dtype=torch.float64) for name, n in numbers.items()},
            'let_in': torch.tensor(self._let_in, dtype=torch.int64),
            **{f'{BASE}{name}': tensor for name, tensor in self._base.state().items()},
        }

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's or task's; nothing has changed then.
        """
        check_state(f'reward method {self.name!r}', self.state(), state, RewardModelError)
        below = {
            name.removeprefix(BASE): tensor
            for name, tensor in state.items()
            if name.startswith(BASE)
        }
        self._base.load_state(below)
        super().load_state(state)
        self._gate, self._let_in = float(state['gate']), int(state['let_in'])
        self._explained = float(state['gate_explains'])


class TransformerAbove(RewardTransformer):
    """The reward transformer with rewards that begin at 0, and a second head for whole scores."""

    def __init__(
        self, observation_size: int, action_size: int, positions: int, settings: CodetrSettings
    ) -> None:
        super().__init__(observation_size, action_size, positions, settings)
        nn.init.zeros_(self.reward.weight)
        self.single = nn.Parameter(torch.zeros(()))  # the weight of f(x_t)
        self.whole = nn.Linear(settings.embedding, 1)
        initialise(self.whole, settings)

    def heads(
        self, observations: Tensor, actions: Tensor, inside: Tensor, f: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Weights w, rewards of what is left and of the whole score, (B, L) each.

        Args:
            observations: (B, L, O) before each step.
            actions: (B, L, A).
            inside: (B, L) bool, the steps that attend to each other; at least one in each row.
            f: (B, L) what the regression makes of each step.
        """
        x = self.causal(observations, actions)  # (B, L, d)
        rewards = self.reward(x).squeeze(-1) + self.single * f
        return self.weights(x, inside), rewards, self.whole(x).squeeze(-1)


def held_out(ids: I64) -> NDArray[np.bool_]:
    """Which segments (B,) the network never learns from: the same whatever the seed."""
    held: NDArray[np.bool_] = scrambled(ids, 0) % np.uint64(SHARE) == 0
    return held


def gate(left: F64, found: F64) -> tuple[float, float]:
    """How much of what was found to let in, by scores that had no part in finding it.

    The factor that explains most of what is left, in [0, 1], shrunk towards 0 by its own standard
    error: it is 0 up to `ERRORS` of them.

    Args:
        left: (S,) what is left of the held-out scores.
        found: (S,) what was found of it.

    Returns:
        The gate, and the share of the squares of `left` that it explains.
    """
    power, total = float(found @ found), float(left @ left)
    if len(left) < 3 or power <= 0 or total <= 0:
        return 0.0, 0.0
    factor = float(left @ found) / power
    rest = left - factor * found
    error = float(rest @ rest) / (len(left) - 1) / power  # its variance
    shrunk = max(0.0, 1 - ERRORS**2 * error / factor**2) if factor > 0 else 0.0
    opened = min(1.0, factor) * shrunk
    rest = left - opened * found
    return opened, 1 - float(rest @ rest) / total
