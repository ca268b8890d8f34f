"""What every reward method makes of segments of any length."""

from typing import Any

import numpy as np
import pytest
import torch

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardMethod, segment_steps
from codetr_ros.rewards.rbt import Layout
from codetr_ros.seeding import generator, seed_torch
from helpers import builders, planted
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

pytestmark = pytest.mark.usefixtures('one_thread')

DELAY = 9
every_method = pytest.mark.parametrize('method', registry.METHODS)


def irregular(segments: int = 30) -> Trajectories:
    return planted.memory(
        planted.progress, lambda r: float(r.sum()), DELAY, segments, irregular=True
    )


def trained(method: str, memory: Trajectories, steps: int = 3, **changes: Any) -> RewardMethod:
    made = registry.make(builders.tiny(method=method, delay=f'4:{DELAY}', **changes), O, A)
    made.prepare(memory)
    for step in range(steps):
        seed_torch(0, step)
        made.gradient_step(memory, generator(0, step))
    return made


@every_method
def test_each_step_of_irregular_segments_gets_a_finite_label_and_nothing_else_does(method):
    memory = irregular()
    made = trained(method, memory)
    batch = memory.segments.batch(memory.segments.ids(), made.context)
    assert len(set(batch.lengths.tolist())) > 3
    labels, inside = made.label(batch), segment_steps(batch)
    assert np.isfinite(labels).all() and not labels[~inside].any()
    passes = np.concatenate(list(made.label_passes(memory, memory.segments.ids())))
    np.testing.assert_allclose(passes, labels[inside], rtol=1e-5, atol=1e-6)
    assert len(passes) == memory.steps


@pytest.mark.parametrize('scope', ['window', 'segment'])
def test_a_window_of_rbt_has_the_segments_right_before_whatever_their_lengths(scope):
    memory = irregular()
    changes = {'codetr__window': 30, 'rbt__attention_scope': scope}
    one, other = (trained('rbt', memory, 4, **changes) for _ in range(2))
    assert np.isfinite(one.label(memory.segments.batch(memory.segments.ids(), one.context))).all()
    assert all(torch.equal(one.state()[name], t) for name, t in other.state().items())


def test_segments_of_a_window_lie_side_by_side_without_a_gap():
    lengths = np.array([3, 1, 4, 2, 4])
    layout = Layout([3, 2], lengths)
    each = torch.zeros(5, 4)
    for i, m in enumerate(lengths.tolist()):
        each[i, :m] = torch.arange(m) + 10 * (i + 1)
    laid = layout.side_by_side(each)
    assert laid.tolist() == [
        [10, 11, 12, 20, 30, 31, 32, 33, 0, 0, 0, 0],
        [40, 41, 50, 51, 52, 53, 0, 0, 0, 0, 0, 0],
    ]
    inside = torch.arange(4) < torch.from_numpy(lengths)[:, None]
    assert torch.equal(layout.taken_apart(laid)[inside], each[inside])
