"""The reward transformer: a causal transformer over steps, then attention within the sequence.

    R(segment) = sum_t w_t(segment) rhat_t(prefix up to t)        (the paper's Eq. 4)

rhat_t is linear in the causal state of step t, which has seen (s_1, a_1, ..., s_t, a_t) (Eq. 5).
w_t is how much all steps of the sequence attend to step t: the t-th column sum of a bidirectional
softmax attention (Eqs. 6 and 7), so that the weights of m steps sum to m.

Shapes: B = batch, L = steps of the longest window, N = tokens (2 L or L), H = heads, d = the
embedding's, O and A = observation and action size. Windows are padded on the right: a causal token
never sees the padding behind it, and the attention within the sequence is masked.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from codetr_ros.config import CodetrSettings


class CausalSelfAttention(nn.Module):
    """Multi-head attention of each token to itself and those before it."""

    def __init__(self, settings: CodetrSettings) -> None:
        super().__init__()
        d = settings.embedding
        self.heads = settings.heads
        self.dropout = settings.dropout
        self.qkv = nn.Linear(d, 3 * d)
        self.out = nn.Linear(d, d)

    def forward(self, h: Tensor) -> Tensor:
        """Tokens (B, N, d) to what they attend to, mixed (B, N, d)."""
        b, n, d = h.shape
        qkv = self.qkv(h).view(b, n, 3, self.heads, d // self.heads)  # (B, N, 3, H, d/H)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)  # each (B, H, N, d/H)
        p = self.dropout if self.training else 0.0
        y = F.scaled_dot_product_attention(q, k, v, dropout_p=p, is_causal=True)  # (B, H, N, d/H)
        mixed: Tensor = self.out(y.transpose(1, 2).reshape(b, n, d))  # (B, N, d)
        return mixed


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
        self.dropout = nn.Dropout(settings.dropout)

    def forward(self, h: Tensor) -> Tensor:
        """Tokens (B, N, d) to tokens of the next layer (B, N, d)."""
        h = h + self.dropout(self.attention(self.norm1(h)))  # (B, N, d)
        wide = F.relu(self.widen(self.norm2(h)))  # (B, N, 4d)
        mixed: Tensor = h + self.dropout(self.narrow(wide))  # (B, N, d)
        return mixed


class CausalTransformer(nn.Module):
    """Steps to their causal states: x_t has seen what happened up to step t, nothing after it.

    Tokens are `pair` (s_1, a_1, s_2, a_2, ...), read at the action, or `merged`, one for each
    step. A step's position is its place in the window, whatever its time in the episode.
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
        self.dropout = nn.Dropout(settings.dropout)
        self.blocks = nn.Sequential(*(Block(settings) for _ in range(settings.layers)))
        self.norm_out = nn.LayerNorm(d)

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Observations (B, L, O) and actions (B, L, A) to causal states (B, L, d)."""
        s = self.observation(observations)  # (B, L, d)
        a = self.action(actions)  # (B, L, d)
        position = self.position.weight[: s.shape[1]]  # (L, d)
        if self.pair:
            tokens = torch.stack([s + position, a + position], 2).flatten(1, 2)  # (B, 2L, d)
        else:
            tokens = s + a + position  # (B, L, d)
        h = self.blocks(self.dropout(self.norm_in(tokens)))  # (B, N, d)
        x: Tensor = self.norm_out(h[:, 1::2] if self.pair else h)  # (B, L, d)
        return x


class SequenceWeights(nn.Module):
    """w_t: how much the steps of the sequence attend to step t, all of them together."""

    def __init__(self, settings: CodetrSettings) -> None:
        super().__init__()
        d = settings.embedding
        self.qk = nn.Linear(d, 2 * d)
        scales = {'inverse': 1 / d, 'inverse_sqrt': 1 / math.sqrt(d), 'one': 1.0}
        self.scale = scales[settings.head_scale]

    def attention(self, x: Tensor, inside: Tensor) -> Tensor:
        """Softmax attention (B, L, L) among the steps `inside` (B, L); rows of others are 0."""
        q, k = self.qk(x).chunk(2, -1)  # each (B, L, d)
        unseen = torch.zeros(inside.shape).masked_fill_(~inside, -math.inf)  # (B, L)
        logits = self.scale * (q @ k.transpose(1, 2)) + unseen[:, None, :]  # (B, L, L)
        found: Tensor = logits.softmax(-1) * inside[:, :, None]  # (B, L, L)
        return found

    def forward(self, x: Tensor, inside: Tensor) -> Tensor:
        """Causal states (B, L, d) to weights (B, L) of the steps that are `inside` (B, L)."""
        return self.attention(x, inside).sum(1)  # (B, L), the column sums


class UnitWeights(nn.Module):
    """w_t = 1: the ablation, a plain sum of causal step rewards."""

    def forward(self, x: Tensor, inside: Tensor) -> Tensor:
        """1 for the steps that are `inside` (B, L), 0 for others."""
        return inside.to(x.dtype)  # (B, L)


class RewardTransformer(nn.Module):
    """Steps of a window to their weights w and rewards rhat.

    Args:
        observation_size: O.
        action_size: A.
        positions: steps of the longest window that will ever come.
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
            w (B, L), 0 outside, and rhat (B, L), of no meaning in the padding.
        """
        x = self.causal(observations, actions)  # (B, L, d)
        return self.weights(x, inside), self.reward(x).squeeze(-1)


def initialise(network: nn.Module, settings: CodetrSettings) -> None:
    """Zero biases and normal weights.

    'gpt2' (standard deviation 0.02, and 0.02 / sqrt(2 layers) where a block adds to its input)
    begins close to a function of each step alone, to which training adds what earlier steps have
    to say. 'lecun' (variance 1/inputs, the default of the Flax modules of the published code of
    this family) begins with steps thoroughly mixed, and credit then stays on the wrong steps of a
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
