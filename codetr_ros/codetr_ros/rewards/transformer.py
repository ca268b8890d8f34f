"""The reward transformer: a causal transformer over steps, then attention within the sequence.

    R(segment) = sum_t w_t(segment) rhat_t(prefix up to t)        (the paper's Eq. 4)

rhat_t is linear in the causal state of step t, which has seen (s_1, a_1, ..., s_t, a_t) (Eq. 5).
w_t is how much all steps of the sequence attend to step t: the t-th column sum of a bidirectional
softmax attention (Eqs. 6 and 7), so that the weights of m steps sum to m.

Shapes: B = batch, L = steps of the longest window, N = tokens (2 L or L), H = heads, d = the
embedding's, O and A = observation and action size. Windows are padded on the right: a causal token
never sees the padding behind it, and the attention within the sequence is masked.

The formula beside its symbols: docs/methods.md#codetr.
"""

import math
from contextlib import nullcontext

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.attention import SDPBackend, sdpa_kernel

from codetr_ros.config import CodetrSettings
from codetr_ros.rewards.dropout import add_dropped, keep_mask

KERNELS = [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]
"""Torch's kernels for attention except cuDNN's, which makes a plan for each new number of windows:
one in every phase while the memory grows.
"""


class CausalSelfAttention(nn.Module):
    """Multi-head attention of tokens to themselves and those before them."""

    def __init__(self, settings: CodetrSettings) -> None:
        super().__init__()
        d = settings.embedding
        self.heads = settings.heads
        self.dropout = settings.dropout
        self.qkv = nn.Linear(d, 3 * d)
        self.out = nn.Linear(d, d)

    def forward(self, h: Tensor, every: int = 1) -> Tensor:
        """Tokens (B, N, d) to a mix of what each `every`-th attends to (B, N/every, d)."""
        b, n, d = h.shape
        size = d // self.heads
        if every == 1:
            parts = self.qkv(h).view(b, n, 3, self.heads, size).unbind(2)
        else:
            weight, bias = self.qkv.weight, self.qkv.bias
            asking = F.linear(h[:, every - 1 :: every], weight[:d], bias[:d])  # (B, N/every, d)
            seen = F.linear(h, weight[d:], bias[d:]).view(b, n, 2, self.heads, size)
            parts = (asking.view(b, -1, self.heads, size), *seen.unbind(2))
        q, k, v = (part.transpose(1, 2) for part in parts)  # each (B, H, tokens, d/H)
        y = causal_attention(q, k, v, self.dropout if self.training else 0.0)  # (B, H, N', d/H)
        mixed: Tensor = self.out(y.transpose(1, 2).reshape(b, -1, d))
        return mixed


