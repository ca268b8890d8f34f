"""A trained policy to act with, by numpy alone: no torch, no noise.

Shapes: O = observation size, A = action size.
"""

from collections.abc import Mapping

import numpy as np

from codetr_ros.policy.network import (
    OBSERVATION_CLIP,
    STANDARDISED,
    Network,
    NetworkError,
    check_weights,
)
from codetr_ros.records import F32


class PlainPolicy:
    """The deterministic action of a policy, tanh(mean), in float32.

    It equals that of `acting.ActingPolicy` but for rounding: sums are added in another order.

    Args:
        network: what it is.
        weights: its weights by the names of `Network.shapes`.
        name: for errors.

    Raises:
        NetworkError: the weights do not fit.
    """

    def __init__(self, network: Network, weights: Mapping[str, F32], name: str) -> None:
        check_weights(weights, network, name)
        self.network = network
        self._name = name
        self._moments: tuple[F32, F32] | None = None
        if network.kind == STANDARDISED:
            self._moments = weights['observation_mean'], weights['observation_deviation']
        named = [
            (weights[f'{layer}.weight'], weights[f'{layer}.bias']) for layer in network.layers()
        ]
        size = network.action_size
        weight, bias = named.pop()
        self._last = weight[:size].copy(), bias[:size].copy()  # without the log deviations
        self._hidden = named

    def act(self, observation: F32, step: int) -> F32:
        """The action for one observation.

        Args:
            observation: (O,), finite.
            step: number of the step in its segment, or in its episode where all segments have the
                same length; a policy that does not see it ignores it.

        Returns:
            (A,) in [-1, 1].

        Raises:
            NetworkError: the observation has another size.
        """
        network = self.network
        if observation.shape != (network.observation_size,):
            raise NetworkError(
                f'{self._name} acts on observations of {network.observation_size} numbers, not on '
                f'one of shape {observation.shape}'
            )
        x = observation
        if n := network.segment_steps:
            x = np.append(x, np.float32(step % n / n))
        if self._moments is not None:
            mean, deviation = self._moments
            x = np.clip((x - mean) / deviation, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        for weight, bias in self._hidden:
            x = weight @ x + bias
            x = np.tanh(x) if self._moments is not None else np.maximum(x, np.float32(0))
        weight, bias = self._last
        action: F32 = np.clip(np.tanh(weight @ x + bias), -1, 1).astype(np.float32)
        return action
