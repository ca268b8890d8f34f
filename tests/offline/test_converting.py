"""Ordinary topics become steps and scores by rules of time that a test can do by hand."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from codetr_ros.bags.errors import Place
from codetr_ros.bags.reader import Message
from codetr_ros.config import SettingsError, validate
from codetr_ros.offline import converting
from codetr_ros.offline.converting import Converter
from codetr_ros.offline.errors import FitError
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.robots import conversion
from codetr_ros.robots.errors import MessageError
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.message_fields import NS
from codetr_ros.robots.values import Values, numbers

PLACE = Place(Path('bag'), 0)


def rules(**changes: Any) -> Mapping:
    plain: dict[str, Any] = {
        'observation': [{'topic': '/state', 'fields': ['data']}],
        'action': {'topic': '/command', 'fields': ['data']},
        'score': {'topic': '/score'},
        'episode': {'topic': '/end'},
    }
    return validate(Mapping, plain | changes, 'test')


def said(at: float, topic: str, value: Any = None) -> Message:
    """A message received at a time [s]."""
    time = round(at * NS)
    return Message('x/msg/X', SimpleNamespace(data=value), topic, time, time, PLACE)


def run(made: Mapping, *messages: Message) -> tuple[list[Any], list[Any], Converter]:
    """Steps (episode, first step, observations, actions, ended) and scores of messages."""
    converter = Converter(made, 'run')
    records = [r for m in messages for r, _ in converter.feed(m)]
    records += [r for r, _ in converter.finish()]
    steps = [
        (
            r.episode,
            r.first_step,
            [round(float(x), 3) for x in r.observations[:, 0]],
            [round(float(x), 3) for x in r.actions[:, 0]],
            (r.terminated, r.truncated),
        )
        for r in records
        if isinstance(r, Transitions)
    ]
    scores = [
        (r.episode, r.first_step, r.length, r.value)
        for r in records
        if isinstance(r, CompositeReward)
    ]
    return steps, scores, converter


def commands(*times: float, state: float = 0.01):
    """Commands, each with an observation a little before it whose value is the time."""
    for time in times:
        yield said(time - state, '/state', [time])
        yield said(time, '/command', [time / 10])


def test_a_step_goes_from_what_holds_at_a_command_to_what_holds_at_the_next():
    steps, _, _ = run(
        rules(),
        said(0.9, '/state', [1.0]),
        said(1.0, '/command', [0.5]),
        said(1.05, '/state', [2.0]),
        said(1.06, '/state', [3.0]),  # the last one holds
        said(1.1, '/command', [-0.5]),
        said(1.15, '/state', [4.0]),
        said(1.2, '/end'),
    )
    assert steps == [(0, 0, [1.0, 3.0, 4.0], [0.5, -0.5], (False, True))]


def test_an_end_may_be_a_terminal_state_and_depend_on_a_field():
    ends = {'topic': '/end', 'field': 'data', 'equals': True, 'terminal': True}
    steps, _, _ = run(
        rules(episode=ends),
        *commands(1.0, 1.1),
        said(1.11, '/end', False),
        *commands(1.2),
        said(1.21, '/state', [7.0]),
        said(1.22, '/end', True),
        *commands(1.3, 1.4),
    )
    assert steps[0] == (
        0,
        0,
        [1.0, 1.1, 1.2, 7.0],
        [0.1, 0.11, 0.12],
        (True, False),
    )
    assert steps[1][0] == 1
    assert steps[1][4] == (False, True)


def test_the_last_step_is_as_long_as_the_one_before_however_long_nothing_comes():
    """The state goes on changing after the last command: that is not what the step led to."""
    steps, _, _ = run(
        rules(),
        *commands(1.0, 1.1),
        said(1.15, '/state', [5.0]),
        said(1.25, '/state', [6.0]),
        said(1.9, '/state', [9.0]),
        *commands(3.0, 3.1),
    )
    assert steps[0][2] == [1.0, 1.1, 5.0]


def test_the_only_step_of_an_episode_lasts_until_its_end():
    steps, _, _ = run(
        rules(),
        *commands(1.0, 1.1),
        said(1.15, '/state', [5.0]),
        said(1.2, '/end'),
        *commands(3.0),
        said(3.05, '/state', [6.0]),
        said(3.15, '/state', [7.0]),
        said(3.2, '/end'),
    )
    assert steps[1][:3] == (1, 0, [3.0, 7.0])


def test_a_last_step_after_which_nothing_was_observed_is_dropped():
    steps, scores, converter = run(
        rules(), *commands(1.0, 1.1), said(1.1, '/score', 2.0), said(1.1, '/end')
    )
    assert steps == [(0, 0, [1.0, 1.1], [0.1], (False, True))]
    assert scores == [(0, 0, 1, 2.0)]
    assert dict(converter.conversion.dropped) == {
        converting.NO_NEXT: 1,
        conversion.SCORE_TRIMMED: 1,
    }


def test_a_pause_of_commands_ends_the_episode():
    steps, _, _ = run(rules(), *commands(1.0, 1.1, 1.2, 3.0, 3.1), said(3.2, '/state', [8.0]))
    assert [(s[0], len(s[3])) for s in steps] == [(0, 2), (1, 2)]


def test_there_is_no_step_across_a_hole_in_the_observations():
    steps, _, converter = run(
        rules(),
        *commands(1.0, 1.1),
        said(1.11, '/state', [4.0]),
        said(1.4, '/command', [0.0]),  # 0.29 s after the last observation: more than max_age
        *commands(1.5, 1.6),
        said(1.7, '/state', [8.0]),
    )
    assert [(s[0], s[2]) for s in steps] == [(0, [1.0, 1.1, 4.0]), (1, [1.5, 1.6, 8.0])]
    assert converter.conversion.dropped[converting.NO_OBSERVATION] == 1


def test_what_is_not_finite_is_no_step():
    steps, scores, converter = run(
        rules(),
        *commands(1.0, 1.1),
        said(1.15, '/state', [np.nan]),
        said(1.2, '/command', [0.0]),
        said(1.25, '/score', np.inf),
        *commands(1.3, 1.4),
    )
    assert [s[2] for s in steps] == [[1.0, 1.1], [1.3, 1.4]]
    assert scores == []
    assert converter.conversion.dropped[converting.NOT_FINITE] == 1
    assert converter.conversion.dropped[conversion.SCORE_NOT_FINITE] == 1


def test_several_topics_are_one_observation_once_each_has_been_heard():
    both = [{'topic': '/state', 'fields': ['data']}, {'topic': '/imu', 'fields': ['data']}]
    converter = Converter(rules(observation=both), 'run')
    messages = [
        *commands(1.0),
        said(1.05, '/imu', [7.0, 8.0]),
        *commands(1.1, 1.2),
    ]
    records = [r for m in messages for r, _ in converter.feed(m)]
    records += [r for r, _ in converter.finish()]
    assert records[0].observations.tolist() == pytest.approx(
        np.float32([[1.1, 7, 8], [1.2, 7, 8]])
    )
    assert converter.conversion.dropped[converting.NO_OBSERVATION] == 1


def test_commands_are_scaled_to_between_minus_1_and_1_and_clipped_with_a_count():
    action = {'topic': '/command', 'fields': ['data'], 'low': [0.0, -4.0], 'high': [10.0, 4.0]}
    messages = []
    for time, command in ((1.0, [5.0, 4.0]), (1.1, [0.0, -8.0]), (1.2, [10.0, 0.0])):
        messages += [said(time - 0.01, '/state', [0.0]), said(time, '/command', command)]
    converter = Converter(rules(action=action), 'run')
    ((chunk, _),) = [*(r for m in messages for r in converter.feed(m)), *converter.finish()]
    assert chunk.actions.tolist() == [[0.0, 1.0], [-1.0, -1.0]]
    assert converter.conversion.dropped[converting.CLIPPED] == 1


def test_at_a_fixed_rate_the_command_holds_and_steps_begin_at_ticks():
    steps, _, converter = run(
        rules(sampling={'by': 'rate', 'rate': 10.0}),
        said(0.95, '/state', [1.0]),
        said(1.0, '/command', [0.5]),
        said(1.09, '/state', [2.0]),
        said(1.1, '/state', [3.0]),  # at the very tick: it holds from then on
        said(1.14, '/command', [-0.5]),
        said(1.21, '/state', [4.0]),
        said(1.33, '/end'),
    )
    # ticks at 1.0, 1.1, 1.2, 1.3; the last has had no observation after it
    assert steps == [(0, 0, [1.0, 3.0, 3.0, 4.0], [0.5, 0.5, -0.5], (False, True))]
    assert (converter.conversion.shortest, converter.conversion.longest) == (0.1, 0.1)


def test_a_score_is_of_all_steps_since_the_last_one():
    _, scores, _ = run(
        rules(),
        *commands(1.0, 1.1, 1.2),
        said(1.25, '/score', 5.0),
        *commands(1.3, 1.4),
        said(1.45, '/state', [0.0]),
        said(1.5, '/end'),
        said(1.6, '/score', 6.0),  # the episode has ended: still its score
        *commands(3.0, 3.1),
        said(3.15, '/score', 7.0),
        said(3.16, '/state', [0.0]),
    )
    assert scores == [(0, 0, 3, 5.0), (0, 3, 2, 6.0), (1, 0, 2, 7.0)]


def test_a_score_may_be_of_the_last_steps_that_are_not_scored_yet():
    _, scores, converter = run(
        rules(score={'topic': '/score', 'of': 'last_steps', 'steps': 2}),
        *commands(1.0),
        said(1.05, '/score', 1.0),  # of one step: there are not two
        *commands(1.1, 1.2),
        said(1.25, '/score', 2.0),
        *commands(1.3),
        said(1.35, '/score', 3.0),  # of a step that has had its score
        *commands(1.4),
        said(1.45, '/score', 4.0),
        said(1.46, '/state', [0.0]),
    )
    assert scores == [(0, 1, 2, 2.0), (0, 3, 2, 4.0)]
    assert converter.conversion.dropped[conversion.SCORE_OF_NOTHING] == 1
    assert converter.conversion.dropped[conversion.SCORE_AGAIN] == 1


def test_an_episode_of_which_nothing_is_left_leaves_no_gap_in_the_numbers():
    steps, scores, converter = run(
        rules(score={'topic': '/score', 'late': 0.0}),
        *commands(1.0, 1.1),
        said(1.15, '/state', [0.0]),
        said(1.2, '/end'),
        *commands(2.0),
        said(2.0, '/score', 9.0),
        said(2.0, '/end'),
        *commands(4.0, 4.1),
        said(4.15, '/score', 1.0),
    )
    assert [s[0] for s in steps] == [0, 1]
    assert scores == [(1, 0, 1, 1.0)]
    assert converter.conversion.dropped[conversion.SCORE_DROPPED] == 1


def test_long_episodes_come_in_chunks_that_join(monkeypatch):
    monkeypatch.setattr(converting, 'MESSAGE_BYTES', 3 * 4 * 2)  # three steps of two numbers
    steps, _, _ = run(rules(), *commands(*(1 + i / 10 for i in range(8))))
    assert [(s[1], len(s[3]), s[4][1]) for s in steps] == [
        (0, 3, False),
        (3, 3, False),
        (6, 1, True),
    ]
    assert steps[0][2][-1] == steps[1][2][0]


def test_a_clock_that_goes_back_ends_the_episode_and_nothing_is_held_across_it():
    steps, scores, converter = run(
        rules(),
        *commands(1.0, 1.1),
        said(1.15, '/state', [5.0]),
        said(1.16, '/score', 3.0),
        said(0.5, '/command', [0.0]),  # what was observed before is not of this time
        *commands(0.6, 0.7),
        said(0.75, '/state', [6.0]),
        said(0.76, '/score', 4.0),
    )
    assert [step[:3] for step in steps] == [(0, 0, [1.0, 1.1, 5.0]), (1, 0, [0.6, 0.7, 6.0])]
    assert scores == [(0, 0, 2, 3.0), (1, 0, 2, 4.0)]
    assert converter.conversion.dropped == {
        converting.CLOCK_BACK: 1,
        converting.NO_OBSERVATION: 1,
    }


def test_the_time_of_a_message_may_be_that_of_its_header():
    late = (message._replace(log_time=9 * converting.NS) for message in commands(1.0, 1.1))
    stamped = [message._replace(stamp=message.publish_time) for message in late]
    steps, _, converter = run(rules(), *stamped, said(1.15, '/state', [5.0]))
    assert steps == [(0, 0, [1.0, 1.1, 5.0], [0.1, 0.11], (False, True))]
    assert converter.conversion.shortest == pytest.approx(0.1)


def test_a_topic_has_one_time():
    both = [{'topic': '/state', 'fields': ['data'], 'time': clock} for clock in ('log', 'header')]
    with pytest.raises(SettingsError, match='/state has two times, log and header'):
        rules(observation=both)
    made = rules(time='header', action={'topic': '/command', 'fields': ['data'], 'time': 'log'})
    assert made.stamped == {'/state', '/score', '/end'}


def joint_state(names, position):
    return SimpleNamespace(name=names, position=np.array(position), velocity=np.empty(0))


def test_joints_are_found_by_name_whatever_their_order():
    values = Values(topic='/j', fields=('position',), joints=('b', 'a'))
    assert numbers(joint_state(['a', 'x', 'b'], [1, 2, 3]), values).tolist() == [3, 1]
    assert numbers(joint_state(['a'], [1]), values) is None
    empty = values.model_copy(update={'fields': ('velocity',)})
    assert numbers(joint_state(['a', 'b'], [1, 2]), empty) is None


def test_joints_may_be_named_by_joint_names_as_in_a_trajectory():
    values = Values(topic='/t', fields=('points[0].positions',), joints=('b', 'a'))
    point = SimpleNamespace(positions=np.array([1.0, 2.0, 3.0]))
    message = SimpleNamespace(joint_names=['a', 'x', 'b'], points=[point])
    assert numbers(message, values).tolist() == [3, 1]
    with pytest.raises(MessageError, match='/t names no joints: there is neither `name` nor'):
        numbers(SimpleNamespace(name='arm', points=[point]), values)


def test_a_message_that_names_a_joint_twice_is_passed_over_with_a_count():
    joints = [{'topic': '/state', 'fields': ['position'], 'joints': ['a']}]
    converter = Converter(rules(observation=joints), 'run')
    for names in (['a', 'b'], ['a', 'a'], ['b', 'b']):
        list(converter.feed(said(1.0, '/state')._replace(message=joint_state(names, [1, 2]))))
    assert converter.conversion.dropped == {
        converting.JOINT_TWICE: 1,
        converting.NO_JOINTS: 1,
    }


def test_a_topic_of_the_mapping_may_lack_its_leading_slash():
    made = rules(action={'topic': 'command', 'fields': ['data']})
    assert made.action.topic == '/command'


def test_fields_are_reached_by_dots_and_indices():
    pose = SimpleNamespace(x=1.0, y=2.0)
    message = SimpleNamespace(poses=[pose, SimpleNamespace(x=3.0, y=4.0)], data=np.arange(3.0))
    values = Values(topic='/p', fields=('poses[1].y', 'data[2]', 'data'))
    assert numbers(message, values).tolist() == [4, 2, 0, 1, 2]


@pytest.mark.parametrize(
    ('path', 'expected'),
    [
        ('velocity', "/p has no field 'velocity': there is no 'velocity' in poses, data"),
        ('poses[0].z', "there is no 'z' in x, y"),
        ('data[7]', r"/p has no element 'data\[7\]'"),
        ('poses', "/p: field 'poses' holds no numbers"),
    ],
)
def test_a_field_that_does_not_exist_is_named_with_those_that_do(path, expected):
    message = SimpleNamespace(poses=[SimpleNamespace(x=1.0, y=2.0)], data=np.arange(3.0))
    with pytest.raises(MessageError, match=expected):
        numbers(message, Values(topic='/p', fields=(path,)))


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({'sampling': {'by': 'rate'}}, 'rate must be given if `by` is rate'),
        ({'score': {'topic': '/s', 'of': 'last_steps'}}, 'steps must be given if `of`'),
        (
            {'action': {'topic': 'a b', 'fields': ['data']}},
            "action.topic = 'a b': must be the name of a topic, such as /joint_states",
        ),
        (
            {'action': {'topic': '/x', 'fields': ['data'], 'low': 2.0}},
            r'low = 2.0 must be less than high = 1.0',
        ),
        ({'episode': {'field': 'data'}}, 'field and equals belong together'),
        ({'observations': []}, 'observations = .*there is no such setting'),
    ],
)
def test_a_mapping_that_makes_no_sense_is_refused_by_name(changes, expected):
    with pytest.raises(SettingsError, match=expected):
        rules(**changes)


def test_sizes_that_change_are_refused():
    messages = [*commands(1.0, 1.1), said(1.15, '/state', [1.0, 2.0]), said(1.2, '/command', [0])]
    with pytest.raises(FitError, match=r'had the sizes \(1, 1\), and now \(2, 1\)'):
        run(rules(), *messages)


def test_a_score_that_is_no_number_is_refused():
    with pytest.raises(MessageError, match="/score: field 'data' holds no number"):
        run(rules(), *commands(1.0), said(1.1, '/score', 'good'))
