"""HC: what it draws, how it values histories, and one update held against a plain re-statement."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from codetr_ros.cli.evaluate import evaluate, newest_policy
from codetr_ros.config import HcSettings
from codetr_ros.cores import in_process
from codetr_ros.cores.learner import Learner
from codetr_ros.learners.base import LearnerError
from codetr_ros.learners.hc import HC
from codetr_ros.learners.histories import HISTORIES, HistoryBatch, ScoredSteps
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, EpisodeResult, Policy, StepRewards
from helpers.builders import run, score, task_spec, tiny, transitions
from helpers.commits import committed

torch.set_num_threads(1)

OBS, ACT, DELAY = 3, 2, 4
HISTORY = pytest.mark.parametrize('history', list(HISTORIES))


@pytest.fixture
def double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def learner(history: str = 'singleton', **changes) -> HC:
    """Learning rates each another, so that none can stand for another."""
    settings = tiny(
        method='hc',
        delay=DELAY,
        hc__history=history,
        hc__width=6,
        hc__regulariser=0.7,
        sac__hidden=(8, 5),
        sac__actor_learning_rate=3e-3,
        sac__critic_learning_rate=5e-3,
        sac__temperature_learning_rate=7e-3,
        sac__discount=0.9,
        sac__tau=0.05,
        sac__initial_temperature=0.5,
        **changes,
    )
    made = HC(settings, OBS, ACT)
    made.target_scale = 2.0
    return made


def make_batch(seed: int = 0) -> HistoryBatch:
    """Three segments of 4, 2 and 4 steps; steps of their beginnings, middles and ends."""
    rng = np.random.default_rng(seed)
    lengths = np.array([4, 2, 4])
    observations = rng.standard_normal((3, 5, OBS))
    actions = rng.uniform(-1, 1, (3, 4, ACT))
    for i, length in enumerate(lengths):
        observations[i, length + 1 :] = actions[i, length:] = 0
    return HistoryBatch(
        observations=observations,
        actions=actions,
        lengths=lengths,
        values=np.array([3.0, -5.0, 8.0]),
        terminal=np.array([False, True, False]),
        owners=np.array([0, 1, 2, 0, 1, 2, 2]),
        steps=np.array([0, 1, 3, 3, 0, 1, 2]),
    )


class Plain:
    """The same by the book: a network for each critic, every history read by itself."""

    def __init__(self, hc: HC, history: str) -> None:
        state = hc.state()
        self.scale, self.log_alpha = hc.target_scale, state['log_temperature'].requires_grad_()
        self.actor = nn.Sequential(
            nn.Linear(OBS + 1, 8), nn.ReLU(), nn.Linear(8, 5), nn.ReLU(), nn.Linear(5, 2 * ACT)
        )
        for i, name in ((0, 'body.0'), (2, 'body.2'), (4, 'heads')):
            self.actor[i].weight.data = state[f'actor.{name}.weight']
            self.actor[i].bias.data = state[f'actor.{name}.bias']
        self.critics = [self.critic(state, 'critic.{}', history, k) for k in (0, 1)]
        self.targets = [self.critic(state, 'target.{}', history, k) for k in (0, 1)]
        weights = [p for critic in self.critics for p in critic.parameters()]
        self.critic_adam = torch.optim.Adam(weights, lr=5e-3)
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), lr=3e-3)
        self.alpha_adam = torch.optim.Adam([self.log_alpha], lr=7e-3)

    @staticmethod
    def mlp(state: dict[str, Tensor], prefix: str, k: int) -> nn.Sequential:
        layers = []
        for i in range(3):
            weight, bias = state[f'{prefix}.{2 * i}'][k], state[f'{prefix}.{2 * i + 1}'][k, 0]
            layer = nn.Linear(*weight.shape)
            layer.weight.data, layer.bias.data = weight.T.clone(), bias.clone()
            layers += [layer, nn.ReLU()]
        return nn.Sequential(*layers[:-1])

    def critic(self, state: dict[str, Tensor], name: str, history: str, k: int) -> nn.ModuleDict:
        parts = nn.ModuleDict({'current': self.mlp(state, name.format('parts'), k)})
        if history == 'singleton':
            parts['b'] = self.mlp(state, name.format('history.steps'), k)
        else:
            parts['cell'], parts['head'] = nn.GRUCell(OBS + ACT, 6), nn.Linear(6, 1)
            for own, kind in ((parts['cell'], 'grus'), (parts['head'], 'heads')):
                for key, weight in own.named_parameters():
                    ending = f'{key}_l0' if kind == 'grus' else key
                    weight.data = state[name.format(f'history.{kind}.{k}.{ending}')].clone()
        return parts

    @staticmethod
    def history(critic: nn.ModuleDict, steps: list[Tensor]) -> Tensor:
        """H of a list of (s, a)."""
        if 'b' in critic:
            return sum((critic['b'](step)[0] for step in steps), torch.zeros(()))
        state = torch.zeros(1, 6)
        for step in steps:
            state = critic['cell'](step[None], state)
        return critic['head'](state)[0, 0]

    def act(self, s: Tensor, place: float, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = torch.cat([s, torch.tensor([place])])
        mean, log_std = self.actor(x).chunk(2)
        normal = torch.distributions.Normal(mean, log_std.clamp(-10, 2).exp())
        u = normal.mean + normal.stddev * noise
        action = u.tanh()
        return x, action, (normal.log_prob(u) - torch.log(1 - action.square())).sum()

    def update(self, batch: HistoryBatch) -> None:
        s, a = torch.tensor(batch.observations), torch.tensor(batch.actions)
        noise2, noise = torch.randn(2, len(batch.steps), ACT)
        alpha = self.log_alpha.exp().item()
        loss = torch.zeros(())
        for i, (n, t) in enumerate(zip(batch.owners, batch.steps, strict=True)):
            past = [torch.cat([s[n, j], a[n, j]]) for j in range(t)]
            end = t == batch.lengths[n] - 1
            with torch.no_grad():
                place = 0.0 if end else (t + 1) / DELAY
                x2, a2, log_prob2 = self.act(s[n, t + 1], place, noise2[i])
                nxt = [] if end else [*past, torch.cat([s[n, t], a[n, t]])]
                both = [
                    self.history(q, nxt) + q['current'](torch.cat([x2, a2]))[0]
                    for q in self.targets
                ]
                y = batch.values[n] / self.scale if end else 0.0
                if not (end and batch.terminal[n]):
                    y = y + 0.9 * (min(both) - alpha * log_prob2)
            now = torch.cat([s[n, t], torch.tensor([t / DELAY]), a[n, t]])
            for q in self.critics:
                value = self.history(q, past) + q['current'](now)[0]
                loss = loss + (value - y) ** 2 / len(batch.steps)
        for n, length in enumerate(batch.lengths):
            steps = [torch.cat([s[n, j], a[n, j]]) for j in range(length)]
            for q in self.critics:
                off = self.history(q, steps) - batch.values[n] / self.scale
                loss = loss + 0.7 * off**2 / len(batch.lengths)
        self.step(self.critic_adam, loss)
        for target, critic in zip(self.targets, self.critics, strict=True):
            for old, new in zip(target.parameters(), critic.parameters(), strict=True):
                old.data = 0.95 * old + 0.05 * new.data
        actor_loss, log_probs = torch.zeros(()), []
        for i, (n, t) in enumerate(zip(batch.owners, batch.steps, strict=True)):
            x, action, log_prob = self.act(s[n, t], t / DELAY, noise[i])
            c = min(q['current'](torch.cat([x, action]))[0] for q in self.critics)
            actor_loss = actor_loss + (alpha * log_prob - c) / len(batch.steps)
            log_probs.append(log_prob.item())
        self.step(self.actor_adam, actor_loss)
        self.step(self.alpha_adam, self.log_alpha.exp() * (-np.mean(log_probs) + ACT / 2))

    @staticmethod
    def step(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


@HISTORY
def test_an_update_is_that_of_the_book(double: None, history: str) -> None:
    hc = learner(history)
    plain = Plain(hc, history)
    for index in range(3):
        batch = make_batch(index)
        torch.manual_seed(index)
        hc.update(batch)
        torch.manual_seed(index)
        plain.update(batch)
    now = Plain(hc, history)
    pairs = [(now.actor, plain.actor), *zip(now.critics, plain.critics, strict=True)]
    for mine, books in [*pairs, *zip(now.targets, plain.targets, strict=True)]:
        for a, b in zip(mine.parameters(), books.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(now.log_alpha, plain.log_alpha)


@HISTORY
def test_the_actor_does_not_see_the_history(history: str) -> None:
    hc = learner(history)
    observations, noise = torch.randn(6, OBS + 1), torch.randn(6, ACT)
    loss, _ = hc.actor_loss(observations, noise, torch.tensor(0.1))
    past = list(hc.critic.history.parameters())
    gradients = torch.autograd.grad(loss, past, allow_unused=True, retain_graph=True)
    assert past and all(gradient is None for gradient in gradients)
    of_actor = torch.autograd.grad(loss, list(hc.actor.parameters()))
    with torch.no_grad():
        for weight in past:
            weight.normal_(std=100)
    again, _ = hc.actor_loss(observations, noise, torch.tensor(0.1))
    for one, other in zip(
        of_actor, torch.autograd.grad(again, list(hc.actor.parameters())), strict=True
    ):
        assert torch.equal(one, other) and one.any()


def test_prefix_sums_are_the_sums_of_the_steps_before(double: None) -> None:
    torch.manual_seed(1)
    singleton = HISTORIES['singleton'](OBS, ACT, (8,), HcSettings())
    s, a = torch.randn(3, 5, OBS), torch.randn(3, 5, ACT)
    values = singleton(s, a).detach()
    w1, b1, w2, b2 = (w.detach() for w in singleton.steps)
    for k in range(2):
        for i in range(3):
            for t in range(6):
                steps = torch.cat([s[i, :t], a[i, :t]], -1)
                naive = sum((x @ w1[k] + b1[k, 0]).relu() @ w2[k] + b2[k, 0] for x in steps)
                assert float(values[k, i, t]) == pytest.approx(float(naive))


def test_one_pass_of_the_gru_gives_what_it_gives_for_each_beginning(double: None) -> None:
    torch.manual_seed(1)
    recurrent = HISTORIES['recurrent'](OBS, ACT, (8,), HcSettings(width=7))
    s, a = torch.randn(4, 6, OBS), torch.randn(4, 6, ACT)
    lengths = torch.tensor([6, 1, 4, 3])
    for i, length in enumerate(lengths):
        s[i, length:] = a[i, length:] = 0
    values = recurrent(s, a)
    packed = nn.utils.rnn.pack_padded_sequence(
        torch.cat([s, a], -1), lengths, batch_first=True, enforce_sorted=False
    )
    for k in range(2):
        gru, head = recurrent.grus[k], recurrent.heads[k]
        whole = head(gru(packed)[1][0])[:, 0]  # each read to its own end
        torch.testing.assert_close(values[k, torch.arange(4), lengths], whole)
        torch.testing.assert_close(values[k, :, 0], head.bias.expand(4))
        for t in range(1, 7):
            state = gru(torch.cat([s, a], -1)[:, :t])[1][0]
            torch.testing.assert_close(values[k, :, t], head(state)[:, 0])


def memory() -> Trajectories:
    """Episode 0: 10 steps, then a fall; segments of 4, 4 and 2. Episode 1: 7 steps so far."""
    held = Trajectories(OBS, ACT, DELAY, 1000, 100)
    held.append(transitions(steps=10, terminated=True))
    held.append(transitions(steps=7, episode=1, sequence=1))
    return held


def test_steps_of_segments_without_a_score_are_not_drawn() -> None:
    held = memory()
    assert len(ScoredSteps(held)) == 0
    held.score(score(first_step=4, length=4, value=5.0))
    steps = ScoredSteps(held)
    assert len(steps) == 4
    batch = steps.sample(np.random.default_rng(0), 3, 20)
    assert set(batch.values) == {5.0} and set(batch.steps) == {0, 1, 2, 3}
    expected = transitions(steps=10)
    for owner, t in zip(batch.owners, batch.steps, strict=True):
        assert np.array_equal(batch.observations[owner, t], expected.observations[4 + t])
        assert np.array_equal(batch.observations[owner, t + 1], expected.observations[5 + t])
        assert np.array_equal(batch.actions[owner, t], expected.actions[4 + t])


def test_every_scored_step_is_drawn_as_often_as_any_other() -> None:
    held = memory()
    for first, length in ((0, 4), (4, 4), (8, 2)):
        held.score(score(first_step=first, length=length, value=float(first)))
    held.score(score(episode=1, length=4, value=100.0))
    steps = ScoredSteps(held)
    assert len(steps) == 14
    batch = steps.sample(np.random.default_rng(0), 5000, 20_000)
    where = batch.values[batch.owners] * 10 + batch.steps
    _, counts = np.unique(where, return_counts=True)
    assert len(counts) == 14
    np.testing.assert_allclose(counts / 20_000, 1 / 14, rtol=0.15)
    assert np.array_equal(batch.terminal, batch.values == 8.0)
    assert batch.lengths[batch.values == 8.0].tolist()[:1] == [2]
    assert (batch.steps < batch.lengths[batch.owners]).all()


@HISTORY
def test_a_learner_goes_on_from_its_state_as_if_nothing_had_been(history: str) -> None:
    def updated(hc: HC, index: int) -> dict[str, Tensor]:
        torch.manual_seed(index)
        made = make_batch(index)
        hc.update(
            replace(
                made,
                observations=made.observations.astype(np.float32),
                actions=made.actions.astype(np.float32),
            )
        )
        return hc.state()

    one, other = learner(history), learner(history, seed=9)
    updated(one, 0)
    other.target_scale = 0.0
    other.load_state(one.state())
    for a, b in pairwise([updated(one, 1), updated(other, 1)]):
        assert a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def test_the_state_of_another_history_is_refused_and_changes_nothing() -> None:
    hc, before = learner('singleton'), learner('singleton').state()
    with pytest.raises(LearnerError, match="policy learner 'hc' refused: critic.history"):
        hc.load_state(learner('recurrent').state())
    assert all(torch.equal(tensor, before[name]) for name, tensor in hc.state().items())


def test_the_learner_itself_takes_the_scores_and_no_labels() -> None:
    settings = tiny(method='hc', delay=5, steps=400, phase_steps=10, warmup_steps=10)
    core = Learner(run(settings), settings, 'learner', None)
    assert CompositeReward in core.subscribes and StepRewards not in core.subscribes
    core.receive(task_spec())
    work = core.work()
    next(work)
    steps = transitions(steps=10, phase_end=True, scores_due=1)
    scored = score(length=5, value=2.0)
    (permitted,) = core._intake.policies.values()
    for record in (steps, scored, committed(steps, scored, policy_digest=permitted)):
        core.receive(record)
    said = [next(work) for _ in range(4)]
    permit = next(r for out in said for r in out or () if isinstance(r, Policy))
    assert (permit.phase, permit.version) == (1, 0) and '"segment_steps":5' in permit.network
    assert core.report().updates == 10


def test_nothing_is_learnt_while_nothing_is_scored_and_that_is_counted() -> None:
    hc = learner()
    assert list(hc.train(1, memory())) == [{'target_scale': 2.0, 'scored_steps': 0}]
    assert hc.counters == {'updates skipped, nothing scored': 200}


@pytest.mark.slow
@HISTORY
def test_a_run_needs_no_reward_node_and_its_policy_changes(history: str) -> None:
    seen = []
    settings = tiny(method='hc', hc__history=history, hc__width=8, hc__segments=8, steps=800)
    reports = in_process.run(settings, 'run', observe=seen.append)
    assert 'reward' not in reports and reports['learner'].updates == 600
    assert not any(isinstance(record, StepRewards) for record in seen)
    weights = {record.weights for record in seen if isinstance(record, Policy)}
    assert len(weights) == 4  # random ones have none; then one of each learning phase


@pytest.mark.slow
def test_a_policy_from_a_checkpoint_acts_as_the_run_evaluated_it(tmp_path: Path) -> None:
    """Without its place in the segment it could not act at all, with a wrong one otherwise."""
    settings = tiny(method='hc', delay=7, hc__width=8, steps=800)
    seen = []
    in_process.run(settings, 'run', tmp_path, observe=seen.append)
    last = [r for r in seen if isinstance(r, EpisodeResult) and r.purpose == 'evaluation'][-2:]
    again = evaluate(newest_policy(tmp_path, settings), settings)
    assert [r.true_return for r in again] == [r.true_return for r in last]
    assert [r.length for r in again] == [r.length for r in last]
