"""Steps and scores are the same whatever the order of the file, and by whichever time is asked."""

import json

import numpy as np
import pytest

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.cli import main
from codetr_ros.config import validate
from codetr_ros.offline import converted_bag, converting
from codetr_ros.offline.converted_bag import convert
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.robots import conversion
from codetr_ros.robots.mapping import Mapping
from helpers.arm import JOINTS, NOON, NS, Sent, attempt, bag, joint_state, mcap_file, number, rules

SCORES = [(first, 10, float(first + 9)) for first in (0, 10, 20, 30)]
MS = 1_000_000


def converted(there, folder, **changes):
    """Observations of each episode, its scores, and what was counted."""
    made = convert(Bag(there), validate(Mapping, rules(**changes), 'test'), folder)
    episodes: dict[int, list] = {}
    scores: dict[int, list] = {}
    for entry in Bag(folder).entries([Transitions, CompositeReward]):
        record = entry.record
        if isinstance(record, Transitions):
            episodes.setdefault(record.episode, []).append(record.observations)
        else:
            scores.setdefault(record.episode, []).append(
                (record.first_step, record.length, record.value)
            )
    found = {k: np.concatenate([o[: len(o)] for o in parts]) for k, parts in episodes.items()}
    return found, scores, made


def expected(steps=40):
    return np.array([[i, -i] for i in range(steps + 1)], np.float32)


@pytest.mark.parametrize('write', [bag, mcap_file])
def test_a_bag_written_topic_by_topic_gives_the_steps_of_one_in_order(write, tmp_path):
    order = ['/joint_states', '/cmd', '/score']
    sent = sorted(attempt(40), key=lambda one: order.index(one.topic))
    found, scores, made = converted(write(tmp_path / 'x.mcap', sent), tmp_path / 'out')
    assert found.keys() == {0} and np.array_equal(found[0], expected())
    assert scores == {0: SCORES}
    assert (made.shortest, made.longest) == (0.02, 0.02)
    assert made.dropped == {converted_bag.LATE: 44}


def test_what_was_only_put_in_order_is_not_printed_as_dropped(tmp_path, capsys):
    sent = sorted(attempt(40), key=lambda one: one.topic)
    there = mcap_file(tmp_path / 'x.mcap', sent)
    (tmp_path / 'mapping.json').write_text(json.dumps(rules()))  # JSON is YAML
    given = ['convert', str(there), '--mapping', str(tmp_path / 'mapping.json')]
    assert main([*given, '--out', str(tmp_path / 'out')]) == 0
    out = capsys.readouterr().out
    assert 'dropped     nothing\n' in out
    assert f'noted       44 {converted_bag.LATE}\n' in out


@pytest.mark.parametrize('write', [bag, mcap_file])
def test_each_run_of_a_simulated_clock_is_an_episode(write, tmp_path):
    sent = attempt(40, begin=0) + attempt(40, begin=0)
    found, scores, made = converted(write(tmp_path / 'x.mcap', sent), tmp_path / 'out')
    assert found.keys() == {0, 1}
    assert all(np.array_equal(one, expected()) for one in found.values())
    assert scores == {0: SCORES, 1: SCORES}
    assert made.dropped == {converting.CLOCK_BACK: 1}
    assert verify(tmp_path / 'out').sound


