"""The update of `sac.SAC` made fast: gradients by hand, weights in a few flat tensors.

All parameters of one optimiser lie in one tensor, Adam's moments likewise, so that a step of Adam
or of the targets is one call; the weights and moments that others see are views of these. One pass
of the actor serves both s' and s. In the actor's step gradients go through the critics to the
actions and no further. Autograd is not used: its work is written out below, and gives the same up
to rounding.

Shapes: B = batch, O = observation size, A = action size, H = width of a hidden layer. A network is
a stack of N networks, N = 1 (actor) or 2 (critics, targets): its layers are weights (N, in, out)
and biases (N, 1, out), one after the other; its activations are (N, B, H).

The formula beside its symbols: docs/methods.md#sac.
"""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from codetr_ros.config import SacSettings
from codetr_ros.learners.sac import SAC, Adam, squashed_gaussian
from codetr_ros.memory.batches import StepBatch
from codetr_ros.policy.network import LOG_STD_RANGE
from codetr_ros.system import freed_memory
from codetr_ros.system.compilation import compiled

METRICS = ('critic_loss', 'actor_loss', 'temperature', 'entropy', 'q_mean')
"""The metrics of `SAC.update`, in the order in which they are summed here."""
DRAWN_AT_ONCE = 64
"""Updates whose steps and noise are drawn at once; more would take memory and save no time."""


