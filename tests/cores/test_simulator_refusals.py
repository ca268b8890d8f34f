"""Policies that a simulator does not follow."""

import dataclasses

import pytest
import torch

from codetr_ros.cores.simulator import Simulator
from codetr_ros.policy.actor import Actor, weights_bytes
from codetr_ros.records import (
    Policy,
    RecordError,
)
from helpers.builders import run as run_spec
from helpers.builders import same, task_spec, tiny
from helpers.simulating import (
    FALLS,
    NEVER_ENDS,
    deterministic,
    learnt,
    permit,
    slices,
)


def changed(record: Policy, **fields):
    return dataclasses.replace(record, **fields)


@pytest.mark.parametrize(
    ('wrong', 'message'),
    [
        (permit(1, run_id='other'), "run 'other', this is run 'run'"),
        (permit(0, steps=100), 'has run phase=0 already'),
        (permit(2, steps=100), 'has received phase=2 already'),
        (permit(-1), 'phase=-1.*this run has phases 0 to 6'),
        (permit(8), 'phase=8.*this run has phases 0 to 6'),
        (permit(1, sources=('robot',)), r"sources=\['robot'\], not 'sim'"),
        (changed(permit(1), sources=('sim', 'b')), 'steps has 1 entries for 2 sources'),
        (permit(1, **learnt(FALLS)), "cannot act in task 'Pendulum-v1'.*another architecture"),
        (permit(1, **learnt(NEVER_ENDS) | {'weights': b'junk'}), 'are not safetensors'),
        (task_spec(), 'takes policies only, not TaskSpec'),
    ],
)
def test_a_policy_that_must_not_be_followed_is_refused_and_changes_nothing(wrong, message):
    settings = tiny(task=NEVER_ENDS)
    simulator = Simulator(run_spec(settings), settings, 'sim')
    for each in (permit(0), permit(2)):
        simulator.receive(each)
    work = simulator.work()
    said = [next(work), next(work)]  # phase 0 is one chunk
    assert next(work) is None
    with pytest.raises(RecordError, match=message):
        simulator.receive(wrong)
    simulator.receive(permit(1))
    said += [next(work), next(work)]
    expected = slices(settings, [permit(0), permit(1), permit(2)])
    for ours, theirs in zip(said, expected, strict=True):
        for a, b in zip(deterministic(ours), deterministic(theirs), strict=True):
            assert same(a, b)


def test_the_same_policy_again_is_counted_and_changes_nothing():
    """A learner that was started again publishes the same ones again."""
    settings = tiny(task=NEVER_ENDS)
    simulator = Simulator(run_spec(settings), settings, 'sim')
    simulator.receive(permit(0))
    simulator.receive(permit(0))
    assert simulator.report().duplicated == {'policy': 1}
    work = simulator.work()
    assert len([next(work), next(work)]) == 2
    assert next(work) is None
    simulator.receive(permit(0))
    assert next(work) is None
    assert simulator.report().duplicated == {'policy': 2}


def test_weights_that_are_not_finite_are_refused():
    settings = tiny(task=NEVER_ENDS)
    actor = Actor(3, 1, (16, 16))
    with torch.no_grad():
        actor.heads.bias[0] = float('nan')
    weights = weights_bytes(actor)
    simulator = Simulator(run_spec(settings), settings, 'sim')
    with pytest.raises(RecordError, match="'heads.bias' are not finite"):
        simulator.receive(permit(0, **learnt(NEVER_ENDS) | {'weights': weights}))