def test_what_cannot_be_ordered_is_refused_and_nothing_is_left(tmp_path):
    sent = sorted(attempt(40, begin=0) * 2, key=lambda one: one.topic)
    with pytest.raises(BagError, match='the clock went back'):
        converted(mcap_file(tmp_path / 'x.mcap', sent), tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


def stamped(delay, begin=NOON, received=NOON):
    """An arm whose commands are JointStates; joint states are received `delay` ms after the time
    in their header, which is when they were measured.
    """
    sent = []
    for one in attempt(40, begin):
        message, time = one.message, one.time - begin + received
        if one.topic == '/cmd':
            message = joint_state(one.time, JOINTS, one.message.data)
        late = delay * MS if one.topic == '/joint_states' else 0
        sent.append(one._replace(message=message, time=time + late))
    return sorted(sent, key=lambda one: one.time)


BY_HEADER = {
    'time': 'header',
    'action': {'topic': '/cmd', 'fields': ['position']},
    'score': {'topic': '/score', 'field': 'data', 'time': 'log'},
}


@pytest.mark.parametrize('delay', [0, 30, 400])
def test_by_its_header_an_observation_is_of_when_it_was_measured(delay, tmp_path):
    there = mcap_file(tmp_path / 'x.mcap', stamped(delay))
    found, scores, made = converted(there, tmp_path / 'out', **BY_HEADER)
    assert np.array_equal(found[0], expected())
    assert scores == {0: SCORES}
    assert (made.shortest, made.longest) == (0.02, 0.02)
    times = [entry.log_time for entry in Bag(tmp_path / 'out').entries([Transitions])]
    assert times == [NOON + 800 * MS], 'a record has the time of the step, too'


def test_by_when_it_was_received_a_late_observation_is_of_a_later_step(tmp_path):
    there = mcap_file(tmp_path / 'x.mcap', stamped(30))
    found, _, _ = converted(there, tmp_path / 'out', action=BY_HEADER['action'])
    assert found[0][0].tolist() == [0, 0] and len(found[0]) < 41


def simulated():
    """Two runs of a simulation, recorded by the clock of the wall."""
    sent = stamped(0, 0, NOON) + stamped(0, 0, NOON + 5 * NS)
    return [
        one._replace(message=joint_state(one.time % NS, ['score'], [one.message.data]))
        if one.topic == '/score'
        else one
        for one in sent
    ]


def test_headers_of_a_simulated_clock_that_starts_again_end_the_episode(tmp_path):
    there = mcap_file(tmp_path / 'x.mcap', simulated())
    score = {'topic': '/score', 'field': 'position[0]'}
    found, scores, made = converted(there, tmp_path / 'out', **BY_HEADER | {'score': score})
    first = (0, 9, 9.0)  # at 0 s a header has no time, so nothing is observed at the first command
    assert scores == {0: [first, *((f - 1, n, v) for f, n, v in SCORES[1:])], 1: scores[0]}
    assert all(np.array_equal(one, expected()[1:]) for one in found.values())
    assert made.dropped == {
        converting.CLOCK_BACK: 1,
        converted_bag.UNSET: 2,
        converting.NO_OBSERVATION: 2,
    }


def test_clocks_that_differ_are_not_mixed(tmp_path):
    there = mcap_file(tmp_path / 'x.mcap', simulated())
    score = {'topic': '/score', 'field': 'position[0]', 'time': 'log'}
    with pytest.raises(BagError, match=r'headers of /cmd are more than 10 s .* so /score cannot'):
        converted(there, tmp_path / 'out', **BY_HEADER | {'score': score})


def test_a_message_without_a_header_is_refused_with_the_remedy(tmp_path):
    there = mcap_file(tmp_path / 'x.mcap', attempt(40))
    with pytest.raises(BagError, match=r'/cmd \(std_msgs/msg/Float64MultiArray\) has no header'):
        converted(there, tmp_path / 'out', time='header')
    action = {'topic': '/cmd', 'fields': ['data'], 'time': 'log'}
    score = {'topic': '/score', 'field': 'data', 'time': 'log'}
    found, _, _ = converted(there, tmp_path / 'out', time='header', action=action, score=score)
    assert np.array_equal(found[0], expected())


def test_headers_without_a_time_are_counted_and_left_out(tmp_path):
    sent = stamped(0)
    for i, one in enumerate(sent):
        if one.topic == '/joint_states' and one.time > NOON + 700 * MS:
            sent[i] = one._replace(message=joint_state(0, JOINTS, one.message.position))
    there = mcap_file(tmp_path / 'x.mcap', sent)
    _, _, made = converted(there, tmp_path / 'out', **BY_HEADER)
    assert made.dropped[converted_bag.UNSET] == 5


def test_a_header_that_goes_back_once_is_put_in_its_place(tmp_path):
    sent = stamped(0)
    old = sent[2]
    sent.insert(60, old._replace(time=sent[60].time))
    there = mcap_file(tmp_path / 'x.mcap', sent)
    found, _, made = converted(there, tmp_path / 'out', **BY_HEADER)
    assert np.array_equal(found[0], expected())
    assert made.dropped == {converted_bag.LATE: 1}


def test_a_verdict_after_the_clock_went_back_is_of_the_attempt_before(tmp_path):
    first = [one for one in attempt(40, begin=0) if one.topic != '/score']
    verdict = Sent('/score', 0, number(7.0))
    second = attempt(40, begin=0)
    there = mcap_file(tmp_path / 'x.mcap', [*first, verdict, *second])
    found, scores, _ = converted(there, tmp_path / 'out')
    assert found.keys() == {0, 1}
    assert scores == {0: [(0, 40, 7.0)], 1: SCORES}


def test_a_stamp_of_before_the_clock_went_back_is_not_taken_for_one_of_after(tmp_path):
    score = {
        'topic': '/score',
        'field': 'position[0]',
        'of': 'since_last',
        'stamp': 'header.stamp',
    }
    attempts = [one for one in attempt(40, begin=0) if one.topic != '/score']

    def verdict(received, stamp, value):
        return Sent('/score', received * MS, joint_state(stamp * MS, ['score'], [value]))

    sent = [*attempts, verdict(801, 400, 5.0), *attempts, verdict(801, 400, 6.0)]
    sent.insert(len(attempts) + 11, verdict(90, 700, 4.0))
    found, scores, made = converted(
        mcap_file(tmp_path / 'x.mcap', sent), tmp_path / 'out', score=score
    )
    assert found.keys() == {0, 1}
    assert scores == {0: [(0, 20, 5.0)], 1: [(0, 20, 6.0)]}
    assert made.dropped == {converting.CLOCK_BACK: 1, conversion.SCORE_OF_EITHER: 1}
