"""What `codetr train` prints for those who start simulators that join its run."""

import shlex

from codetr_ros.cli.joiners import how_to_join
from codetr_ros.nodes.signing import VARIABLE
from helpers.builders import tiny

SETTINGS = tiny(joiners=('arm_3', 'arm_4'))


def test_each_joins_by_a_command_of_its_own():
    said = how_to_join(SETTINGS, '/run_1', {VARIABLE: '5a' * 32})
    words = [shlex.split(line)[-5:] for line in said[1:]]
    assert words == [
        ['--ros-args', '-r', '__ns:=/run_1', '-r', f'__node:={name}'] for name in SETTINGS.joiners
    ]
    assert 'warning' not in ''.join(said)
    assert '5a5a' not in ''.join(said)


def test_a_run_whose_key_nobody_else_can_have_says_so():
    said = how_to_join(SETTINGS, '/run_1', {})
    assert said[0].startswith('warning: nobody can join')
    assert f'export {VARIABLE}=' in said[0]


def test_where_nobody_may_join_nothing_is_printed():
    assert how_to_join(tiny(), '/run_1', {}) == []