class FlatSAC(SAC):
    """SAC with the fast update. The states of this form and of the plain one are the same."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        settings: SacSettings,
        seed: int,
        device: torch.device | str = 'cpu',
        progress: int = 0,
    ) -> None:
        """Make the networks: the same as the plain form makes for the same arguments.

        Args:
            observation_size: O.
            action_size: A.
            settings: widths, learning rates and the rest.
            seed: of the initial weights; torch's global generator is seeded from it.
            device: where weights, moments and sums lie; the initial weights are the same anywhere.
            progress: numbers behind each observation of a batch, which critics alone see.
        """
        super().__init__(observation_size, action_size, settings, seed, progress)
        freed_memory.keep()
        self.batch = settings.batch
        self.critic_adam: FlatAdam = FlatAdam(self.critic, settings.critic_learning_rate, device)
        self.actor_adam: FlatAdam = FlatAdam(
            list(self.actor.parameters()), settings.actor_learning_rate, device
        )
        self.temperature_adam: FlatAdam = FlatAdam(
            [self.log_temperature], settings.temperature_learning_rate, device
        )
        self.critic_values = self.critic_adam.views(self.critic_adam.flat)
        self._flat_target = self.critic_adam.flat.clone()
        self.target = self.critic_adam.views(self._flat_target)
        self._sums = torch.zeros(len(METRICS), device=device)
        self._step = self._update
        if settings.compile:
            self._compile(self._example(observation_size + progress, action_size))

    def _example(self, observation_size: int, action_size: int) -> tuple[Tensor, ...]:
        """Arguments of `_update` that lie in memory like those of every update: each in memory of
        its own, because code compiled for two arguments in one place serves no others.
        """
        B, O, A = self.batch, observation_size, action_size  # noqa: E741
        shapes = (B, O), (B, A), (B,), (B, O), (B,), (2, B, A)
        return tuple(map(torch.zeros, shapes))

    @torch.no_grad()
    def _compile(self, example: tuple[Tensor, ...]) -> None:
        """Compile the update by taking one, which is then undone."""
        state = self.state()
        self._step = compiled(self._update, example, without='sac.compile=false')
        self.load_state(state)
        self._sums.zero_()

    def update(self, batch: StepBatch) -> dict[str, Tensor]:
        """One update of everything, as `SAC.update`."""
        self._learn(batch, 1)
        return self._take_metrics()

    def burst(self, updates: int, draw: Callable[[int], StepBatch]) -> dict[str, Tensor]:
        """Take many updates.

        Args:
            updates: how many.
            draw: draws a number of steps to learn from.

        Returns:
            The metrics of `SAC.update`, summed over the updates.
        """
        for first in range(0, updates, DRAWN_AT_ONCE):
            count = min(DRAWN_AT_ONCE, updates - first)
            self._learn(draw(count * self.batch), count)
        return self._take_metrics()

    def _take_metrics(self) -> dict[str, Tensor]:
        metrics = dict(zip(METRICS, self._sums.clone(), strict=True))
        self._sums.zero_()
        return metrics

    @torch.no_grad()
    def _learn(self, batch: StepBatch, updates: int) -> None:
        """Updates, each from its share of the batch, in order."""
        # Copies, in memory of torch's own: how an array lies can change the last bit of a product.
        own = partial(torch.tensor, device=self._sums.device)
        s, a, r = map(own, (batch.observations, batch.actions, batch.rewards))
        s2, terminated = map(own, (batch.next_observations, batch.terminated))
        going_on = self.discount * (1 - terminated.to(r.dtype))
        # the numbers that updates one by one would draw, where B A is a multiple of 8
        noise = torch.randn(
            updates, 2, len(a) // updates, a.shape[1], dtype=a.dtype, device=a.device
        )
        shares = (part.view(updates, -1, *part.shape[1:]) for part in (s, a, r, s2, going_on))
        for share in zip(*shares, noise, strict=True):
            self._step(*share)

    def _update(
        self, s: Tensor, a: Tensor, r: Tensor, s2: Tensor, going_on: Tensor, noise: Tensor
    ) -> None:
        """One update; its metrics are added to the sums.

        Args:
            s: observations (B, O), and behind them what critics alone see.
            a: actions (B, A).
            r: rewards (B,).
            s2: next observations, the same.
            going_on: gamma (1 - terminated), (B,).
            noise: standard normal, (2, B, A): of the actions after s', and after s.
        """
        B, A = a.shape
        actor = _stack_of_one(self.actor_adam.views(self.actor_adam.flat))
        critic = self.critic_adam.views(self.critic_adam.flat)
        target = self.critic_adam.views(self._flat_target)
        alpha = self.temperature_adam.flat.exp().squeeze()

        # The policy's actions after s' and s, in one pass.
        actor_hidden = forward(actor, self._seen(torch.cat([s2, s]))[None])
        out = torch.baddbmm(actor[-1], actor_hidden[-1], actor[-2])[0]  # (2B, 2A)
        mean, log_std = out[:, :A], out[:, A:].clamp(*LOG_STD_RANGE)
        actions, log_probs = squashed_gaussian((mean, log_std), noise.view(2 * B, A))
        (a2, a_pi), (log_prob2, log_prob) = actions.chunk(2), log_probs.chunk(2)

        # Target: y = r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha log pi(a'|s')).
        q2 = values(target, forward(target, pairs(s2, a2)))
        y = r + going_on * (torch.minimum(*q2) - alpha * log_prob2)  # (B,)

        # Critics: the mean over the batch of (Q_1(s, a) - y)^2 + (Q_2(s, a) - y)^2.
        hidden = forward(critic, pairs(s, a))
        q = values(critic, hidden)  # (2, B)
        error = q - y
        dq = (2 / B) * error.unsqueeze(-1)  # (2, B, 1)
        by_layer = slopes(critic, hidden, dq * critic[-2].mT)
        gradients = [
            g for x, d in zip(hidden[:-1], by_layer, strict=True) for g in (x.mT @ d, d.sum(1))
        ]
        # the last one is (2, 1, H), the same numbers as (2, H, 1) and twelve times as fast
        self.critic_adam.descend([*gradients, dq.mT @ hidden[-1], dq.sum(1)])

        # Targets follow: Q' <- (1 - tau) Q' + tau Q.
        self._flat_target.lerp_(self.critic_adam.flat, self.tau)

        # Actor: the mean of alpha log pi(a|s) - min_i Q_i(s, a), a ~ pi(s), under the new critics.
        hidden = forward(critic, pairs(s, a_pi))
        q1_pi, q2_pi = values(critic, hidden)
        # the smaller value alone has a gradient; equal ones have half of it each
        first = 0.5 + 0.5 * (q2_pi - q1_pi).sign()
        dq = (-1 / B) * torch.stack([first, 1 - first]).unsqueeze(-1)
        d = slopes(critic, hidden, dq * critic[-2].mT)[0]
        da = torch.bmm(d, critic[0][:, -A:].mT).sum(0)  # (B, A)
        # d a / d u = 1 - a^2, and d log pi / d u = 2 tanh(u) = 2 a; u = mean + exp(log_std) noise
        du = da * (1 - a_pi.square()) + (2 / B) * alpha * a_pi
        d_log_std = du * log_std[B:].exp() * noise[1] - alpha / B
        inside = (out[B:, A:] >= LOG_STD_RANGE[0]) & (out[B:, A:] <= LOG_STD_RANGE[1])
        d_out = torch.cat([du, d_log_std * inside], -1)[None]  # (1, B, 2A)
        hidden = [x[:, B:] for x in actor_hidden]
        by_layer = [*slopes(actor, hidden, d_out @ actor[-2].mT), d_out]
        gradients = [
            g for x, d in zip(hidden, by_layer, strict=True) for g in (d.mT @ x, d.sum(1))
        ]
        self.actor_adam.descend(gradients)

        # Temperature: alpha (entropy - target entropy), the entropy as the actor's step saw it.
        entropy = -log_prob.mean()
        self.temperature_adam.descend([alpha * (entropy - self.target_entropy)])

        actor_loss = (alpha * log_prob - torch.minimum(q1_pi, q2_pi)).mean()
        critic_loss = error.square().sum(0).mean()
        self._sums += torch.stack([critic_loss, actor_loss, alpha, entropy, q.mean()])


class FlatAdam(Adam):
    """Adam for parameters that lie in one tensor, one step at a time for given gradients.

    The parameters become views of `flat`, and the moments in `state` views of `mean` and `square`.
    """

    def __init__(
        self,
        parameters: Sequence[nn.Parameter],
        learning_rate: float,
        device: torch.device | str = 'cpu',
    ) -> None:
        super().__init__(parameters, learning_rate)
        self.flat = torch.cat([p.detach().reshape(-1) for p in parameters]).to(device)
        self.mean, self.square = torch.zeros_like(self.flat), torch.zeros_like(self.flat)
        self.count = torch.zeros((), dtype=torch.float32, device=device)
        self._shapes = [p.shape for p in parameters]
        for parameter, view in zip(parameters, self.views(self.flat), strict=True):
            parameter.data = view
        self.means, self.squares = self.views(self.mean), self.views(self.square)
        self.steps = [self.count] * len(self.parameters)

    def views(self, flat: Tensor) -> list[Tensor]:
        """The parts of a tensor like `flat`, each in its parameter's shape."""
        parts = torch.split(flat, [shape.numel() for shape in self._shapes])
        return [part.view(shape) for part, shape in zip(parts, self._shapes, strict=True)]

    def descend(self, gradients: Sequence[Tensor]) -> None:
        """One step down these gradients: as many numbers as parameters, in their order."""
        compiling = torch.compiler.is_compiling()  # the fused form cannot be compiled
        adam(
            [self.flat],
            [torch.cat([g.reshape(-1) for g in gradients])],
            [self.mean],
            [self.square],
            [],
            [self.count],
            foreach=False,
            fused=not compiling,
            capturable=compiling,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )


