"""The policy network: what the learner trains, and what simulators and the evaluator act with.

Between them it travels as a JSON description and safetensors bytes, never as a pickle. Shapes: B =
batch, O = observation size, A = action size, H = width of a hidden layer.
"""

import json
import math
from collections.abc import Sequence
from itertools import pairwise

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from codetr_ros.records import F32, Policy

LOG_STD_RANGE = (-10.0, 2.0)
"""Hard clip of the log standard deviation (jaxrl)."""
MAX_LAYERS = 8
MAX_WIDTH = 65_536


class NetworkError(ValueError):
    """A policy that cannot be acted with: the message names what was expected and what came."""


def describe(observation_size: int, action_size: int, hidden: Sequence[int]) -> str:
    """The description of a policy network that goes into `Policy.network`: canonical JSON.

    Two networks have the same description exactly if the weights of one fit the other and mean the
    same.
    """
    description = {
        'kind': 'tanh_gaussian_mlp',
        'observation_size': observation_size,
        'action_size': action_size,
        'hidden': list(hidden),
        'activation': 'relu',
        'log_std_range': list(LOG_STD_RANGE),
    }
    return json.dumps(description, sort_keys=True, separators=(',', ':'))


class Actor(nn.Module):
    """A Gaussian over actions before their squash by tanh (jaxrl's NormalTanhPolicy).

    Both heads are one linear layer: its first A outputs are the mean, the last A the log standard
    deviation. Initial weights are orthogonal, with gain sqrt(2) in the network and 1 in each head;
    biases are zero.
    """

    def __init__(self, observation_size: int, action_size: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.action_size = action_size
        sizes = [observation_size, *hidden]
        self.body = nn.Sequential()
        for inputs, outputs in pairwise(sizes):
            self.body.extend([nn.Linear(inputs, outputs), nn.ReLU()])
        self.heads = nn.Linear(sizes[-1], 2 * action_size)
        for layer in linear_layers(self):
            nn.init.zeros_(layer.bias)
            if layer is not self.heads:
                nn.init.orthogonal_(layer.weight, math.sqrt(2))
        with torch.no_grad():
            for head in self.heads.weight.chunk(2):
                nn.init.orthogonal_(head)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log standard deviations, both (B, A), for observations (B, O)."""
        mean, log_std = self.heads(self.body(observations)).chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD_RANGE)


def linear_layers(actor: Actor) -> list[nn.Linear]:
    """The layers with weights, from the observation to the heads."""
    return [layer for layer in actor.modules() if isinstance(layer, nn.Linear)]


def weights_bytes(actor: nn.Module) -> bytes:
    """The weights of a policy network as safetensors: the same weights give the same bytes."""
    return safetensors.torch.save(actor.state_dict())


class ActingPolicy:
    """A policy to act with, one observation at a time.

    The same weights, observation and noise give the same bits in every process (of one CPU type
    and thread count): the weights are copied into memory of their own, because the last bit of a
    product with one row depends on where its matrix lies, and a received message lies anywhere.
    """

    def __init__(self, actor: Actor) -> None:
        self.layers = [(_own(layer.weight), _own(layer.bias)) for layer in linear_layers(actor)]

    @classmethod
    def from_record(
        cls, policy: Policy, observation_size: int, action_size: int
    ) -> 'ActingPolicy':
        """The policy that a record carries.

        Args:
            policy: what the learner published. The widths of its layers are its own affair.
            observation_size: O of the task that it is to act in.
            action_size: A of that task.

        Raises:
            NetworkError: the policy is of another architecture, or its weights are missing,
                unknown, of another shape or type, not finite, or not safetensors at all.
        """
        name = f'policy of phase {policy.phase}, version {policy.version}'
        if policy.random:
            raise NetworkError(
                f'{name} is random and has no weights: draw its actions uniformly from [-1, 1]'
            )
        hidden = _hidden(policy.network, name)
        expected = describe(observation_size, action_size, hidden)
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
            actor = Actor(observation_size, action_size, hidden)
        _check(tensors, actor.state_dict(), name)
        actor.load_state_dict(tensors, assign=True)
        return cls(actor)

    def act(self, observation: F32, noise: F32 | None = None) -> F32:
        """The action for one observation.

        Args:
            observation: (O,), finite.
            noise: (A,) standard normal numbers; None for the deterministic action.

        Returns:
            (A,) in [-1, 1]: tanh(mean), or tanh(mean + std * noise).
        """
        x = torch.from_numpy(observation)
        for weight, bias in self.layers[:-1]:
            x = torch.addmv(bias, weight, x).relu_()
        weight, bias = self.layers[-1]
        mean, log_std = torch.addmv(bias, weight, x).chunk(2)
        if noise is not None:
            mean = torch.addcmul(
                mean, log_std.clamp(*LOG_STD_RANGE).exp_(), torch.from_numpy(noise)
            )
        action: F32 = mean.tanh().clamp_(-1.0, 1.0).numpy()
        return action


def _own(tensor: Tensor) -> Tensor:
    """A copy in fresh memory, which torch aligns to 64 bytes."""
    return torch.empty(tensor.shape, dtype=tensor.dtype).copy_(tensor.detach())


def _hidden(network: str, name: str) -> list[int]:
    """Hidden widths that a description names."""
    try:
        hidden = json.loads(network)['hidden']
    except (ValueError, TypeError, KeyError):
        raise NetworkError(
            f"{name}: its network description is not one of this version's: {network!r}; "
            f'expected something like {describe(1, 1, [256, 256])}'
        ) from None
    if (
        not isinstance(hidden, list)
        or not 1 <= len(hidden) <= MAX_LAYERS
        or not all(type(width) is int and 1 <= width <= MAX_WIDTH for width in hidden)
    ):
        raise NetworkError(
            f'{name}: its network description names hidden widths {hidden!r}; '
            f'allowed are 1 to {MAX_LAYERS} whole numbers from 1 to {MAX_WIDTH}'
        )
    return hidden


def _check(tensors: dict[str, Tensor], expected: dict[str, Tensor], name: str) -> None:
    """Refuse weights that do not fit, before anything is made of them."""
    if tensors.keys() != expected.keys():
        raise NetworkError(
            f'{name}: missing weights {sorted(expected.keys() - tensors.keys())}, '
            f'unknown weights {sorted(tensors.keys() - expected.keys())}'
        )
    for key, tensor in tensors.items():
        came = (str(tensor.dtype), tuple(tensor.shape))
        due = ('torch.float32', tuple(expected[key].shape))
        if came != due:
            raise NetworkError(f'{name}: weight {key!r} is {came}, expected {due}')
        strange = tensor.numel() - int(torch.isfinite(tensor).sum())
        if strange:
            raise NetworkError(
                f'{name}: {strange} of {tensor.numel()} numbers of weight {key!r} are not finite; '
                'the learner has diverged: look at its losses and the scale of its rewards'
            )
