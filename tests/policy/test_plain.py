"""Acting by numpy alone equals acting by torch, for every network that a policy may have."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.policy.actor import KINDS, StandardisedActor, weights_bytes
from codetr_ros.policy.network import (
    CONSTANTS,
    PLAIN,
    STANDARDISED,
    Network,
    NetworkError,
    read_network,
    read_weights,
)
from codetr_ros.policy.plain import PlainPolicy

TOLERANCE = 1e-6


def both(network: Network, seed: int) -> tuple[PlainPolicy, ActingPolicy]:
    """The same random policy, to act by numpy and by torch."""
    torch.manual_seed(seed)
    actor = KINDS[network.kind](network.inputs, network.action_size, network.hidden)
    with torch.no_grad():
        for parameter in actor.parameters():
            fan_in = parameter.shape[-1]  # biases too; no layer amplifies what it gets
            parameter.add_(0.3 * torch.randn_like(parameter) / fan_in**0.5)
        if isinstance(actor, StandardisedActor):
            actor.observation_mean.copy_(torch.randn(network.inputs))
            actor.observation_deviation.copy_(torch.rand(network.inputs) + 0.1)
    weights = read_weights(weights_bytes(actor), 'p')
    return PlainPolicy(network, weights, 'p'), ActingPolicy(actor, network.segment_steps)


networks = st.builds(
    Network,
    st.sampled_from(sorted(CONSTANTS)),
    st.integers(1, 40),
    st.integers(1, 8),
    st.lists(st.sampled_from([1, 7, 32, 128, 256]), min_size=1, max_size=4).map(tuple),
    st.sampled_from([0, 1, 20]),
)


@settings(max_examples=150, deadline=None)
@given(networks, st.integers(0, 2**31), st.sampled_from([0.0, 0.1, 1.0, 10.0]), st.integers(0, 50))
def test_numpy_acts_as_torch_does(network: Network, seed: int, scale: float, step: int):
    plain, acting = both(network, seed)
    rng = np.random.default_rng(seed)
    for _ in range(4):
        seen = (scale * rng.standard_normal(network.observation_size)).astype(np.float32)
        mine, theirs = plain.act(seen, step), acting.act(seen, step=step)
        assert mine.dtype == np.float32 and mine.shape == (network.action_size,)
        # numbers ten times as large are rounded ten times as coarsely, by torch as well
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=TOLERANCE * max(1.0, scale))


def test_every_kind_of_policy_network_can_be_acted_with():
    assert set(KINDS) == set(CONSTANTS)  # what is trained and what numpy knows


@pytest.mark.parametrize('kind', sorted(CONSTANTS))
def test_the_shapes_of_a_network_are_those_of_the_one_that_is_trained(kind: str):
    network = Network(kind, 5, 2, (8, 4), 20)
    actor = KINDS[kind](network.inputs, 2, network.hidden)
    there = {name: tuple(tensor.shape) for name, tensor in actor.state_dict().items()}
    assert network.shapes() == there
    assert read_network(network.describe(), 'p') == network


def test_a_step_counts_only_where_the_policy_sees_how_far_the_segment_is():
    seen = np.ones(3, np.float32)
    blind, _ = both(Network(PLAIN, 3, 2, (8,)), 0)
    assert np.array_equal(blind.act(seen, 0), blind.act(seen, 7))
    seeing, _ = both(Network(PLAIN, 3, 2, (8,), 20), 0)
    assert not np.array_equal(seeing.act(seen, 0), seeing.act(seen, 7))
    assert np.array_equal(seeing.act(seen, 7), seeing.act(seen, 27))


def test_observations_of_another_size_are_refused():
    plain, _ = both(Network(PLAIN, 3, 2, (8,)), 0)
    with pytest.raises(NetworkError, match=r'3 numbers, not on one of shape \(4,\)'):
        plain.act(np.ones(4, np.float32), 0)


@pytest.mark.parametrize(
    'changed',
    [
        ('"relu"', '"gelu"'),
        (f'"{PLAIN}"', '"gru"'),
        ('"observation_size":3', '"observation_size":0'),
        ('"action_size":2', '"action_size":true'),
        ('"segment_steps":0', '"segment_steps":-1'),
        ('"segment_steps":0', '"more":1,"segment_steps":0'),
    ],
)
def test_a_description_that_this_version_would_not_write_is_refused(changed: tuple[str, str]):
    text = Network(PLAIN, 3, 2, (8,)).describe()
    assert changed[0] in text
    with pytest.raises(NetworkError, match='not one of this version'):
        read_network(text.replace(*changed), 'p')


def test_acting_by_numpy_imports_no_torch(tmp_path):
    program = (
        "import sys\nsys.modules['torch'] = None\n"
        'import codetr_ros.policy.plain\n'
        "assert 'torch' not in {name for name, module in sys.modules.items() if module}"
    )
    subprocess.run([sys.executable, '-c', program], check=True, cwd=tmp_path, timeout=180)


def test_a_standardised_policy_clips_what_is_far_from_all_it_has_seen():
    plain, acting = both(Network(STANDARDISED, 3, 2, (8,)), 1)
    far = np.full(3, 1e6, np.float32)
    np.testing.assert_allclose(plain.act(far, 0), acting.act(far), rtol=0, atol=TOLERANCE)
