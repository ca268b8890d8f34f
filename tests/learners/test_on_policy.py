"""What a learner from its latest steps is made of, each against the book."""

import numpy as np
import pytest
import torch

from codetr_ros.learners.on_policy import (
    DifferentiableAdam,
    RunningMoments,
    clipped,
    discounted_returns,
    ends,
    normalised,
    trace,
)
from codetr_ros.memory.ring import Rollout
from codetr_ros.memory.trajectories import Trajectories
from helpers.builders import score, transitions

OBS, ACT, DELAY = 3, 2, 4
LAST = np.array([False, False, True, False, True, False, False, True])  # stretches of 3, 2 and 3


def rollout(rewards: list[float]) -> Rollout:
    nothing = np.zeros((len(LAST), 1), np.float32)
    return Rollout(nothing, nothing, np.array(rewards), nothing, np.zeros(len(LAST), bool), LAST)


def test_running_moments_are_those_of_everything_so_far() -> None:
    rng = np.random.default_rng(0)
    moments, parts = RunningMoments(OBS), []
    assert moments.mean.tolist() == [0] * OBS
    for size in (1, 50, 3, 200):
        parts.append(rng.normal(5, 3, (size, OBS)).astype(np.float32))
        moments.add(parts[-1])
        rows = np.concatenate(parts).astype(np.float64)
        np.testing.assert_allclose(moments.mean.numpy(), rows.mean(0), rtol=1e-9)
        expected = np.sqrt(rows.var(0) + 1e-8)
        np.testing.assert_allclose(moments.deviation.numpy(), expected, rtol=1e-9)


def test_a_component_that_never_changes_has_a_deviation_that_can_be_divided_by() -> None:
    moments = RunningMoments(1)
    moments.add(np.full((9, 1), 7.0))
    assert 0 < float(moments.deviation) < 1e-3


def test_advantages_are_those_of_the_backward_recursion() -> None:
    """A_t = delta_t + gamma lambda A_{t+1}, begun anew at each stretch's end."""
    seeded = torch.Generator().manual_seed(0)  # where terms cancel, float32 powers show
    delta = torch.randn(len(LAST), dtype=torch.float64, generator=seeded)
    expected, following = [0.0] * len(LAST), 0.0
    for t in reversed(range(len(LAST))):
        following = float(delta[t]) + (0.0 if LAST[t] else 0.9 * following)
        expected[t] = following
    weights = trace(torch.arange(len(LAST)), torch.from_numpy(ends(LAST)), 0.9).double()
    np.testing.assert_allclose((weights @ delta).numpy(), expected, rtol=1e-6)
    some = torch.tensor([6, 1, 2])
    assert torch.equal(trace(some, torch.from_numpy(ends(LAST)), 0.9).double(), weights[some])


def test_returns_are_discounted_forward_and_end_with_the_episode() -> None:
    found = discounted_returns(rollout([1, 0, 2, 0, 8, 4, 0, 0]), 0.5)
    assert found.tolist() == [1, 0.5, 2.25, 0, 8, 4, 2, 1]


def test_a_step_of_adam_by_hand_is_that_of_torch() -> None:
    mine, torchs = (torch.randn(4, 3, generator=torch.manual_seed(1)) for _ in range(2))
    torchs.requires_grad_()
    by_hand = DifferentiableAdam([mine], 3e-2, 1e-5)
    adam = torch.optim.Adam([torchs], 3e-2, eps=1e-5)
    for _ in range(5):
        torchs.grad = torch.randn(4, 3)
        before = mine.clone()
        step = by_hand.propose([torchs.grad])
        assert torch.equal(mine, before), 'a proposal changes nothing'
        by_hand.accept(step)
        adam.step()
        torch.testing.assert_close(mine, torchs.detach())


def test_the_derivative_of_a_step_goes_through_the_first_moment_only() -> None:
    adam = DifferentiableAdam([torch.zeros(1)], 0.1, 1e-5)
    gradient = torch.tensor([2.0], requires_grad=True)
    (value,) = adam.propose([gradient]).values
    (slope,) = torch.autograd.grad(value, gradient)
    # value = -rate g / (|g| + epsilon): with |g| held still, its slope is -rate / (|g| + epsilon)
    assert float(slope) == pytest.approx(-0.1 / 2, rel=1e-4)


def test_gradients_are_shortened_together_and_never_lengthened() -> None:
    long, short = [torch.tensor([3.0, 0.0]), torch.tensor([[4.0]])], [torch.tensor([0.1])]
    shortened = clipped(long, 0.5)
    assert torch.cat([g.flatten() for g in shortened]).norm() == pytest.approx(0.5)
    assert shortened[0][0] / shortened[1][0, 0] == pytest.approx(0.75)
    assert torch.equal(clipped(short, 0.5)[0], short[0])


def test_normalised_advantages_have_mean_zero_and_deviation_one() -> None:
    found = normalised(torch.tensor([1.0, 2.0, 6.0]))
    assert float(found.mean()) == pytest.approx(0, abs=1e-6)
    assert float(found.square().mean()) == pytest.approx(1)


def test_where_nothing_differs_or_moves_the_derivatives_are_numbers_all_the_same() -> None:
    advantage = torch.tensor([3.0], requires_grad=True)  # a minibatch of one step
    gradient = torch.zeros(2, requires_grad=True)
    for value, of in ((normalised(advantage), advantage), (clipped([gradient], 0.5)[0], gradient)):
        assert not value.detach().any()
        (slope,) = torch.autograd.grad(value.sum(), of)
        assert slope.isfinite().all()


def memory() -> tuple[Trajectories, list]:
    held = Trajectories(OBS, ACT, DELAY, 40, 20)
    rng = np.random.default_rng(1)

    def chunk(steps, **changes):
        observations = rng.normal(size=(steps + 1, OBS)).astype(np.float32)
        if changes.get('first_step'):
            observations[0] = chunks[-1].observations[-1]
        made = transitions(steps=steps, observations=observations, **changes)
        held.append(made)
        chunks.append(made)

    chunks: list = []
    chunk(6)  # a segment that crosses into the newest steps
    chunk(4, first_step=6, terminated=True)
    chunk(5, episode=1)
    for first, length, value in ((0, 4, 1.0), (4, 4, 2.0), (8, 2, 3.0)):
        held.score(score(first_step=first, length=length, value=value))
    held.score(score(episode=1, length=4, value=4.0))
    return held, chunks


def test_the_newest_steps_carry_the_scores_of_segments_that_end_among_them() -> None:
    held, chunks = memory()
    steps = held.store.newest([9])
    assert np.array_equal(
        steps.observations, np.concatenate([c.observations[:-1] for c in chunks[1:]])
    )
    following = np.concatenate([c.observations[1:] for c in chunks[1:]])
    assert np.array_equal(steps.next_observations, following)
    assert np.array_equal(steps.actions, np.concatenate([c.actions for c in chunks[1:]]))
    assert steps.rewards.tolist() == [0, 2, 0, 3, 0, 0, 0, 4, 0]
    assert np.flatnonzero(steps.terminated).tolist() == [3]
    assert np.flatnonzero(steps.last).tolist() == [3, 8]
    assert len(held.store.newest([100]).rewards) == 15


def test_the_newest_steps_of_several_sources_follow_one_after_the_other() -> None:
    held, _ = memory()
    held.append(transitions(source='a', steps=3))
    steps = held.store.newest([2, 3])
    assert np.array_equal(steps.actions[:2], transitions(steps=3).actions[1:])
    assert steps.rewards.tolist() == [0, 0, 0, 4, 0]
    assert np.flatnonzero(steps.last).tolist() == [1, 4]
