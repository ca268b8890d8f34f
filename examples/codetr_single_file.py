r"""CoDeTr and SAC in one file, to be read beside the paper (arXiv 2410.20176).

An episode is cut into segments of n steps, and all that is known of their rewards is one number
for each segment, its composite reward R_co. CoDeTr fits R_co(segment) = sum_t w_t(segment)
rhat_t(steps up to t) by regression (Eq. 4), and SAC learns from w_t rhat_t as step rewards:
Algorithm 1, at the end of the file. `.venv/bin/python examples/codetr_single_file.py` ends with
the same weights, bit for bit, and prints the same digests as the summary.json of the library by

    codetr train --in-process --config quick --delay 25 --steps 3000 \
        --evaluate-every 0 --codetr.base none --codetr.tokens pair

on the same machine. Left out is what does not change the weights (nodes, checkpoints, evaluation)
and what is not used with these settings: dropout, eviction from a full memory and, since no
episode of this task ends before its horizon, terminal states and short segments.

Shapes: B = batch, n = steps of a segment, N = tokens, or networks side by side, d = width of the
transformer, O and A = observation and action size, H = width of a layer of SAC.
"""

import hashlib
import math
from itertools import pairwise

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Settings: those of this command, and in brackets the paper's, where it has others.
TASK, HORIZON = 'Reacher-v5', 50  # its actions lie in [-1, 1] [Ant-v2, 1000]
COMPOSITE, DELAY = 'sum', 25  # R_co, one of COMPOSITES; n, a divisor of HORIZON and PHASE
SEED, STEPS, WARMUP, PHASE = 0, 3000, 1000, 1000  # steps: all, random, of a phase [1M, 10k, 1k]
LAYERS, HEADS, WIDTH, SCALE = 2, 4, 64, 1 / 64  # d; factor on the logits of Eq. 6 [3, 4, 256]
SEGMENTS, DECAY, GRADIENT_STEPS = 64, 1e-4, (200, 20)  # first, later phases: [100, 10]
HIDDEN, BATCH, BURST = (128, 128), 128, 50  # updates from one random stream [(256, 256), 256]
GAMMA, TAU, RATE, ALPHA = 0.99, 0.005, 1e-3, 0.1  # Adam's rate; first temperature [3e-4, 1]
ENTROPY, LOG_STD = -0.5, (-10.0, 2.0)  # target entropy for each number of an action; clip
COMPOSITES = {  # R_co of the rewards r (n,) of a segment
    'sum': lambda r: r.sum(),
    'sum_square': lambda r: (np.abs(r) * r).sum(),
    'square_sum': lambda r: abs(r.sum()) * r.sum(),
    'max': lambda r: (w := np.exp(3 * (r - r.max()))) @ r / w.sum(),  # beta = 3
}


def stream(*names: str | int) -> np.random.Generator:
    """A generator by the seed and by what it is for; torch's own is seeded by the same number."""
    text = '\x1f'.join(map(str, (SEED, *names)))
    entropy = int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], 'big')
    torch.manual_seed(entropy & (2**63 - 1))
    return np.random.Generator(np.random.PCG64(entropy))


