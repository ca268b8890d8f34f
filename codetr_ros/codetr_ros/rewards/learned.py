"""The base of methods with a network: targets in units of c, standardised inputs, AdamW."""

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from codetr_ros.config import CodetrSettings, PerceptronSettings, Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64
from codetr_ros.rewards.base import Predictor, RewardModelError, Schedule, segment_steps
from codetr_ros.seeding import seed_torch
from codetr_ros.system.devices import usable

STD_FLOOR = 1e-2
"""The least standard deviation by which an observation component is divided (decided here).

A component that stood still in the warm-up may move later, and must not drown the others then.
"""

CLIP = 10.0
"""Deviations at which standardised observations are cut off, if at all (decided here).

A component that hardly moved in the warm-up may later lie a thousand of its deviations away.
"""

PAIRS = 32
"""Preferences in a gradient step (decided here)."""
TEMPERATURE = 1.0
"""Difference of two segments' levels, in units of c, at which the better one is preferred with
odds of e (decided here).
"""


class Learned(Predictor):
    """A method that fits a network to composite rewards by gradient steps.

    Inside, composite rewards are in units of the target scale c, the root mean square composite
    reward per step of the warm-up: a positive constant, never a shift, so that the worth of
    survival keeps its sign. The network sees observations standardised by the moments of the
    warm-up.

    Preferences between two segments are learnt by the model of Bradley and Terry (1952), as in
    Christiano et al. (2017): the odds of the better one are exp of the difference of their levels,
    which are predicted scores per step of the longest segment. Their loss is added to that of
    scores: docs/methods.md#preferences.

    A subclass defines its network, the terms of its loss, and the step rewards that it reads off.

    The network lies on `device`, that of the setting `reward_device`. Batches are made on the CPU
    and copied there (but see `DeviceSteps`), and labels come back. A state loads on any device.

    Raises:
        DeviceError: there is no such device here.
    """

    group: ClassVar[str]
    """The group of settings by which it is trained."""
    uses_preferences: ClassVar[bool] = True
    clip: ClassVar[float] = math.inf
    """Deviations from the mean beyond which standardised observations are cut off.

    Finite for networks that do not normalise their inputs themselves (the transformer does), and
    where observations are predicted.
    """

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__(settings, observation_size, action_size)
        self._own: CodetrSettings | PerceptronSettings = getattr(settings, self.group)
        self.gradient_norm = math.inf
        """The longest gradient; longer ones are shortened to it."""
        self.device = usable(settings.reward_device, 'reward_device')
        self._mean = torch.zeros(observation_size, device=self.device)
        self._std = torch.ones(observation_size, device=self.device)
        seed_torch(settings.seed, self.name, 'init')
        # drawn on the CPU: the same initial weights on each device
        self.network = self._make_network(observation_size, action_size).to(self.device)
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(),
            lr=self._own.learning_rate,
            weight_decay=self._own.weight_decay,
            fused=True,
        )
        for parameter in self.network.parameters():
            # from the start, so that every state has the same tensors
            self._optimiser.state[parameter] = {
                'step': torch.zeros((), device=self.device),
                'exp_avg': torch.zeros_like(parameter),
                'exp_avg_sq': torch.zeros_like(parameter),
            }

    @abstractmethod
    def _make_network(self, observation_size: int, action_size: int) -> nn.Module:
        """The network, with weights drawn from torch's global generator."""

    @abstractmethod
    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        """The loss of one batch, part by part: scalars by name, whose total is minimised."""

    def _all_terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        """Those of scores and of preferences, as far as there are any."""
        if len(memory.segments.ids()):
            yield from self._terms(memory, rng)
        yield from self._preference_terms(memory, rng)

    def _preference_terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        """The loss of one batch of preferences."""
        pairs = None if memory.judgements is None else memory.judgements.pairs()
        if not pairs:
            return
        drawn = rng.integers(0, len(pairs), PAIRS)
        first, second = (
            self._predicted(memory.segments.batch(ids[drawn], self.context))
            for ids in (pairs.first, pairs.second)
        )
        odds = (first - second) / (self._settings.longest * TEMPERATURE)  # logarithms of them
        outcomes = self._put(pairs.outcomes[drawn].astype(np.float32))
        yield {'preference_loss': F.binary_cross_entropy_with_logits(odds, outcomes)}

    def _predicted(self, batch: SegmentBatch) -> Tensor:
        """Predicted scores (B,) in units of c, with their gradient."""
        inside = self._put(segment_steps(batch))
        return (self._step_rewards(batch) * inside).sum(1)

    @abstractmethod
    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        """Step rewards (B, L) in units of c, of any value outside the segments."""

    def _parts(self, batch: SegmentBatch) -> Sequence[SegmentBatch]:
        """The batch in parts, to be processed one after the other."""
        return [batch]

    def _learning_rate(self) -> float:
        """The learning rate of the next gradient step."""
        return self._own.learning_rate

    @property
    def schedule(self) -> Schedule:
        """Gradient steps of a phase, by the settings."""
        return Schedule(self._own.first_gradient_steps, self._own.gradient_steps)

    def prepare(self, memory: Trajectories) -> None:
        """Freeze the target scale c and the moments of the observations, the first time."""
        if self.target_scale:
            return
        super().prepare(memory)
        if self._own.normalise_observations:
            mean, std = memory.store.observation_moments()
            self._mean = self._put(mean.astype(np.float32))
            self._std = self._put(np.maximum(std, STD_FLOOR).astype(np.float32))

    def gradient_step(self, memory: Trajectories, rng: np.random.Generator) -> dict[str, float]:
        """One AdamW step on the loss of a batch.

        Returns:
            `reward_loss`, in units of c, and the method's other terms, before the step;
            `learning_rate`: the one of this step.

        Raises:
            RewardModelError: not prepared, or training has diverged; no weight has changed.
        """
        self._require_prepared()
        self.network.train()
        self._optimiser.zero_grad()
        metrics: dict[str, float] = {}
        for terms in self._all_terms(memory, rng):
            torch.stack(list(terms.values())).sum().backward()  # type: ignore[no-untyped-call]
            # read only now: on a GPU, reading waits for the result
            for name, term in terms.items():
                metrics[name] = metrics.get(name, 0.0) + float(term.detach())
        for name, value in metrics.items():
            if not math.isfinite(value):
                raise RewardModelError(
                    f'{name} is {value} at gradient step {self.gradient_steps}: training has '
                    f'diverged. Lower {self.group}.learning_rate = {self._own.learning_rate} '
                    'or set target_scale = rms'
                )
        if math.isfinite(self.gradient_norm):
            nn.utils.clip_grad_norm_(self.network.parameters(), self.gradient_norm)
        rate = self._learning_rate()
        for group in self._optimiser.param_groups:
            group['lr'] = rate
        self._optimiser.step()
        self.gradient_steps += 1
        return metrics | {'learning_rate': rate}

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) of the segments' steps, 0 elsewhere."""
        return self._in_unit(self._rewards(batch))

    def _in_unit(self, rewards: F32) -> F32:
        """Convert step rewards from units of c to the unit of labels."""
        if self._settings.reward_unit == 'raw':
            return rewards * np.float32(self.target_scale)
        return rewards

    def predict(self, batch: SegmentBatch) -> F64:
        """The predicted composite rewards (B,), in the task's unit: sums of step rewards."""
        predicted: F64 = self._rewards(batch).sum(1, dtype=np.float64) * self.target_scale
        return predicted

    def _rewards(self, batch: SegmentBatch) -> F32:
        self._require_prepared()
        self.network.eval()
        with torch.inference_mode():
            parts = [self._step_rewards(part).cpu().numpy() for part in self._parts(batch)]
        rewards: F32 = np.concatenate(parts)
        rewards[~segment_steps(batch)] = 0
        return rewards

    def _put(self, values: NDArray[Any]) -> Tensor:
        """An array of any shape as a tensor on the device."""
        # torch.tensor copies into aligned memory: nothing may depend on where numpy's is
        return torch.tensor(values).to(self.device)

    def _standardised(self, observations: F32 | Tensor) -> Tensor:
        """Observations as the network sees them, from an array or a tensor on the device."""
        if not isinstance(observations, Tensor):
            observations = self._put(observations)
        standardised = (observations - self._mean) / self._std
        if self._own.normalise_observations:
            return standardised.clamp(-self.clip, self.clip)
        return standardised

    def _step_inputs(self, batch: SegmentBatch) -> Tensor:
        """States and actions (B, L, O + A), as networks of single steps see them."""
        observations = self._standardised(batch.observations[:, :-1])  # (B, L, O)
        return torch.cat([observations, self._put(batch.actions)], -1)

    def _scaled(self, values: F64) -> Tensor:
        """Composite rewards (B,) in units of c."""
        return self._put((values / self.target_scale).astype(np.float32))

    def state(self) -> dict[str, Tensor]:
        """Weights, AdamW moments, gradient steps taken, target scale and observation moments."""
        state = super().state() | {
            'version': torch.tensor(self.gradient_steps, dtype=torch.int64),
            'observation_mean': self._mean.clone(),
            'observation_std': self._std.clone(),
        }
        for name, tensor in self._tensors().items():
            state[name] = tensor.detach().clone()
        return state

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's or architecture's; nothing has changed then.
        """
        super().load_state(state)
        self.gradient_steps = int(state['version'])
        self._mean.copy_(state['observation_mean'])
        self._std.copy_(state['observation_std'])
        with torch.no_grad():
            for name, tensor in self._tensors().items():
                tensor.copy_(state[name])

    def _tensors(self) -> dict[str, Tensor]:
        tensors = {}
        for name, parameter in self.network.named_parameters():
            tensors[f'network.{name}'] = parameter.data
            for moment, tensor in self._optimiser.state[parameter].items():
                tensors[f'adamw.{moment}.{name}'] = tensor
        return tensors
