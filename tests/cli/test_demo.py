"""Examples are named, and refused where their parts are not there."""

import pytest

from codetr_ros import cli
from codetr_ros.cli import demo_robot, train_over_topics
from codetr_ros.nodes import signing
from helpers.builders import tiny


def test_without_a_name_the_examples_are_listed(capsys):
    assert cli.main(['demo']) == 2
    refused = capsys.readouterr()
    assert 'a robot in real time' in refused.err
    assert refused.out == ''
    with pytest.raises(SystemExit) as left:
        cli.main(['demo', '--help'])
    assert left.value.code == 0
    assert capsys.readouterr().out == refused.err


def test_an_unknown_example_is_refused_with_the_one_that_is_close(capsys):
    assert cli.main(['demo', 'robt']) == 2
    assert "there is no command 'demo robt' (did you mean robot?)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ('flags', 'said'),
    [
        (['--example', 'none'], 'the stand-in robot is not in none: start from the folder of'),
        (['--seed', '-1'], 'seed = -1'),
    ],
)
def test_what_cannot_be_started_is_refused(flags, said, capsys, tmp_path):
    assert cli.main(['demo', 'robot', *flags, '--out', str(tmp_path / 'run')]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / 'run').exists()


def test_the_inspection_of_the_robot_signs_with_the_key_that_the_nodes_of_the_run_have():
    topics = train_over_topics.Topics()
    given = demo_robot.beside(tiny(), topics.key)
    assert signing.key_of(given) == signing.key_of(topics.key) is not None
