"""The cost of the reward transformer, against what torch counts of it."""

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from codetr_ros.rewards.transformer import RewardTransformer
from cost import Cost
from helpers import builders, plain_transformer

O, A, B, L = 11, 3, 4, 6  # noqa: E741


@pytest.mark.parametrize('dropout', [0.0, 0.1])
@pytest.mark.parametrize('weights', ['attention', 'one'])
@pytest.mark.parametrize('tokens', ['pair', 'merged'])
@pytest.mark.parametrize('layers', [1, 3])
def test_the_operations_counted_are_those_that_torch_takes(tokens, weights, layers, dropout):
    settings = builders.tiny(
        codetr__tokens=tokens,
        codetr__weights=weights,
        codetr__layers=layers,
        codetr__dropout=dropout,
    ).codetr
    network = RewardTransformer(O, A, L, settings)
    inputs = torch.randn(B, L, O), torch.randn(B, L, A), torch.ones(B, L, dtype=torch.bool)
    cost = Cost(settings, O, A, B, L)
    # the form of the attention whose products torch sees; it multiplies with all tokens
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counted:
        w, rhat = network(*inputs)
    assert counted.get_total_flops() == cost.forward + cost.unseen
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counted:
        (w * rhat).sum().backward()
    assert counted.get_total_flops() == cost.gradient - cost.forward + 2 * cost.unseen
    plain = Cost(settings, O, A, B, L, plain=True)
    with FlopCounterMode(display=False) as counted:
        w, rhat = plain_transformer.forward(network, settings, *inputs)
    assert counted.get_total_flops() == plain.forward and plain.unseen == 0
    with FlopCounterMode(display=False) as counted:
        (w * rhat).sum().backward()
    assert counted.get_total_flops() == plain.gradient - plain.forward
