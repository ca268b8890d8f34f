"""Likelihood reward redistribution: its densities, its gradients, and what they come to."""

from typing import Any

import numpy as np
import pytest
import torch

from codetr_ros.rewards import lrr
from codetr_ros.rewards.base import RewardModelError, segment_steps
from codetr_ros.rewards.lrr import KERNELS, Lrr, correlated_loss, independent_loss, residuals
from codetr_ros.seeding import generator
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.linear_rewards import DELAY, explained, memory, noise, recovery, trained

EVERY = [('kernel', kernel) for kernel in KERNELS] + [('none', 'rbf')]


def settings(**changes: Any):
    return builders.tiny(**{'method': 'lrr', 'delay': DELAY} | changes)


def correlation(kernel: str, square: np.ndarray, alpha: float) -> np.ndarray:
    """The kernels as books have them, of squared distances in units of the length scale."""
    return {
        'rbf': np.exp(-square / 2),
        'matern': (1 + np.sqrt(3 * square)) * np.exp(-np.sqrt(3 * square)),
        'rational_quadratic': np.power(1 + square / (2 * alpha), -alpha),
    }[kernel]


def density(targets: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> float:
    """log N(targets; mean, covariance), by inverse and determinant."""
    off = targets - mean
    volume = np.linalg.slogdet(2 * np.pi * covariance)[1]
    return float(-off @ np.linalg.inv(covariance) @ off / 2 - volume / 2)


@pytest.mark.parametrize(('related', 'kernel'), EVERY)
def test_the_loss_is_the_density_of_each_target_less_the_other_means(related, kernel, monkeypatch):
    """Segment by segment in numpy; also where the batch is processed in parts of two segments."""
    data = memory((20, 11, 3))  # three segments are short
    config = settings(
        lrr__correlation=related,
        lrr__kernel=kernel,
        lrr__length_scale=2.0,
        lrr__signal=1.5,
        lrr__noise=0.4,
    )
    made = trained(Lrr(config, O, A), data, 3)
    batch = data.segments.sample(generator(0, 'x'), 8)
    inputs = made._step_inputs(batch)
    with torch.no_grad():
        means, *deviations = made.network(inputs).double().unbind(-1)
        learnt = {name: float(p.exp()) for name, p in made.network.named_parameters(recurse=False)}
    unit = data.segments.score_scale()
    expected = []
    for i, length in enumerate(batch.lengths.tolist()):
        mean, x = means[i, :length].numpy(), inputs[i, :length].double().numpy()
        others = np.array([np.delete(mean, t).sum() for t in range(length)])
        if related == 'kernel':
            square = ((x[:, None] - x[None]) ** 2).sum(-1) / learnt['log_length'] ** 2
            covariance = learnt['log_signal'] ** 2 * correlation(
                kernel, square, learnt['log_alpha']
            ) + np.eye(length) * (learnt['log_noise'] ** 2 + 1e-4)
        else:
            covariance = np.diag(np.exp(2 * deviations[0][i, :length].numpy()) + 1e-4)
        expected.append(-density(batch.values[i] / unit - others, mean, covariance))
    for entries, parts in ((lrr.ENTRIES, 1), (2 * DELAY**2, 4)):
        monkeypatch.setattr(lrr, 'ENTRIES', entries)
        terms = list(made._terms(data, generator(0, 'x')))
        assert len(terms) == parts
        found = sum(float(part['reward_loss'].detach()) for part in terms)
        assert found == pytest.approx(np.mean(expected), rel=1e-5)


def example() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means, scores, covariances, and which steps are inside, of segments of 5 and 3 steps."""
    torch.manual_seed(0)
    means = torch.randn(2, 5, dtype=torch.float64, requires_grad=True)
    root = torch.randn(2, 5, 5, dtype=torch.float64)
    covariance = root @ root.mT + torch.eye(5)
    inside = torch.arange(5) < torch.tensor([[5], [3]])
    return means, torch.tensor([2.0, -7.0], dtype=torch.float64), covariance, inside


def test_the_gradient_is_that_of_one_error_with_a_weight_for_each_segment():
    means, returns, covariance, inside = example()
    loss = correlated_loss(residuals(means, returns, inside), covariance, inside).sum()
    found = torch.autograd.grad(loss, means)[0].numpy()
    for i, m in enumerate((5, 3)):
        inverse = np.linalg.inv(covariance[i, :m, :m].numpy())
        error = float((returns[i] - means[i, :m].sum()).detach())
        np.testing.assert_allclose(found[i, :m], -error * inverse.sum(), rtol=1e-9)
    assert not found[1, 3:].any()


def test_gradients_are_finite_differences_of_the_loss():
    means, returns, covariance, inside = example()
    log_variance = torch.randn(2, 5, dtype=torch.float64, requires_grad=True)
    root = torch.linalg.cholesky(covariance).requires_grad_()

    def losses(means, root, log_variance):
        residual = residuals(means, returns, inside)
        return (
            correlated_loss(residual, root @ root.mT, inside),
            independent_loss(residual, log_variance.exp(), inside),
        )

    assert torch.autograd.gradcheck(losses, (means, root, log_variance))


def test_with_unit_covariance_it_is_the_squared_error_of_the_sum():
    """The paper's Proposition 1."""
    means, returns, _, inside = example()
    residual = residuals(means, returns, inside)
    unit = torch.eye(5, dtype=torch.float64).expand(2, 5, 5)
    steps = torch.tensor([5.0, 3.0], dtype=torch.float64)
    expected = steps / 2 * ((returns - (means * inside).sum(1)) ** 2 + np.log(2 * np.pi))
    torch.testing.assert_close(correlated_loss(residual, unit, inside), expected)
    torch.testing.assert_close(independent_loss(residual, torch.ones(2, 5), inside), expected)


def test_longer_length_scales_and_less_noise_are_likelier_whatever_the_scores_are():
    """Why the floor of the variance is needed: a residual is the same at each step."""
    x = torch.randn(1, 6, 4, generator=torch.manual_seed(0))
    inside = torch.ones(1, 6, dtype=torch.bool)
    for error in (0.0, 3.0, -40.0):
        losses = []
        for length, less in ((1.0, 1.0), (10.0, 0.1), (100.0, 0.03)):
            config = settings(
                lrr__length_scale=length, lrr__noise=less, lrr__signal=max(1.0, abs(error))
            )
            covariance = lrr.GaussianRewards(4, config.lrr).covariance(x)
            residual = torch.full((1, 6), error, dtype=torch.float64)
            losses.append(float(correlated_loss(residual, covariance, inside).detach()))
        assert losses == sorted(losses, reverse=True)


@pytest.mark.parametrize('kernel', KERNELS)
def test_a_kernel_is_one_at_no_distance_and_falls_to_nothing(kernel):
    distance = torch.linspace(0, 30, 400, dtype=torch.float64)
    found = KERNELS[kernel](distance, torch.tensor(2.0))
    assert found[0] == 1 and (found.diff() < 0).all() and found[-1] < 1e-4


def test_a_rational_quadratic_of_large_alpha_is_the_gaussian_kernel():
    distance = torch.linspace(0, 4, 50, dtype=torch.float64)
    broad = KERNELS['rational_quadratic'](distance, torch.tensor(1e7, dtype=torch.float64))
    torch.testing.assert_close(broad, KERNELS['rbf'](distance, broad), rtol=1e-5, atol=1e-9)


def test_a_long_gradient_is_shortened():
    data = memory()
    made = trained(Lrr(settings(lrr__gradient_norm=1e-3), O, A), data, 2)
    norms = [p.grad.norm() for p in made.network.parameters() if p.grad is not None]
    assert torch.stack(norms).norm() == pytest.approx(1e-3, rel=1e-3)
    free = trained(Lrr(settings(lrr__gradient_norm=1e6), O, A), data, 2)
    assert torch.stack([p.grad.norm() for p in free.network.outputs.parameters()]).norm() > 1


def test_a_covariance_without_a_factor_is_refused_and_changes_nothing():
    data = memory()
    made = trained(Lrr(settings(), O, A), data, 2)
    with torch.no_grad():
        made.network.log_signal.fill_(400.0)  # its square is beyond the numbers of float64
    before = made.network.outputs[0].weight.clone()
    with pytest.raises(RewardModelError, match=r'reward_loss is nan.*Lower lrr.learning_rate'):
        made.gradient_step(data, generator(0))
    assert torch.equal(made.network.outputs[0].weight, before)


def test_a_label_depends_on_its_own_step_alone():
    data = memory(lengths=(64,))
    made = trained(Lrr(settings(), O, A), data, 3)
    batch = data.segments.batch(data.segments.ids())
    before = made.label(batch)
    batch.actions[0, 3] += 0.5
    batch.observations[1, 2] += 0.5
    assert np.argwhere(made.label(batch) != before).tolist() == [[0, 3], [1, 2]]
    assert segment_steps(batch).all()


@pytest.mark.slow
@pytest.mark.parametrize(('related', 'kernel'), EVERY)
def test_a_linear_step_reward_is_found_again_on_unseen_episodes(related, kernel):
    config = settings(
        lrr__correlation=related,
        lrr__kernel=kernel,
        lrr__batch=32,
        lrr__learning_rate=1e-2,
        lrr__hidden=(32,),
    )
    made = trained(Lrr(config, O, A), memory(), 400)
    unseen = memory(lengths=(64, 64), seed=1)
    assert recovery(made, unseen) > 0.95
    assert explained(made, unseen) > 0.95


def test_sixty_four_segments_are_learnt_by_heart():
    data = noise(64)
    config = settings(lrr__batch=64, lrr__learning_rate=1e-2, lrr__hidden=(64, 64))
    assert explained(trained(Lrr(config, O, A), data, 300), data) > 0.97