class Memory:
    """The memory D, and the simulator that fills it: step i is in segment i // n."""

    def __init__(self) -> None:
        self.env, self.steps = gymnasium.make(TASK).unwrapped, 0  # without a time limit
        self.sizes = self.env.observation_space.shape[0], self.env.action_space.shape[0]
        self.s, self.s2 = np.zeros((2, STEPS, self.sizes[0]), np.float32)  # before, after a step
        self.a = np.zeros((STEPS, self.sizes[1]), np.float32)
        self.rewards, self.labels = np.zeros(STEPS), np.zeros(STEPS, np.float32)  # true, inferred

    def simulate(self, phase: int, policy: list[Tensor] | None) -> None:
        """Take the steps of a phase: by the policy, or uniformly random ones."""
        rng, shape = stream('noise', 'sim', phase), (PHASE, self.sizes[1])
        draws = rng.standard_normal(shape, np.float32) if policy else rng.random(shape, np.float32)
        for i, draw in enumerate(draws, self.steps):
            if i % HORIZON == 0:
                seed = int(stream('reset', 'sim', i // HORIZON).integers(2**31))
                self.now = self.env.reset(seed=seed)[0]
            self.s[i] = self.now
            self.a[i] = act(policy, self.s[i], draw) if policy else draw * 2 - 1
            self.now, self.rewards[i], terminated, _, _ = self.env.step(self.a[i])
            assert not terminated, f'{TASK} has terminal states, for which this file has no code'
            self.s2[i] = self.now
        self.steps += PHASE
        segments = self.rewards[: self.steps].reshape(-1, DELAY)
        self.scores = np.array([COMPOSITES[COMPOSITE](r) for r in segments])  # R_co


class Block(nn.Module):
    """A pre-norm transformer layer: causal attention, then an MLP four times as wide."""

    def __init__(self, d: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(d), nn.LayerNorm(d)
        self.attention = nn.ModuleDict({'qkv': nn.Linear(d, 3 * d), 'out': nn.Linear(d, d)})
        self.widen, self.narrow = nn.Linear(d, 4 * d), nn.Linear(4 * d, d)

    def forward(self, h: Tensor, every: int) -> Tensor:
        """Tokens (B, N, d) to each `every`-th one of the next layer (B, N/every, d)."""
        (B, N, d), x, qkv, mask = h.shape, self.norm1(h), self.attention.qkv, None
        if every == 1:
            q, k, v = qkv(x).chunk(3, -1)  # (B, N, d) each
        else:
            q = F.linear(x[:, every - 1 :: every], qkv.weight[:d], qkv.bias[:d])  # (B, N/every, d)
            k, v = F.linear(x, qkv.weight[d:], qkv.bias[d:]).chunk(2, -1)
            mask = torch.full((N, N), -math.inf).triu(1)[every - 1 :: every]  # (N/every, N)
        q, k, v = (x.view(B, -1, HEADS, d // HEADS).transpose(1, 2) for x in (q, k, v))
        y = F.scaled_dot_product_attention(q, k, v, mask, is_causal=mask is None)
        h = h[:, every - 1 :: every] + self.attention.out(y.transpose(1, 2).reshape(B, -1, d))
        return h + self.narrow(self.widen(self.norm2(h)).relu())


class RewardModel(nn.Module):
    """The reward transformer, fitted to the composite rewards of D."""

    def __init__(self, O: int, A: int, d: int = WIDTH) -> None:
        super().__init__()
        stream('codetr', 'init')
        net = self.causal = nn.Module()
        net.observation, net.action = nn.Linear(O, d), nn.Linear(A, d)
        net.position = nn.Embedding(100, d)  # in the segment; the paper's window has 100 steps
        net.blocks = nn.ModuleList(Block(d) for _ in range(LAYERS))
        net.norm_in, net.norm_out = nn.LayerNorm(d), nn.LayerNorm(d)
        self.weights, self.reward = nn.ModuleDict({'qk': nn.Linear(d, 2 * d)}), nn.Linear(d, 1)
        for name, p in self.named_parameters():  # initial weights as GPT-2 has them
            if name.endswith('bias'):
                nn.init.zeros_(p)
            elif 'norm' not in name:
                nn.init.normal_(p, std=0.02)
        for block in net.blocks:
            for layer in block.attention.out, block.narrow:  # which add to a block's input
                nn.init.normal_(layer.weight, std=0.02 / math.sqrt(2 * LAYERS))
        self.adamw = torch.optim.AdamW(self.parameters(), weight_decay=DECAY, fused=True)
        self.register_buffer('version', torch.tensor(0))  # gradient steps taken
        self.register_buffer('action_first', torch.tensor(1))  # of the two tokens of a step

    def forward(self, D: Memory, ids: np.ndarray) -> Tensor:
        """The step rewards w_t rhat_t (B, n) of segments, in units of c."""
        s, a = (torch.tensor(x.reshape(-1, DELAY, x.shape[1])[ids]) for x in (D.s, D.a))
        net, place = self.causal, self.causal.position.weight[:DELAY]  # (n, d)
        s = net.observation((s - self.observation_mean) / self.observation_std) + place
        a = net.action(a) + place  # (B, n, d) each
        h = net.norm_in(torch.stack([a, s], 2).flatten(1, 2))  # (B, 2n, d): a_1, s_1, a_2, ...
        for block in net.blocks[:-1]:
            h = block(h, every=1)
        x = net.norm_out(net.blocks[-1](h, every=2))  # (B, n, d), read at the state of each step
        rhat = self.reward(x).squeeze(-1)  # (B, n) (Eq. 5)
        q, k = self.weights.qk(x).chunk(2, -1)  # (B, n, d) each
        w = (SCALE * (q @ k.mT)).softmax(-1).sum(1)  # (B, n), sums over the queries (Eqs. 6, 7)
        return w * rhat

    def fit(self, D: Memory, phase: int) -> float:
        """Gradient steps on the squared error of Eq. 4; that of the last one, in units of c^2."""
        if not self.version:  # once: c, the root mean square R_co of a step, and moments of s
            s = D.s[: D.steps].astype(np.float64)
            c = np.sqrt(((D.scores / DELAY) ** 2).mean())
            self.register_buffer('target_scale', torch.tensor(c))
            self.register_buffer('observation_mean', torch.tensor(s.mean(0)).float())
            self.register_buffer('observation_std', torch.tensor(s.std(0).clip(1e-2)).float())
        for i in range(GRADIENT_STEPS[phase >= WARMUP // PHASE]):
            ids = stream('reward', phase, i).integers(0, len(D.scores), SEGMENTS)
            target = (torch.tensor(D.scores[ids]) / self.target_scale).float()  # (B,)
            loss = F.mse_loss(self(D, ids).sum(1), target)
            self.adamw.zero_grad()
            loss.backward()
            rate = min(1e-3, 1e-3 * (int(self.version) + 1) / 100)  # 100 steps of warm-up [5e-5]
            self.adamw.param_groups[0]['lr'] = rate
            self.adamw.step()
            self.version += 1
        return loss.item()


class Flat:
    """Parameters, weights and biases by turns, as views of one tensor; Adam for all at once."""

    def __init__(self, parameters: list[Tensor]) -> None:
        self.flat = torch.cat([p.reshape(-1) for p in parameters])
        parts = self.flat.split([p.numel() for p in parameters])
        self.views = [part.view_as(p) for part, p in zip(parts, parameters, strict=True)]
        self.adam = torch.optim.Adam([self.flat], RATE, fused=True)

    def descend(self, gradients: list[Tensor]) -> None:
        """A step of Adam."""
        self.flat.grad = torch.cat([g.reshape(-1) for g in gradients])
        self.adam.step()


def inputs_of(layers: list[Tensor], x: Tensor) -> list[Tensor]:
    """What enters each layer (N, B, in), with ReLU; weights (N, in, out), biases (N, 1, out)."""
    inputs = [x]
    for W, b in zip(layers[:-2:2], layers[1:-2:2], strict=True):
        inputs.append(torch.baddbmm(b, inputs[-1], W).relu())
    return inputs


def q_values(critic: list[Tensor], s: Tensor, a: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Q (2, B) of both critics, and what enters their layers."""
    inputs = inputs_of(critic, torch.cat([s, a], -1).expand(2, -1, -1))
    return (inputs[-1] * critic[-2].mT).sum(-1) + critic[-1].squeeze(-1), inputs


def backward(layers: list[Tensor], inputs: list[Tensor], d: Tensor) -> list[tuple]:
    """For each layer what enters it, and the gradient (N, B, out) of what it gives to its ReLU."""
    ds = [d]  # the last layer's is given
    for W, x in zip(layers[-2:0:-2], inputs[:0:-1], strict=True):
        ds.insert(0, (ds[0] @ W.mT).where(x > 0, 0))
    return list(zip(inputs, ds, strict=True))


class SAC:
    """Soft actor-critic as jaxrl has it. By hand, as in the library: autograd rounds otherwise."""

    def __init__(self, O: int, A: int) -> None:
        stream('sac', 'init')
        layers = [nn.Linear(i, o) for i, o in pairwise((O, *HIDDEN, 2 * A))]
        actor = [p.detach() for x in layers for p in (x.weight, torch.zeros_like(x.bias))]
        widths = list(pairwise((O + A, *HIDDEN, 1)))
        critic = [torch.zeros(2, *size) for i, o in widths for size in ((i, o), (1, o))]
        both, root = [W for stack in critic[::2] for W in stack], math.sqrt(2)
        for gain, Ws in (root, actor[:-2:2]), (1, actor[-2].chunk(2)), (root, both):
            for W in Ws:
                nn.init.orthogonal_(W, gain)  # 1: mean and log std
        self.actor, self.critic, self.target = Flat(actor), Flat(critic), Flat(critic)
        self.log_alpha = Flat([torch.tensor(math.log(ALPHA))])

    @torch.no_grad()
    def update(self, D: Memory, rows: np.ndarray) -> None:
        """One update of actor, critics, targets and temperature."""
        s, a, r, s2 = (torch.tensor(x[rows]) for x in (D.s, D.a, D.labels, D.s2))
        (B, A), alpha, critic = a.shape, self.log_alpha.flat.exp().squeeze(), self.critic.views
        actor = [p.T[None] if p.ndim == 2 else p[None, None] for p in self.actor.views]
        # Actions a = tanh(u), u = mean + std noise, after s' and s, and their log pi(a|s).
        noise, actor_inputs = torch.randn(2 * B, A), inputs_of(actor, torch.cat([s2, s])[None])
        out = torch.baddbmm(actor[-1], actor_inputs[-1], actor[-2])[0]  # (2B, 2A)
        log_std = out[:, A:].clamp(*LOG_STD)
        u = out[:, :A] + log_std.exp() * noise
        log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        log_slope = 2 * (math.log(2) - u - F.softplus(-2 * u))  # log(1 - tanh(u)^2)
        (a2, a_pi), log_pi = u.tanh().chunk(2), (log_normal - log_slope).sum(-1)  # log_pi (2B,)
        # Critics: the mean of (Q_1(s, a) - y)^2 + (Q_2(s, a) - y)^2, where
        # y = r + gamma (min_i Q'_i(s', a') - alpha log pi(a'|s')), a' ~ pi(s').
        q2 = torch.minimum(*q_values(self.target.views, s2, a2)[0])
        y = r + GAMMA * (q2 - alpha * log_pi[:B])  # (B,), also at the horizon: it is no end
        q, inputs = q_values(critic, s, a)
        pairs = backward(critic, inputs, (2 / B) * (q - y)[..., None])
        self.critic.descend([g for x, d in pairs for g in (x.mT @ d, d.sum(1))])
        # Targets: Q' <- (1 - tau) Q' + tau Q.
        self.target.flat.lerp_(self.critic.flat, TAU)
        # Actor: the mean of alpha log pi(a|s) - min_i Q_i(s, a), under the new critics.
        q, inputs = q_values(critic, s, a_pi)
        share = 0.5 + 0.5 * (q.flip(0) - q).sign()  # (2, B): 1 for the smaller Q
        _, d = backward(critic, inputs, (-1 / B) * share[..., None])[0]
        da = (d @ critic[0][:, -A:].mT).sum(0)  # (B, A)
        du = da * (1 - a_pi.square()) + (2 / B) * alpha * a_pi
        d_log_std = du * log_std[B:].exp() * noise[B:] - alpha / B
        d_log_std *= log_std[B:] == out[B:, A:]  # not where it was clipped
        d = torch.cat([du, d_log_std], -1)[None]  # (1, B, 2A)
        pairs = backward(actor, [x[:, B:] for x in actor_inputs], d)
        self.actor.descend([g for x, d in pairs for g in (d.mT @ x, d.sum(1))])
        # Temperature: alpha (entropy - target entropy).
        self.log_alpha.descend([alpha * (-log_pi[B:].mean() - ENTROPY * A)])


def act(policy: list[Tensor], s: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The action (A,) after one observation (O,)."""
    x = torch.tensor(s)
    for W, b in zip(policy[:-2:2], policy[1:-2:2], strict=True):
        x = torch.addmv(b, W, x).relu()  # (H,)
    mean, log_std = torch.addmv(policy[-1], policy[-2], x).chunk(2)
    u = torch.addcmul(mean, log_std.clamp(*LOG_STD).exp(), torch.tensor(noise))
    return u.tanh().clamp(-1, 1).numpy()


def digest(tensors: dict[str, Tensor]) -> str:
    """The sha256 of named tensors, as a summary.json has it."""
    total = hashlib.sha256()
    for name, x in sorted(tensors.items()):
        total.update(f'["{name}", "{x.dtype}", {list(x.shape)}]\n'.encode())
        total.update(x.detach().numpy().tobytes())
    return total.hexdigest()


if __name__ == '__main__':  # Algorithm 1
    torch.set_num_threads(1)
    D, policy = Memory(), None
    model, sac = RewardModel(*D.sizes), SAC(*D.sizes)
    for phase in range(STEPS // PHASE):
        D.simulate(phase, policy)
        if D.steps < WARMUP:
            continue
        loss = model.fit(D, phase)
        with torch.inference_mode():  # all labels anew, of 256 segments at most
            D.labels[: D.steps] = model(D, np.arange(len(D.scores))).flatten().numpy()
        for first in range(0, PHASE, BURST):
            rng = stream('learner', phase, first)
            for _ in range(BURST):
                sac.update(D, rng.integers(0, D.steps, BATCH))
        policy = [p.clone() for p in sac.actor.views]
        print(f'{D.steps} steps, R_co {D.scores[-PHASE // DELAY :].mean():.2f}, loss {loss:.3g}')
    names = [f'{x}.{kind}' for x in ('body.0', 'body.2', 'heads') for kind in ('weight', 'bias')]
    print('policy_sha256', digest(dict(zip(names, sac.actor.views, strict=True))))
    state = dict(model.named_buffers())
    for name, p in model.named_parameters():
        state[f'network.{name}'] = p
        state |= {f'adamw.{key}.{name}': x for key, x in model.adamw.state[p].items()}
    print('reward_model_sha256', digest(state))
