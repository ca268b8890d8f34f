"""A policy to act with, one observation at a time, made from the record of the learner.

The record carries a JSON description and safetensors bytes, never a pickle.
Shapes: O = observation size, A = action size.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from codetr_ros.policy.actor import (
    KINDS,
    Actor,
    StandardisedActor,
    linear_layers,
    standardise,
)
from codetr_ros.policy.network import (
    LOG_STD_RANGE,
    PLAIN,
    Network,
    NetworkError,
    check_weights,
    read_description,
    read_weights,
)
from codetr_ros.records import F32, Policy


class ActingPolicy:
    """A policy to act with, one observation at a time.

    The same weights, observation and noise give the same bits in every process (of one CPU type
    and thread count). For this the weights are copied into memory of their own: the last bit of a
    product with one row depends on where its matrix lies, and a received message lies anywhere.

    Args:
        actor: the network.
        segment_steps: as in `describe_network`.
    """

    def __init__(self, actor: Actor | StandardisedActor, segment_steps: int = 0) -> None:
        self.layers = [(_own(layer.weight), _own(layer.bias)) for layer in linear_layers(actor)]
        self._segment_steps = segment_steps
        self._activate = torch.relu_
        self._log_std: Tensor | None = None
        self._moments: tuple[Tensor, Tensor] | None = None
        if isinstance(actor, StandardisedActor):
            self._activate = torch.tanh_
            self._log_std = _own(actor.log_std)
            self._moments = _own(actor.observation_mean), _own(actor.observation_deviation)

    @classmethod
    def from_record(
        cls, policy: Policy, observation_size: int, action_size: int, delay: int = 0
    ) -> 'ActingPolicy':
        """The policy that a record carries.

        Args:
            policy: the learner's record. The widths of its layers may be any.
            observation_size: O of the task in which it is to act.
            action_size: A of that task.
            delay: steps n of the segments into which episodes are cut; 0 if they are not.

        Raises:
            NetworkError: the policy is of another architecture or for other segments, or its
                weights are missing, unknown, of another shape or type, not finite, or not
                safetensors at all.
        """
        name = f'policy of phase {policy.phase}, version {policy.version}'
        if policy.random:
            raise NetworkError(
                f'{name} is random and has no weights: draw its actions uniformly from [-1, 1]'
            )
        description = read_description(policy.network, name)
        segment_steps = _segment_steps(description, name, delay)
        named = description.get('kind')
        kind = next((kind for kind in KINDS if kind == named), PLAIN)
        hidden = tuple(description['hidden'])
        network = Network(kind, observation_size, action_size, hidden, segment_steps)
        if policy.network != network.describe():
            raise NetworkError(
                f'{name} is of another architecture: this task needs {network.describe()}, '
                f'the policy is {policy.network}; '
                'learner and simulator need the same task and the same version of codetr_ros'
            )
        weights = read_weights(policy.weights, name)
        check_weights(weights, network, name)
        with torch.device('meta'):
            actor = KINDS[kind](network.inputs, action_size, hidden)
        tensors = {key: torch.from_numpy(array) for key, array in weights.items()}
        actor.load_state_dict(tensors, assign=True)
        return cls(actor, segment_steps)

    def act(self, observation: F32, noise: F32 | None = None, step: int | None = None) -> F32:
        """The action for one observation.

        Args:
            observation: (O,), finite.
            noise: (A,) standard normal numbers; None for the deterministic action.
            step: number of the step in its segment; a policy that sees how far the segment is
                needs it. Where all have n steps, its number in the episode does as well.

        Returns:
            (A,) in [-1, 1]: tanh(mean), or tanh(mean + std * noise).

        Raises:
            NetworkError: the policy needs the step, and none was given.
        """
        x = torch.from_numpy(observation)
        if self._segment_steps:
            if step is None:
                raise NetworkError(
                    'this policy sees how far the segment is: give it the number of the step in '
                    'its segment'
                )
            place = step % self._segment_steps / self._segment_steps
            x = torch.cat([x, torch.tensor([place])])
        if self._moments is not None:
            x = standardise(x, *self._moments)
        for weight, bias in self.layers[:-1]:
            x = self._activate(torch.addmv(bias, weight, x))
        weight, bias = self.layers[-1]
        out = torch.addmv(bias, weight, x)
        mean, log_std = out.chunk(2) if self._log_std is None else (out, self._log_std)
        if noise is not None:
            std = log_std.clamp(*LOG_STD_RANGE).exp_()
            mean = torch.addcmul(mean, std, torch.from_numpy(noise))
        action: F32 = mean.tanh().clamp_(-1.0, 1.0).numpy()
        return action


def _own(tensor: Tensor) -> Tensor:
    """A copy in fresh memory, which torch aligns to 64 bytes."""
    return torch.empty(tensor.shape, dtype=tensor.dtype).copy_(tensor.detach())


def _segment_steps(description: dict[str, Any], name: str, delay: int) -> int:
    """Steps of the segments that a description names; 0 if the policy does not see them."""
    steps = description['segment_steps']
    if type(steps) is not int or steps not in (0, delay):
        raise NetworkError(
            f'{name}: its network description names segments of {steps!r} steps, where they have '
            f'{delay}: learner and simulator need the same setting delay'
        )
    return steps


def uniform_actions(rng: np.random.Generator, steps: int, size: int) -> F32:
    """Actions (steps, size), each number uniform in [-1, 1)."""
    return rng.random((steps, size), dtype=np.float32) * 2 - 1
