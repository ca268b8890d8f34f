"""The part `live` of a mapping is refused with the name of what is wrong in it."""

import pytest

from codetr_ros.config import SettingsError, validate
from codetr_ros.robots.mapping import Mapping
from helpers.robots import MAPPING


def refusal(live: dict) -> str:
    with pytest.raises(SettingsError) as caught:
        validate(Mapping, MAPPING | {'live': MAPPING['live'] | live}, 'mapping m.yaml')
    return str(caught.value)


VELOCITY = MAPPING['live']['command']


@pytest.mark.parametrize(
    ('live', 'said'),
    [
        ({'rate': 0}, 'live.rate = 0: Input should be greater than 0'),
        ({'rte': 5}, 'live.rte = 5: there is no such setting (did you mean'),
        ({'command': VELOCITY | {'type': 'Twist'}}, 'must be the type of a message, such as std_'),
        ({'command': VELOCITY | {'kind': 'speed'}}, "Input should be 'position', 'velocity' or"),
        ({'command': VELOCITY | {'safe': [0.0]}}, 'live.command.safe has 1'),
        ({'command': VELOCITY | {'safe': 'hold'}}, 'safe = hold with command.kind = velocity'),
        (
            {'command': VELOCITY | {'safe': 'hold', 'kind': 'position'}},
            'command.safe = hold needs limits.position',
        ),
        ({'limits': {'low': -3.0}}, 'live.limits.low = -3.0 lies outside action.low = (-1.5, -2'),
        ({'limits': {'low': 1.0, 'high': 0.5}}, 'low = 1.0 must be less than high = 0.5'),
        ({'limits': {'change': [1.0, 0.0]}}, 'change = (1.0, 0.0) must be greater than 0'),
        ({'limits': {'change': [1.0, 1.0, 1.0]}}, 'live.limits.change has 3'),
        ({'stop': {'age': 1.0}}, 'age = 1.0 without a topic'),
        ({'reset': {'by': 'service'}}, 'service must be given if `by` is service'),
        ({'watchdog': {'late': 0.5}}, 'live.watchdog.late = 0.5: Input should be greater than'),
    ],
)
def test_what_is_wrong_is_named(live, said):
    assert said in refusal(live)


def test_the_size_of_a_command_is_shown_by_whatever_lists_its_components():
    made = validate(Mapping, MAPPING, 'mapping')
    assert made.live is not None
    assert made.live.size(-1.0, 1.0, 0) == 1
    assert made.live.size((-1.0, -1.0), 1.0, 0) == 2
    assert made.live.size(-1.0, 1.0, 3) == 3
