"""The reward transformer as a reader would write it: slow, and obviously what it should be."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from codetr_ros.config import CodetrSettings
from codetr_ros.rewards.transformer import RewardTransformer

Drop = Callable[[Tensor], Tensor]


def forward(
    network: RewardTransformer,
    settings: CodetrSettings,
    observations: Tensor,
    actions: Tensor,
    inside: Tensor,
    drop: Drop = lambda x: x,
) -> tuple[Tensor, Tensor]:
    """What `network` must make of these inputs: w (B, L) and rhat (B, L).

    Args:
        network: whose weights are taken.
        settings: its architecture.
        observations: (B, L, O).
        actions: (B, L, A).
        inside: (B, L).
        drop: what dropout does to the activations that it is given, in the order of the layers.
    """
    w = dict(network.named_parameters())

    def linear(name: str, x: Tensor) -> Tensor:
        return x @ w[f'{name}.weight'].T + w[f'{name}.bias']

    def norm(name: str, x: Tensor) -> Tensor:
        x = (x - x.mean(-1, keepdim=True)) / (x.var(-1, keepdim=True, correction=0) + 1e-5).sqrt()
        return x * w[f'{name}.weight'] + w[f'{name}.bias']

    B, L, _ = observations.shape  # noqa: N806
    d, heads = settings.embedding, settings.heads
    position = w['causal.position.weight'][:L]
    s, a = linear('causal.observation', observations), linear('causal.action', actions)
    if settings.tokens == 'pair':
        h = torch.zeros(B, 2 * L, d, dtype=s.dtype)  # a_1, s_1, a_2, s_2, ...
        for t in range(L):
            h[:, 2 * t], h[:, 2 * t + 1] = a[:, t] + position[t], s[:, t] + position[t]
    else:
        h = s + a + position
    N = h.shape[1]  # noqa: N806
    h = drop(norm('causal.norm_in', h))
    for layer in range(settings.layers):
        block = f'causal.blocks.{layer}'
        q, k, v = (
            part.reshape(B, N, heads, d // heads).transpose(1, 2)
            for part in linear(f'{block}.attention.qkv', norm(f'{block}.norm1', h)).chunk(3, -1)
        )
        logits = q @ k.mT / math.sqrt(d // heads)
        later = torch.ones(N, N, dtype=torch.bool).triu(1)
        attention = drop(logits.masked_fill(later, -math.inf).softmax(-1))
        y = (attention @ v).transpose(1, 2).reshape(B, N, d)
        h = h + drop(linear(f'{block}.attention.out', y))
        wide = F.relu(linear(f'{block}.widen', norm(f'{block}.norm2', h)))
        h = h + drop(linear(f'{block}.narrow', wide))
    x = norm('causal.norm_out', h)
    if settings.tokens == 'pair':
        x = x[:, [2 * t + 1 for t in range(L)]]  # at the states
    rhat = linear('reward', x).squeeze(-1)
    if settings.weights == 'one':
        return inside.to(x.dtype), rhat
    q, k = linear('weights.qk', x).chunk(2, -1)
    scale = {'inverse': 1 / d, 'inverse_sqrt': 1 / math.sqrt(d), 'one': 1.0}[settings.head_scale]
    logits = (scale * q @ k.mT).masked_fill(~inside[:, None, :], -math.inf)
    return (logits.softmax(-1) * inside[:, :, None]).sum(1), rhat
