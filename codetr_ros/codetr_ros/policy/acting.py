"""A policy to act with, one observation at a time, made from the record of the learner.

The record carries a JSON description and safetensors bytes, never a pickle.
Shapes: O = observation size, A = action size.
"""

from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from codetr_ros.policy.actor import (
    KINDS,
    LOG_STD_RANGE,
    Actor,
    StandardisedActor,
    describe_network,
    linear_layers,
    standardise,
)
from codetr_ros.records import F32, Policy
from codetr_ros.system.parsing import parse_json

MAX_LAYERS = 8
MAX_WIDTH = 65_536


class NetworkError(ValueError):
    """A policy that cannot be used: names what was expected and what was received."""


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
        description = _parse(policy.network, name)
        hidden = _hidden(description, name)
        segment_steps = _segment_steps(description, name, delay)
        named = description.get('kind')
        kind = next((kind for kind in KINDS if kind == named), 'tanh_gaussian_mlp')
        expected = describe_network(observation_size, action_size, hidden, segment_steps, kind)
        if policy.network != expected:
            raise NetworkError(
                f'{name} is of another architecture: this task needs {expected}, '
                f'the policy is {policy.network}; '
                'learner and simulator need the same task and the same version of codetr_ros'
            )
        try:
            tensors = safetensors.torch.load(policy.weights)
        except (safetensors.SafetensorError, KeyError) as error:
            raise NetworkError(
                f'{name}: its {len(policy.weights)} bytes of weights are not safetensors: {error}'
            ) from None
        with torch.device('meta'):
            actor = KINDS[kind](observation_size + (segment_steps > 0), action_size, hidden)
        _check(tensors, actor.state_dict(), name)
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


def _parse(network: str, name: str) -> dict[str, Any]:
    """The content of a description."""
    try:
        description = parse_json(network)
        if not isinstance(description, dict):
            raise ValueError
        if not {'hidden', 'segment_steps'} <= description.keys():
            raise ValueError
    except ValueError:
        raise NetworkError(
            f"{name}: its network description is not one of this version's: {network!r}; "
            f'expected something like {describe_network(1, 1, [256, 256])}'
        ) from None
    return description


def _hidden(description: dict[str, Any], name: str) -> list[int]:
    """Hidden widths that a description names."""
    hidden = description['hidden']
    if (
        not isinstance(hidden, list)
        or not 1 <= len(hidden) <= MAX_LAYERS
        or not all(type(width) is int and 1 <= width <= MAX_WIDTH for width in hidden)
    ):
        raise NetworkError(
            f'{name}: its network description names hidden widths {hidden!r}; '
            f'1 to {MAX_LAYERS} whole numbers from 1 to {MAX_WIDTH} are allowed'
        )
    return hidden


def _segment_steps(description: dict[str, Any], name: str, delay: int) -> int:
    """Steps of the segments that a description names; 0 if the policy does not see them."""
    steps = description['segment_steps']
    if type(steps) is not int or steps not in (0, delay):
        raise NetworkError(
            f'{name}: its network description names segments of {steps!r} steps, where they have '
            f'{delay}: learner and simulator need the same setting delay'
        )
    return steps


def _check(tensors: dict[str, Tensor], expected: dict[str, Tensor], name: str) -> None:
    """Refuse weights that do not fit, before they are used."""
    if tensors.keys() != expected.keys():
        raise NetworkError(
            f'{name}: missing weights {sorted(expected.keys() - tensors.keys())}, '
            f'unknown weights {sorted(tensors.keys() - expected.keys())}'
        )
    for key, tensor in tensors.items():
        actual = (str(tensor.dtype), tuple(tensor.shape))
        due = ('torch.float32', tuple(expected[key].shape))
        if actual != due:
            raise NetworkError(f'{name}: weight {key!r} is {actual}, expected {due}')
        strange = tensor.numel() - int(torch.isfinite(tensor).sum())
        if strange:
            raise NetworkError(
                f'{name}: {strange} of {tensor.numel()} numbers of weight {key!r} are not finite; '
                'the learner has diverged: look at its losses and the scale of its rewards'
            )


def uniform_actions(rng: np.random.Generator, steps: int, size: int) -> F32:
    """Actions (steps, size), each number uniform in [-1, 1)."""
    return rng.random((steps, size), dtype=np.float32) * 2 - 1
