"""What `codetr bag play` refuses before it starts anything."""

import sys

import pytest

from codetr_ros import cli
from codetr_ros.records import Commit
from helpers.bags import a_run, ours


@pytest.fixture
def bag(tmp_path):
    return str(ours(tmp_path / 'bag', a_run()))


@pytest.mark.parametrize(
    ('flags', 'said'),
    [
        (['--rate', '0'], '--rate 0 must be greater than 0'),
        (['--rate', 'nan'], '--rate nan must be greater than 0'),
        (['--deadline', '-1'], '--deadline -1 must be from 0 to 86400 seconds; 0: for ever'),
        (
            ['--to', 'nobody'],
            '--to nobody needs --pace recorded or --rate: no node sets the pace',
        ),
        (['--to', 'nobody', 'reward'], '--to nobody reward: either nobody, or nodes'),
        (['--namespace', 'play'], "--namespace 'play' must be a ROS namespace: /name"),
        (['--namespace', '/1st'], "--namespace '/1st' must be"),
        (['--to', 'evaluate'], 'an evaluator follows a learner: play to the learner too'),
        (['--run', 'another'], "holds 0 runs 'another' to be played (there are: run)"),
    ],
)
def test_flags_that_make_no_sense_are_refused(bag, capsys, flags, said):
    assert cli.main(['bag', 'play', bag, *flags]) == cli.USAGE
    assert said in capsys.readouterr().err


def test_a_bag_that_is_not_there_is_refused(tmp_path, capsys):
    assert cli.main(['bag', 'play', str(tmp_path / 'nothing')]) == cli.USAGE
    assert 'nothing cannot be read: No such file' in capsys.readouterr().err


def test_a_bag_from_which_nobody_has_learnt_is_refused(tmp_path, capsys):
    bag = ours(tmp_path / 'bag', [r for r in a_run() if not isinstance(r, Commit)])
    assert cli.main(['bag', 'play', str(bag)]) == cli.USAGE
    assert "no phase of run 'run' was committed" in capsys.readouterr().err


def test_without_ros_it_says_what_learns_from_bags_then(bag, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'codetr_ros.ros.player', None)
    assert cli.main(['bag', 'play', bag]) == cli.USAGE
    said = capsys.readouterr().err
    assert 'playing needs ROS, which cannot be imported' in said
    assert '`codetr fit` learns from bags without it' in said