def causal_attention(q: Tensor, k: Tensor, v: Tensor, dropout: float) -> Tensor:
    """Attention of queries (B, H, Q, c) to keys and values (B, H, N, c), N a multiple of Q.

    Query i belongs to the last token of the i-th of Q equal parts, and sees the tokens up to it.
    With dropout it is written out: torch's own takes several times as long on a CPU.

    Returns:
        (B, H, Q, c).
    """
    asking, tokens = q.shape[2], k.shape[2]
    if not dropout and asking == tokens:
        return F.scaled_dot_product_attention(q, k, v, is_causal=True)
    token = torch.arange(tokens, device=q.device)
    last = (token[:asking, None] + 1) * (tokens // asking) - 1  # (Q, 1)
    unseen = torch.zeros(asking, tokens, device=q.device).masked_fill_(token > last, -math.inf)
    if not dropout:
        return F.scaled_dot_product_attention(q, k, v, attn_mask=unseen)
    scale = 1 / math.sqrt(q.shape[3])
    logits = torch.baddbmm(unseen, q.flatten(0, 1), k.flatten(0, 1).mT, alpha=scale)
    attention = logits.softmax(-1)  # (B H, Q, N)
    attention = attention * keep_mask(attention.shape, dropout, attention.device)
    return (attention @ v.flatten(0, 1)).view(q.shape)


class Block(nn.Module):
    """Pre-norm transformer layer: attention, then an MLP four times as wide."""

    def __init__(self, settings: CodetrSettings) -> None:
        super().__init__()
        d = settings.embedding
        self.norm1 = nn.LayerNorm(d)
        self.attention = CausalSelfAttention(settings)
        self.norm2 = nn.LayerNorm(d)
        self.widen = nn.Linear(d, 4 * d)
        self.narrow = nn.Linear(4 * d, d)
        self.dropout = settings.dropout

    def forward(self, h: Tensor, every: int = 1) -> Tensor:
        """Tokens (B, N, d) to each `every`-th one of the next layer (B, N/every, d)."""
        dropout = self.dropout if self.training else 0.0
        mixed = self.attention(self.norm1(h), every)  # (B, N/every, d)
        h = add_dropped(h[:, every - 1 :: every], mixed, dropout)
        # on rows, not windows: in place on a view would cost two copies in the backward pass
        wide = self.widen(self.norm2(h).flatten(0, 1)).relu_()  # (B N/every, 4d)
        return add_dropped(h, self.narrow(wide).view(h.shape), dropout)


class CausalTransformer(nn.Module):
    """Maps steps to causal states: x_t has seen everything up to step t and nothing after it.

    Tokens are `pair` (a_1, s_1, a_2, s_2, ...), read at the state, which has seen the action of
    its step: the order of the published code of this family. Or they are `merged`, one for each
    step. The last layer leaves out the tokens that are not read: nothing depends on them there. A
    step's position is its place in the window, whatever its time in the episode.
    """

    action_first: bool = True
    """Whether the action is the first token of a pair. Models of old checkpoints have the state
    first, and are read at the action.
    """

    def __init__(
        self, observation_size: int, action_size: int, positions: int, settings: CodetrSettings
    ) -> None:
        super().__init__()
        d = settings.embedding
        self.pair = settings.tokens == 'pair'
        self.observation = nn.Linear(observation_size, d)
        self.action = nn.Linear(action_size, d)
        self.position = nn.Embedding(positions, d)
        self.norm_in = nn.LayerNorm(d)
        self.dropout = settings.dropout
        self.rounded = settings.precision == 'bfloat16'
        self.blocks = nn.ModuleList(Block(settings) for _ in range(settings.layers))
        self.norm_out = nn.LayerNorm(d)

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Observations (B, L, O) and actions (B, L, A) to causal states (B, L, d)."""
        s = self.observation(observations)  # (B, L, d)
        a = self.action(actions)  # (B, L, d)
        position = self.position.weight[: s.shape[1]]  # (L, d)
        if self.pair:
            first, second = (a, s) if self.action_first else (s, a)
            tokens = torch.stack([first + position, second + position], 2).flatten(
                1, 2
            )  # (B, 2L, d)
        else:
            tokens = s + a + position  # (B, L, d)
        h = self.norm_in(tokens)  # (B, N, d)
        if self.training and self.dropout:
            h = h * keep_mask(h.shape, self.dropout, h.device)
        *others, last = self.blocks
        rounded = torch.autocast(h.device.type, torch.bfloat16) if self.rounded else nullcontext()
        attending = sdpa_kernel(KERNELS) if h.is_cuda else nullcontext()
        with rounded, attending:
            for block in others:
                h = block(h)
            h = last(h, 2 if self.pair else 1)
        x: Tensor = self.norm_out(h)  # (B, L, d)
        return x


class SequenceWeights(nn.Module):
    """w_t: how much all steps of the sequence together attend to step t."""

    def __init__(self, settings: CodetrSettings) -> None:
        super().__init__()
        d = settings.embedding
        self.qk = nn.Linear(d, 2 * d)
        scales = {'inverse': 1 / d, 'inverse_sqrt': 1 / math.sqrt(d), 'one': 1.0}
        self.scale = scales[settings.head_scale]

    def attention(self, x: Tensor, inside: Tensor) -> Tensor:
        """Softmax attention (B, L, L) among the steps `inside` (B, L); rows of others are 0."""
        q, k = self.qk(x).chunk(2, -1)  # each (B, L, d)
        unseen = torch.zeros(inside.shape, device=x.device).masked_fill_(~inside, -math.inf)
        logits = self.scale * (q @ k.transpose(1, 2)) + unseen[:, None, :]  # (B, L, L)
        attention: Tensor = logits.softmax(-1) * inside[:, :, None]  # (B, L, L)
        return attention

    def forward(self, x: Tensor, inside: Tensor) -> Tensor:
        """Causal states (B, L, d) to weights (B, L) of the steps that are `inside` (B, L)."""
        return self.attention(x, inside).sum(1)  # (B, L), the column sums


class UnitWeights(nn.Module):
    """w_t = 1: the ablation, a plain sum of causal step rewards."""

    def forward(self, x: Tensor, inside: Tensor) -> Tensor:
        """1 for the steps that are `inside` (B, L), 0 for others."""
        return inside.to(x.dtype)  # (B, L)


class RewardTransformer(nn.Module):
    """Maps the steps of a window to their weights w and rewards rhat.

    Args:
        observation_size: O.
        action_size: A.
        positions: steps of the longest window that can occur.
        settings: architecture and dropout.
    """

    def __init__(
        self, observation_size: int, action_size: int, positions: int, settings: CodetrSettings
    ) -> None:
        super().__init__()
        self.causal = CausalTransformer(observation_size, action_size, positions, settings)
        attentive = settings.weights == 'attention'
        self.weights = SequenceWeights(settings) if attentive else UnitWeights()
        self.reward = nn.Linear(settings.embedding, 1)
        initialise(self, settings)

    def forward(
        self, observations: Tensor, actions: Tensor, inside: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Weights and rewards of every step.

        Args:
            observations: (B, L, O) before each step.
            actions: (B, L, A).
            inside: (B, L) bool, the steps that attend to each other; at least one in each row.

        Returns:
            w (B, L), 0 outside, and rhat (B, L), meaningless in the padding.
        """
        x = self.causal(observations, actions)  # (B, L, d)
        return self.weights(x, inside), self.reward(x).squeeze(-1)


def initialise(network: nn.Module, settings: CodetrSettings) -> None:
    """Zero biases and normal weights.

    'gpt2' (standard deviation 0.02, and 0.02 / sqrt(2 layers) where a block adds to its input)
    begins close to a function of each step alone, to which training adds the influence of earlier
    steps. 'lecun' (variance 1/inputs, the default of the Flax modules in the published code of
    this family) begins with steps thoroughly mixed. Credit then stays on the wrong steps of a
    segment, though its sum is right.
    """
    for module in network.modules():
        if isinstance(module, nn.Linear):
            width = module.in_features
            nn.init.zeros_(module.bias)
        elif isinstance(module, nn.Embedding):
            width = module.embedding_dim
        else:
            continue
        gpt2 = settings.initialisation == 'gpt2'
        nn.init.normal_(module.weight, std=0.02 if gpt2 else 1 / math.sqrt(width))
    if settings.initialisation == 'gpt2':
        for block in network.modules():
            if isinstance(block, Block):
                for residual in (block.attention.out, block.narrow):
                    nn.init.normal_(residual.weight, std=0.02 / math.sqrt(2 * settings.layers))
