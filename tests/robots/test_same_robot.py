"""A robot that differs from the one of training is refused, by what decides how a policy acts."""

import pytest

from codetr_ros.robots.same_robot import (
    AnotherRobotError,
    check_mapping,
    check_sizes,
    check_types,
    differences,
)
from helpers import policies
from helpers.robots import MAPPING, rules

LIMIT = {'topic': '/joint_states', 'fields': ['position'], 'joints': ['a', 'b']}


def observed(**changes) -> list:
    return [MAPPING['observation'][0] | changes]


@pytest.mark.parametrize(
    ('live', 'changes', 'said'),
    [
        ({'rate': 20.0}, {}, 'live.rate = 20.0, not 10.0'),
        ({'limits': {'change': 1.0}}, {}, 'live.limits.change = 1.0, not None'),
        ({'limits': {'high': 1.0}}, {}, 'live.limits.high = 1.0, not None'),
        (
            {'limits': {'position': LIMIT | {'low': -1.0, 'high': 1.0}}},
            {},
            "live.limits.position.fields = ['position'], not None",
        ),
        (
            {'command': MAPPING['live']['command'] | {'safe': 0.5}},
            {},
            'live.command.safe = 0.5, not 0.0',
        ),
        (
            {'command': MAPPING['live']['command'] | {'type': 'std_msgs/msg/Float32MultiArray'}},
            {},
            "live.command.type = 'std_msgs/msg/Float32MultiArray'",
        ),
        ({}, {'observation': observed(joints=['b', 'a'])}, "observation[0].joints = ['b', 'a']"),
        ({}, {'observation': observed(topic='/joints')}, "observation[0].topic = '/joints'"),
        ({}, {'observation': observed(units=['deg', 'deg/s'])}, 'observation[0].units = ['),
        ({}, {'action': MAPPING['action'] | {'high': [3.0, 2.0]}}, 'action.high = [3.0, 2.0]'),
        ({}, {'action': MAPPING['action'] | {'topic': '/other'}}, "action.topic = '/other'"),
        ({}, {'sampling': {'max_age': 1.0}}, 'sampling.max_age = 1.0, not 0.25'),
    ],
)
def test_a_mapping_that_makes_the_policy_act_otherwise_is_refused(live, changes, said):
    with pytest.raises(AnotherRobotError) as refused:
        check_mapping(rules(), rules(live, **changes), 'm.yaml', 'policy file p', False)
    message = str(refused.value)
    assert said in message
    assert 'mapping m.yaml' in message and 'policy file p' in message
    assert 'Leave the mapping out' in message


def test_what_watches_over_the_robot_and_ends_its_episodes_may_be_other():
    live = {
        'stop': {'topic': '/stop'},
        'watchdog': {'heartbeat': '/beat'},
        'reset': {'by': 'person'},
        'episode_steps': 500,
    }
    changed = rules(live, source='other', episode={'topic': '/done'})
    check_mapping(rules(), changed, 'm.yaml', 'p', False)
    (found,) = differences(rules(), changed, episodes=True)  # the policy sees how far it is
    assert found == ('live.episode_steps', 5, 500)


def test_topics_of_another_type_are_refused():
    facts = policies.facts()
    check_types(facts, {'/joint_states': [policies.JOINT_STATE]}, 'p')
    check_types(facts, {}, 'p')  # whoever waits for it names it
    with pytest.raises(AnotherRobotError, match='/joint_states is of type a/msg/B here, and was '):
        check_types(facts, {'/joint_states': ['a/msg/B']}, 'p')


def test_observations_of_another_size_are_refused_and_the_entry_is_named():
    check_sizes(policies.facts(), (4,), 4, 'p')
    with pytest.raises(AnotherRobotError, match=r'observation\[0\], position, velocity of /j'):
        check_sizes(policies.facts(), (6,), 4, 'p')
    with pytest.raises(AnotherRobotError, match=r'of 4 numbers, and .* give 6 \(6\)'):
        check_sizes(policies.facts(sizes=()), (6,), 4, 'p')  # the sizes of training are not known
