from dataclasses import fields, replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rclpy.serialization import deserialize_message, serialize_message

from codetr_ros.bags import definitions
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Policy,
    Presence,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.ros import messages, peers, qos
from helpers.builders import run, same, tiny, transitions

STAMP = Time(sec=3, nanosec=4)
ODD = np.array(
    [0.1, -0.0, 1e-45, np.nan, np.inf], np.float32
)  # a sign, a denormal, what is no number

EXAMPLES = {
    RunSpec: RunSpec('r', 1, 7, '{"ä": 1}', 'ab'),
    Presence: Presence(
        'r', 'sim', '/r/s', 'x', '', True, ('a', 'b'), np.array([1, 2**63], 'u8'), 2**40
    ),
    TaskSpec: TaskSpec('r', 1, 'sim', 'Ant-v4', 27, 8, 1000, 0.05, 0.1),
    Policy: Policy('r', 3, -1, ('sim',), np.array([5], np.uint32), False, '{}', bytes(range(9))),
    Transitions: transitions(sequence=2**40),
    CompositeReward: CompositeReward('r', 'sim', 'me', 5, 6, 7, 8, 0.1),
    Commit: Commit('r', 1, ('a', 'b'), np.array([-1, 2**40]), ('c',), np.array([4]), ('d',)),
    StepRewards: StepRewards(
        'r', 1, 2, 0, 1, 'sim',
        np.array([1, 2], np.uint32), np.array([0, 7], np.uint32), np.array([2, 3], np.uint32), ODD,
    ),
    EpisodeResult: EpisodeResult('r', 'sim', 'random', 1, -1, 2, 3, 0.1, 0.2, 0.3, True),
    TrueRewards: TrueRewards('r', 'sim', 1, 2, 3, 4, ODD),
    Metrics: Metrics('r', 'reward', 'reward', 1, 2, ('x', 'y'), np.array([0.1, np.nan])),
}  # fmt: skip


def there_and_back(record):
    message = messages.to_message(record, STAMP)
    raw = serialize_message(message)
    return messages.from_message(deserialize_message(raw, type(message)))


@pytest.mark.parametrize('record_type', TOPICS, ids=lambda t: t.__name__)
def test_every_record_arrives_with_the_same_bits(record_type):
    record = EXAMPLES[record_type]
    assert same(there_and_back(record), record)


@pytest.mark.parametrize('record_type', TOPICS, ids=lambda t: t.__name__)
def test_bytes_are_decoded_and_encoded_without_ros_as_ros_does(record_type):
    record = EXAMPLES[record_type]
    raw = bytes(serialize_message(messages.to_message(record, STAMP)))
    assert same(definitions.decode(record_type, raw), record)
    ours = definitions.encode(record, 3 * 10**9 + 4)
    assert len(ours) == len(raw)  # what ROS leaves between two fields is not the same every time
    message = deserialize_message(ours, messages.message_type(record_type))
    assert same(messages.from_message(message), record) and message.stamp == STAMP


def test_a_stamp_is_the_only_thing_that_a_message_adds():
    for record_type in TOPICS:
        names = list(messages.message_type(record_type).get_fields_and_field_types())
        assert names == ['stamp', *(f.name for f in fields(record_type))]
    assert messages.to_message(EXAMPLES[Commit], STAMP).stamp == STAMP


def test_arrived_arrays_are_memory_of_our_own():
    message = messages.to_message(transitions(), STAMP)
    record = messages.from_message(message)
    message.observations[0] = 99.0
    assert record.observations[0, 0] != 99.0
    assert record.observations.flags.owndata or record.observations.base.flags.owndata
    assert record.observations.flags.writeable


@pytest.mark.parametrize(
    ('record_type', 'field', 'wrong', 'said'),
    [
        (Transitions, 'observations', 17, 'observations has length 17, expected a multiple of 6'),
        (Transitions, 'actions', 9, 'actions has length 9, expected a multiple of 5'),
        (Transitions, 'actions', 0, 'actions has length 0'),
        (StepRewards, 'labels', 4, 'labels has length 4, expected 5, the sum of lengths'),
        (StepRewards, 'lengths', 1, 'lengths has length 1, expected 2 as episodes'),
        (Commit, 'transitions', 1, 'transitions has length 1, expected 2 as sources'),
        (Metrics, 'values', 1, 'values has length 1, expected 2 as names'),
        (TrueRewards, 'rewards', 0, 'rewards has length 0, expected at least 1'),
    ],
)
def test_arrays_whose_lengths_disagree_are_refused_by_name(record_type, field, wrong, said):
    message = messages.to_message(EXAMPLES[record_type], STAMP)
    setattr(message, field, getattr(message, field)[:wrong])
    with pytest.raises(RecordError) as refused:
        messages.from_message(message)
    assert said in str(refused.value)
    assert TOPICS[record_type] in str(refused.value)


def test_a_chunk_without_steps_is_refused_and_says_whose_it_is():
    message = messages.to_message(transitions(), STAMP)
    message.steps = 0
    with pytest.raises(RecordError, match="from 'sim'.*steps of at least 1"):
        messages.from_message(message)


def test_a_number_that_does_not_fit_its_field_is_not_sent():
    with pytest.raises(RecordError, match='Transitions.phase cannot be sent: -1 is outside 0'):
        messages.to_message(replace(transitions(), phase=-1), STAMP)


def test_every_topic_has_a_quality_of_service_readers_and_writers():
    topics = set(TOPICS.values())
    assert set(qos.QUALITIES) == topics
    assert set(peers.READERS) == set(peers.WRITERS) == topics - {'presence'}


@pytest.mark.parametrize('method', ['codetr', 'hc'])
def test_the_roles_that_read_a_topic_are_those_whose_cores_want_it(method):
    from codetr_ros.cores.evaluator import Evaluator
    from codetr_ros.cores.labeller import Labeller
    from codetr_ros.cores.learner import Learner
    from codetr_ros.cores.simulator import Simulator

    settings = tiny(method=method)
    spec = run(settings)
    wanted = {
        'sim': Simulator.subscribes,
        'evaluate': Evaluator.subscribes,
        'reward': Labeller.subscribes,
        'learner': Learner(spec, settings, 'learner', None).subscribes,
    }
    readers = peers.readers(settings)
    for role in settings.roles.keys() & wanted:
        topics = {TOPICS[kind] for kind in wanted[role]} - {'run'}
        assert topics == {t for t, roles in readers.items() if role in roles and t != 'run'}


def test_a_run_that_learns_from_scores_itself_needs_no_reward_node():
    assert 'reward' in tiny().roles
    assert tiny(method='hc', simulators=2).roles == {
        'sim': 2, 'evaluate': 1, 'record': 1, 'learner': 1,
    }  # fmt: skip


def test_queues_are_deeper_than_what_the_permitted_phases_can_hold():
    from codetr_ros.config import Settings

    settings = Settings(overlap=True, phase_steps=1000)
    for topic in ('transitions', 'composite_rewards', 'true_rewards', 'episodes'):
        assert qos.depth(topic, settings) >= 3000  # a chunk, segment, episode may be one step
    million = 4 * 10**6 + 12 * 10**6  # bytes of labels and segments at delay 1
    assert qos.depth('step_rewards', settings) >= 3 * million / 200_000
