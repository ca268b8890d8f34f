"""The policy network, which the learner trains and with which simulators and the evaluator act.

Between them it travels as a JSON description and safetensors bytes, never as a pickle. Shapes: B =
batch, O = observation size, A = action size, H = width of a hidden layer.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import safetensors.torch
import torch
from torch import Tensor, nn

from codetr_ros.policy.network import (
    LOG_STD_RANGE,
    OBSERVATION_CLIP,
    PLAIN,
    STANDARDISED,
)


class Actor(nn.Module):
    """A Gaussian over actions before their squash by tanh (jaxrl's NormalTanhPolicy).

    Both heads are one linear layer: its first A outputs are the mean, the last A the log standard
    deviation. Initial weights are orthogonal, with gain sqrt(2) in the network and 1 in each head;
    biases are zero.
    """

    def __init__(self, observation_size: int, action_size: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.action_size = action_size
        self.body = layers(observation_size, hidden, nn.ReLU)
        self.heads = nn.Linear(hidden[-1], 2 * action_size)
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


class StandardisedActor(nn.Module):
    """A Gaussian over actions before their squash by tanh, for standardised observations.

    The standard deviation is the same in every state. The moments of the observations are not
    parameters, but travel with them. Initial weights are orthogonal, with gain sqrt(2) in the
    network and 0.01 for the mean (as in baselines' MlpPolicy, recalled); biases and log standard
    deviations are zero.
    """

    observation_mean: Tensor
    observation_deviation: Tensor

    def __init__(self, observation_size: int, action_size: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.body = layers(observation_size, hidden, nn.Tanh)
        self.mean = nn.Linear(hidden[-1], action_size)
        self.log_std = nn.Parameter(torch.zeros(action_size))
        self.register_buffer('observation_mean', torch.zeros(observation_size))
        self.register_buffer('observation_deviation', torch.ones(observation_size))
        orthogonal(self.body, math.sqrt(2))
        orthogonal(self.mean, 0.01)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Means (B, A) for standardised observations (B, O), and log standard deviations (A,)."""
        return self.mean(self.body(observations)), self.log_std.clamp(*LOG_STD_RANGE)


KINDS: dict[str, type[Actor | StandardisedActor]] = {
    PLAIN: Actor,
    STANDARDISED: StandardisedActor,
}
"""Policy networks by their name in a description."""


def layers(inputs: int, hidden: Sequence[int], activation: type[nn.Module]) -> nn.Sequential:
    """The hidden layers of a network, each followed by its activation."""
    body = nn.Sequential()
    for width, following in pairwise([inputs, *hidden]):
        body.extend([nn.Linear(width, following), activation()])
    return body


def orthogonal(network: nn.Module, gain: float) -> None:
    """Give the linear layers of a network orthogonal weights of this gain, and zero biases."""
    for layer in linear_layers(network):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)


def standardise(observations: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """Observations (..., O) in deviations from the mean, clipped."""
    return ((observations - mean) / deviation).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)


def linear_layers(network: nn.Module) -> list[nn.Linear]:
    """The layers with weights, from the observation to the actions."""
    return [layer for layer in network.modules() if isinstance(layer, nn.Linear)]


def weights_bytes(actor: nn.Module) -> bytes:
    """The weights of a policy network as safetensors: the same weights give the same bytes."""
    return safetensors.torch.save(actor.state_dict())
