"""The worked example of docs/other-peoples-data.md, from a robot's own bag to labelled steps."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from codetr_ros import cli
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.records import CompositeReward, StepRewards, Transitions

ARM = Path(__file__).resolve().parents[2] / 'examples' / 'robot_arm'


@pytest.fixture(scope='module')
def make_bag():
    spec = importlib.util.spec_from_file_location('make_bag', ARM / 'make_bag.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules['make_bag'] = module
    sys.path.insert(0, str(ARM))  # as where it is started as a program
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(ARM))
    return module


def convert(bag, out, *more, code=0):
    mapping = more[0] if more else ARM / 'mapping.yaml'
    assert cli.main(['convert', str(bag), '--mapping', str(mapping), '--out', str(out)]) == code


@pytest.mark.slow
@pytest.mark.parametrize('storage', list(StoragePlugin))
def test_the_arms_bag_becomes_steps_a_model_and_labels(make_bag, tmp_path, capsys, storage):
    make_bag.write(tmp_path / 'arm', 12, storage=storage)

    convert(tmp_path / 'arm', tmp_path / 'steps')

    said = capsys.readouterr().out
    assert '4 observations, 2 actions' in said
    assert '12, 960 steps of 0.09' in said
    assert '48, of 960 steps together' in said
    assert 'dropped     nothing' in said
    assert verify(tmp_path / 'steps').sound
    chunks = [e.record for e in Bag(tmp_path / 'steps').entries((Transitions,))]
    assert all(np.abs(c.actions).max() <= 1 for c in chunks)
    # the shoulder's angle follows from its speed: columns are shoulder, elbow, and their speeds
    for c in chunks:
        moved = np.diff(c.observations[:, :2], axis=0)
        assert np.allclose(moved, 0.1 * c.observations[1:, 2:], atol=0.15)
    scores = [e.record for e in Bag(tmp_path / 'steps').entries((CompositeReward,))]
    assert {s.length for s in scores} == {20}

    flags = ['--gradient-steps=20', '--check-every=10', '--method=mlp']
    fit = ['fit', str(tmp_path / 'steps'), '--out', str(tmp_path / 'fit'), *flags]
    assert cli.main(fit) == 0
    summary = json.loads((tmp_path / 'fit' / 'summary.json').read_text())
    assert summary['delay'] == 20
    label = ['label', str(tmp_path / 'steps'), '--checkpoint', str(tmp_path / 'fit')]
    assert cli.main([*label, '--out', str(tmp_path / 'labelled')]) == 0
    labels = [e.record.labels for e in Bag(tmp_path / 'labelled').entries((StepRewards,))]
    assert sum(map(len, labels)) == 960


def test_a_verdict_is_of_its_attempt_although_it_comes_during_the_next_one(
    make_bag, tmp_path, capsys
):
    make_bag.write(tmp_path / 'arm', 11, judged=True)
    verdicts = list(Bag(tmp_path / 'arm').messages(topics=['/judge/verdict']))
    length = round((make_bag.SECONDS + make_bag.PAUSE) * make_bag.NS)
    during = [(m.log_time - make_bag.BEGIN) // length for m in verdicts]  # this attempt
    last = {number - 1: m.message.data for number, m in zip(during, verdicts, strict=True)}

    convert(tmp_path / 'arm', tmp_path / 'steps', ARM / 'verdicts.yaml')

    scores = [e.record for e in Bag(tmp_path / 'steps').entries((CompositeReward,))]
    assert {s.episode: s.value for s in scores} == last
    assert [(s.first_step, s.length) for s in scores] == [(0, 80)] * 11
    said = capsys.readouterr().out
    assert '11, of 880 steps together, 80 each' in said
    assert 'dropped     2 scores that a later score of the same steps replaced' in said

    # by their reception they may be of either attempt
    plain = tmp_path / 'plain.yaml'
    plain.write_text((ARM / 'mapping.yaml').read_text().replace('/judge/score', '/judge/verdict'))
    convert(tmp_path / 'arm', tmp_path / 'none', plain)
    assert not list(Bag(tmp_path / 'none').entries((CompositeReward,)))
    said = capsys.readouterr().out
    assert f'dropped     {len(verdicts)} scores that may be of the episode before' in said
    assert 'Give score.late: 0 if scores never come after the next episode has begun' in said


def test_a_mapping_of_topics_that_are_not_there_names_those_that_are(make_bag, tmp_path, capsys):
    make_bag.write(tmp_path / 'arm', 1)
    text = (ARM / 'mapping.yaml').read_text()
    wrong = tmp_path / 'wrong.yaml'

    wrong.write_text(text.replace('/judge/score', '/judge'))
    convert(tmp_path / 'arm', tmp_path / 'out', wrong, code=2)
    said = capsys.readouterr().err
    assert 'has no topic /judge. It has: /arm/attempt_ended, /arm/velocity_commands' in said

    wrong.write_text(text.replace('[position, velocity]', '[position, torque]'))
    convert(tmp_path / 'arm', tmp_path / 'out', wrong, code=2)
    assert "has no field 'torque'" in capsys.readouterr().err
    wrong.write_text(text.replace('shoulder, elbow', 'wrist'))
    convert(tmp_path / 'arm', tmp_path / 'out', wrong, code=2)
    said = capsys.readouterr().err
    assert 'not one step could be made: ' in said
    assert '400 messages without all of the joints' in said
    assert not (tmp_path / 'out').exists()

    convert(tmp_path / 'arm', tmp_path / 'arm', code=2)
    assert 'exists and holds' in capsys.readouterr().err
    convert(tmp_path / 'arm', tmp_path / 'out', tmp_path / 'none.yaml', code=2)
    assert 'none.yaml cannot be read' in capsys.readouterr().err
