"""CoDeTr: a reward transformer, trained to make up composite rewards from step rewards."""

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from codetr_ros.config import CodetrSettings, Settings
from codetr_ros.records import F32, F64
from codetr_ros.rewards.method import RewardModelError, check_state, measure_scale, segment_steps
from codetr_ros.rewards.transformer import RewardTransformer
from codetr_ros.seeding import seed_torch
from codetr_ros.trajectories import SegmentBatch, Trajectories

STD_FLOOR = 1e-2
"""Least standard deviation by which an observation component is divided (decided here).

A component that stood still in the warm-up may move later: it must not drown the others then.
"""


class Codetr:
    """Learns R(segment) = sum_t w_t rhat_t by regression; labels steps with w_t rhat_t or rhat_t.

    Inside, composite rewards are in units of the target scale c, the root mean square composite
    reward per step of the warm-up: a positive constant, never a shift, so that what survival is
    worth keeps its sign.

    What the switches of `CodetrSettings` decide, beyond their descriptions:

    * `context` 'episode' puts up to `window` steps before the segment, in training as in
      labelling; the loss and the labels are the segment's own in any case.
    * `attention_scope` 'window' lets all steps of the window attend to all. The weights of the
      window's steps then sum to their number, and those of the segment to whatever falls to it.
    * `labelling` 'window' takes the last `window` steps, be they of the segment or not, and keeps
      the output of the last step only: with `label` 'rhat' as Preference Transformer does it, with
      'product' its weight is the one that it has within that window. Where `context` is 'segment',
      places beyond the delay are met in labelling only, untrained.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'codetr'
    in_process_only: ClassVar[bool] = False
    frozen: ClassVar[bool] = False

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        codetr = settings.codetr
        self._settings = settings
        self._codetr = codetr
        self.context = codetr.window if codetr.context == 'episode' else 0
        self.version = 0
        self.target_scale = 0.0  # c; 0 until prepared
        self._mean = torch.zeros(observation_size)
        self._std = torch.ones(observation_size)
        self._positions = max(settings.delay + self.context, codetr.window)
        seed_torch(settings.seed, 'codetr', 'init')
        self.network = RewardTransformer(observation_size, action_size, self._positions, codetr)
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(),
            lr=codetr.learning_rate,
            weight_decay=codetr.weight_decay,
            fused=True,
        )
        for parameter in self.network.parameters():
            # from the start, so that every state has the same tensors
            self._optimiser.state[parameter] = {
                'step': torch.zeros(()),
                'exp_avg': torch.zeros_like(parameter),
                'exp_avg_sq': torch.zeros_like(parameter),
            }

    def prepare(self, memory: Trajectories) -> None:
        """Freeze the target scale c and the moments of the observations."""
        self.target_scale = measure_scale(self._settings.target_scale, memory)
        if self._codetr.normalise_observations:
            mean, std = memory.observation_moments()
            self._mean = torch.tensor(mean, dtype=torch.float32)
            self._std = torch.tensor(np.maximum(std, STD_FLOOR), dtype=torch.float32)

    def gradient_step(self, memory: Trajectories, rng: np.random.Generator) -> dict[str, float]:
        """One AdamW step on the mean squared error of a batch of composite rewards.

        Returns:
            `reward_loss`: mean over the batch of (R_hat - R)^2 in scaled units, before the step;
            times c^2 it is in the task's. `learning_rate`: the one of this step.

        Raises:
            RewardModelError: not prepared, or training has diverged; no weight has changed.
        """
        self._require_prepared()
        batch = memory.sample_segments(rng, self._codetr.batch, self.context)
        self.network.train()
        weights, rewards = self._forward(batch)  # (B, L) each
        predicted = (weights * rewards * torch.from_numpy(segment_steps(batch))).sum(1)  # (B,)
        target = torch.tensor(batch.values / self.target_scale, dtype=torch.float32)
        loss = F.mse_loss(predicted, target)
        said = float(loss.detach())
        if not math.isfinite(said):
            raise RewardModelError(
                f'reward_loss is {said} at gradient step {self.version}: training has diverged. '
                f'Lower codetr.learning_rate = {self._codetr.learning_rate} '
                f'or set target_scale = rms'
            )
        rate = learning_rate(self._codetr, self.version)
        for group in self._optimiser.param_groups:
            group['lr'] = rate
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimiser.step()
        self.version += 1
        return {'reward_loss': said, 'learning_rate': rate}

    def components(self, batch: SegmentBatch) -> tuple[F32, F32]:
        """Weights w and rewards rhat (in units of c) of the segments' steps, (B, L) each."""
        self._require_prepared()
        self.network.eval()
        with torch.inference_mode():
            weights, rewards = self._forward(batch)
        outside = ~segment_steps(batch)
        w, rhat = weights.numpy(), rewards.numpy()
        w[outside] = 0  # with a window's scope the context has weights too
        rhat[outside] = 0
        return w, rhat

    def predict(self, batch: SegmentBatch) -> F64:
        """The predicted composite rewards R_hat (B,), in the task's unit."""
        weights, rewards = self.components(batch)
        predicted: F64 = (weights.astype(np.float64) * rewards).sum(1) * self.target_scale
        return predicted

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) of the segments' steps, 0 elsewhere.

        With `label` 'product' those of a segment sum to its predicted composite reward.
        """
        weights, rewards = self.components(batch)
        return self._in_unit(weights * rewards if self._codetr.label == 'product' else rewards)

    def label_windows(self, batch: SegmentBatch) -> F32:
        """Step rewards (B,) of the last step of each window."""
        labels = self.label(batch)
        return labels[np.arange(len(labels)), batch.lengths - 1]

    def state(self) -> dict[str, Tensor]:
        """Weights, AdamW moments, gradient steps taken, target scale and observation moments."""
        state = {
            'version': torch.tensor(self.version, dtype=torch.int64),
            'target_scale': torch.tensor(self.target_scale, dtype=torch.float64),
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
        check_state(self.name, self.state(), state)
        self.version = int(state['version'])
        self.target_scale = float(state['target_scale'])
        self._mean.copy_(state['observation_mean'])
        self._std.copy_(state['observation_std'])
        with torch.no_grad():
            for name, tensor in self._tensors().items():
                tensor.copy_(state[name])

    def _tensors(self) -> dict[str, Tensor]:
        found = {}
        for name, parameter in self.network.named_parameters():
            found[f'network.{name}'] = parameter.data
            for moment, tensor in self._optimiser.state[parameter].items():
                found[f'adamw.{moment}.{name}'] = tensor
        return found

    def _forward(self, batch: SegmentBatch) -> tuple[Tensor, Tensor]:
        whole_window = self._codetr.attention_scope == 'window'
        step = np.arange(batch.actions.shape[1])
        inside = step < batch.lengths[:, None] if whole_window else segment_steps(batch)
        if len(step) > self._positions:
            raise RewardModelError(
                f'a window of {len(step)} steps: this model has places for {self._positions}, by '
                f'delay = {self._settings.delay} and codetr.window = {self._codetr.window}'
            )
        # torch.tensor copies into aligned memory: nothing may depend on where numpy's is
        observations = torch.tensor(batch.observations[:, :-1])  # (B, L, O)
        actions = torch.tensor(batch.actions)  # (B, L, A)
        standardised = (observations - self._mean) / self._std
        weights, rewards = self.network(standardised, actions, torch.from_numpy(inside))
        return weights, rewards

    def _in_unit(self, labels: F32) -> F32:
        if self._settings.reward_unit == 'raw':
            return labels * np.float32(self.target_scale)
        return labels

    def _require_prepared(self) -> None:
        if not self.target_scale:
            raise RewardModelError(
                "method 'codetr' has no target scale yet: "
                'call prepare(memory) before it is trained or asked'
            )


def learning_rate(settings: CodetrSettings, step: int) -> float:
    """The learning rate of gradient step `step` (0, 1, ...).

    It rises linearly over `warmup_gradient_steps`, the last of which has the full rate, then stays
    there or falls on a half cosine to a tenth of it at `total_gradient_steps`, where it remains.
    """
    warmup = settings.warmup_gradient_steps
    if step < warmup:
        return settings.learning_rate * (step + 1) / warmup
    if settings.schedule == 'constant':
        return settings.learning_rate
    progress = min(1.0, (step - warmup) / max(1, settings.total_gradient_steps - warmup))
    return settings.learning_rate * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * progress)))