def _stack_of_one(parameters: Sequence[Tensor]) -> list[Tensor]:
    """The layers of an actor, weights (out, in) and biases (out,), as those of a stack."""
    return [p.T[None] if p.ndim == 2 else p[None, None] for p in parameters]


def pairs(observations: Tensor, actions: Tensor) -> Tensor:
    """The input of both critics: (2, B, O+A)."""
    return torch.cat([observations, actions], -1).expand(2, -1, -1)


def forward(network: Sequence[Tensor], x: Tensor) -> list[Tensor]:
    """The input (N, B, in) and the activations of each hidden layer."""
    activations = [x]
    for weight, bias in zip(network[:-2:2], network[1:-2:2], strict=True):
        activations.append(torch.baddbmm(bias, activations[-1], weight).relu_())
    return activations


def values(critic: Sequence[Tensor], activations: Sequence[Tensor]) -> Tensor:
    """The values (2, B) that critics with these activations give to each pair."""
    # faster than a product with one column
    return (activations[-1] * critic[-2].mT).sum(-1) + critic[-1].squeeze(-1)


def slopes(
    network: Sequence[Tensor], activations: Sequence[Tensor], gradient: Tensor
) -> list[Tensor]:
    """Gradients with respect to the input of each hidden layer's ReLU, the first one first.

    Args:
        network: its layers.
        activations: the result of `forward`.
        gradient: with respect to the last activations.
    """
    gradients: list[Tensor] = []
    for i in reversed(range(1, len(activations))):
        gradients.insert(0, torch.ops.aten.threshold_backward(gradient, activations[i], 0))
        if i > 1:
            gradient = gradients[0] @ network[2 * i - 2].mT
    return gradients
