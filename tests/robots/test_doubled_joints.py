"""Joints that two nodes publish are noted, whatever moves in between."""

import json

import numpy as np
import pytest

from codetr_ros.cli import main
from codetr_ros.robots.conversion import JOINTS_DOUBLED
from codetr_ros.robots.doubled_joints import DoubledJoints
from helpers.arm import JOINTS, attempt, joint_state, mcap_file, rules


def count(values):
    joints = DoubledJoints()
    for one in values:
        joints.take(np.atleast_1d(np.asarray(one, float)))
    return joints.count


def mixed(a, b, every=1):
    """The messages of b after each `every` of a."""
    out = []
    for i, one in enumerate(a):
        out.append(one)
        if i % every == 0:
            out.append(b[i])
    return out


MOTIONS = {
    'swing': np.sin(np.arange(400) / 20),
    'ramp': np.arange(400) / 50,
    'rest': np.ones(400) + np.random.default_rng(0).normal(0, 1e-4, 400),
    'walk': np.random.default_rng(1).normal(0, 0.01, (400, 3)).cumsum(0) + 1,
}


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('every', [1, 2, 3])
def test_zeros_between_the_measured_values_are_noted(motion, every):
    values = MOTIONS[motion]
    assert count(values) == 0
    assert count(mixed(values, 0 * values, every)) > 60


@pytest.mark.parametrize(
    'values',
    [
        np.random.default_rng(0).normal(0, 1, 2000),
        np.random.default_rng(0).normal(0, 1, (2000, 2)),
        np.repeat(np.arange(200.0), 2),
        np.sign(np.sin(np.arange(400) / 10)),
        np.where(np.arange(400) % 50 == 0, 5.0, 0.0),
        mixed(MOTIONS['walk'], MOTIONS['walk']),
    ],
    ids=['noise', 'noise of two', 'twice each', 'square wave', 'outliers', 'a relay of the same'],
)
def test_values_of_one_node_are_not(values):
    assert count(values) == 0


def test_convert_prints_the_hint(tmp_path, capsys):
    sent = []
    for one in attempt(40):
        sent.append(one)
        if one.topic == '/joint_states':
            zeros = joint_state(one.time, reversed(JOINTS), [0, 0])
            sent.append(one._replace(time=one.time + 2_000_000, message=zeros))
    there = mcap_file(tmp_path / 'x.mcap', sent)
    (tmp_path / 'mapping.json').write_text(json.dumps(rules()))  # JSON is YAML
    given = ['convert', str(there), '--mapping', str(tmp_path / 'mapping.json')]
    assert main([*given, '--out', str(tmp_path / 'out')]) == 0
    out = capsys.readouterr().out
    assert JOINTS_DOUBLED in out.split('noted')[1]
    assert 'dropped     nothing\n' in out
    assert 'two nodes seem to publish the same joints' in out


def test_values_that_are_no_numbers_or_change_their_number_are_passed_over():
    zeros = [np.zeros(2)] * 30
    assert count([*mixed(zeros, [np.full(2, np.nan)] * 30)]) == 0
    assert count([*mixed(zeros, [np.ones(3)] * 30)]) == 0
