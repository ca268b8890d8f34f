"""What a policy network is, in words and numbers: its description and its weights. No torch.

Whoever acts reads both from outside and refuses what does not fit before it is used.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from codetr_ros.records import F32
from codetr_ros.system.parsing import parse_json

LOG_STD_RANGE = (-10.0, 2.0)
"""Hard clip of the log standard deviation (jaxrl)."""
OBSERVATION_CLIP = 10.0
"""Standardised observations are clipped to this many deviations (baselines' VecNormalize)."""
PLAIN, STANDARDISED = 'tanh_gaussian_mlp', 'standardised_tanh_gaussian_mlp'
CONSTANTS: dict[str, dict[str, Any]] = {
    PLAIN: {'activation': 'relu', 'log_std_range': list(LOG_STD_RANGE)},
    STANDARDISED: {'activation': 'tanh', 'observation_clip': OBSERVATION_CLIP},
}
"""What is the same in all policy networks of a kind, by the kind's name in a description."""

MAX_LAYERS = 8
MAX_WIDTH = 65_536


class NetworkError(ValueError):
    """A policy that cannot be used: names what was expected and what was received."""


@dataclass(frozen=True)
class Network:
    """A policy network.

    Attributes:
        kind: its name in `CONSTANTS`.
        observation_size: O.
        action_size: A.
        hidden: widths of the hidden layers.
        segment_steps: as in `describe_network`.
    """

    kind: str
    observation_size: int
    action_size: int
    hidden: tuple[int, ...]
    segment_steps: int = 0

    @property
    def inputs(self) -> int:
        """Numbers that go into the first layer."""
        return self.observation_size + (self.segment_steps > 0)

    @property
    def last(self) -> str:
        """The name of the last layer."""
        return 'heads' if self.kind == PLAIN else 'mean'

    def layers(self) -> list[str]:
        """The names of the layers with weights, from the observation to the actions."""
        return [*(f'body.{2 * i}' for i in range(len(self.hidden))), self.last]

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of all weights by name."""
        size, inputs = self.action_size, self.inputs
        outputs = 2 * size if self.kind == PLAIN else size
        made: dict[str, tuple[int, ...]] = {}
        for name, (into, out) in zip(
            self.layers(), pairwise([inputs, *self.hidden, outputs]), strict=True
        ):
            made |= {f'{name}.weight': (out, into), f'{name}.bias': (out,)}
        if self.kind == STANDARDISED:
            made['log_std'] = (size,)
            made |= {f'observation_{name}': (inputs,) for name in ('mean', 'deviation')}
        return made

    def describe(self) -> str:
        """Its description: canonical JSON."""
        description = {
            'kind': self.kind,
            'observation_size': self.observation_size,
            'action_size': self.action_size,
            'hidden': list(self.hidden),
            'segment_steps': self.segment_steps,
            **CONSTANTS[self.kind],
        }
        return json.dumps(description, sort_keys=True, separators=(',', ':'))


def describe_network(
    observation_size: int,
    action_size: int,
    hidden: Sequence[int],
    segment_steps: int = 0,
    kind: str = PLAIN,
) -> str:
    """The description of a policy network that goes into `Policy.network`: canonical JSON.

    Two networks have the same description exactly if the weights of one fit the other and mean the
    same.

    Args:
        observation_size: O of the task.
        action_size: A of the task.
        hidden: widths of the hidden layers.
        segment_steps: steps n of the longest segment if the policy sees how far the segment is, as
            one more input: (t - t_i) / n for step t of a segment that began at t_i. 0 if it does
            not.
        kind: the network's name in `CONSTANTS`.
    """
    return Network(kind, observation_size, action_size, tuple(hidden), segment_steps).describe()


def read_description(text: str, name: str) -> dict[str, Any]:
    """The content of a description; its widths are sound.

    Args:
        text: the description.
        name: of the policy, for errors.

    Raises:
        NetworkError: it is not one of this version's.
    """
    try:
        description = parse_json(text)
        if not isinstance(description, dict):
            raise ValueError
        if not {'hidden', 'segment_steps'} <= description.keys():
            raise ValueError
    except ValueError:
        raise NetworkError(
            f"{name}: its network description is not one of this version's: {text!r}; "
            f'expected something like {describe_network(1, 1, [256, 256])}'
        ) from None
    _check_hidden(description['hidden'], name)
    return description


def _check_hidden(hidden: object, name: str) -> None:
    if (
        not isinstance(hidden, list)
        or not 1 <= len(hidden) <= MAX_LAYERS
        or not all(type(width) is int and 1 <= width <= MAX_WIDTH for width in hidden)
    ):
        raise NetworkError(
            f'{name}: its network description names hidden widths {hidden!r}; '
            f'1 to {MAX_LAYERS} whole numbers from 1 to {MAX_WIDTH} are allowed'
        )


def read_network(text: str, name: str) -> Network:
    """The network that a description is of.

    Raises:
        NetworkError: it is not one of this version's.
    """
    given = read_description(text, name)
    sizes = [given.get(key) for key in ('observation_size', 'action_size', 'segment_steps')]
    kind = given.get('kind')
    sound = all(type(n) is int and n >= least for n, least in zip(sizes, (1, 1, 0), strict=True))
    if sound and isinstance(kind, str) and kind in CONSTANTS:
        observation_size, action_size, steps = (int(n) for n in sizes if n is not None)
        made = Network(kind, observation_size, action_size, tuple(given['hidden']), steps)
        if made.describe() == text:
            return made
    raise NetworkError(
        f'{name}: its network description is not one of this version: {text!r}; kinds are '
        f'{", ".join(CONSTANTS)}. Act with the version of codetr_ros that made it'
    )


def read_weights(data: bytes, name: str) -> dict[str, F32]:
    """The weights in safetensors bytes, in memory of their own.

    Raises:
        NetworkError: they are none.
    """
    try:
        return {key: array.copy() for key, array in safetensors.numpy.load(data).items()}
    except (safetensors.SafetensorError, KeyError) as error:
        raise NetworkError(
            f'{name}: its {len(data)} bytes of weights are not safetensors: {error}'
        ) from None


def check_weights(weights: Mapping[str, F32], network: Network, name: str) -> None:
    """Refuse weights that do not fit, before they are used.

    Raises:
        NetworkError: one is missing, unknown, of another shape or type, or not finite.
    """
    expected = network.shapes()
    if weights.keys() != expected.keys():
        raise NetworkError(
            f'{name}: missing weights {sorted(expected.keys() - weights.keys())}, '
            f'unknown weights {sorted(weights.keys() - expected.keys())}'
        )
    for key, array in weights.items():
        actual, due = (str(array.dtype), array.shape), ('float32', expected[key])
        if actual != due:
            raise NetworkError(f'{name}: weight {key!r} is {actual}, expected {due}')
        strange = array.size - int(np.isfinite(array).sum())
        if strange:
            raise NetworkError(
                f'{name}: {strange} of {array.size} numbers of weight {key!r} are not finite; '
                'the learner has diverged: look at its losses and the scale of its rewards'
            )
