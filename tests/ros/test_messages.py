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
    Preference,
    Presence,
    RecordError,
    RunSpec,
    ScoreRequest,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.roles import WRITERS, readers
from codetr_ros.ros import messages, qos
from helpers.builders import run, same, tiny, transitions

STAMP = Time(sec=3, nanosec=4)
STAMP_NS = 3 * 10**9 + 4
ODD = np.array(
    [0.1, -0.0, 1e-45, np.nan, np.inf], np.float32
)  # a sign, a denormal, what is no number

EXAMPLES = {
    RunSpec: RunSpec(
        run_id='r', protocol_version=1, seed=7, settings='{"ä": 1}', settings_hash='ab'
    ),
    Presence: Presence(
        run_id='r',
        role='sim',
        node='/r/s',
        instance_id='x',
        settings_hash='',
        finished=True,
        topics=('a', 'b'),
        published=np.array([1, 2**63], 'u8'),
        missed=2**40,
        doing='waits for the réward node',
        waiting=0.1,
    ),
    TaskSpec: TaskSpec(
        run_id='r',
        protocol_version=1,
        source='sim',
        task='Ant-v4',
        observation_size=27,
        action_size=8,
        horizon=1000,
        control_period=0.05,
        r_max=0.1,
    ),
    Policy: Policy(
        run_id='r',
        phase=3,
        version=-1,
        sources=('sim',),
        steps=np.array([5], np.uint32),
        random=False,
        network='{}',
        weights=bytes(range(9)),
    ),
    Transitions: transitions(sequence=2**40),
    CompositeReward: CompositeReward(
        run_id='r',
        source='sim',
        scorer='me',
        sequence=5,
        episode=6,
        first_step=7,
        length=8,
        value=0.1,
    ),
    Preference: Preference(
        run_id='r',
        scorer='me',
        sequence=6,
        source='sim',
        episode=1,
        first_step=2,
        length=3,
        other_source='sim_2',
        other_episode=4,
        other_first_step=5,
        other_length=7,
        outcome=0.5,
    ),
    ScoreRequest: ScoreRequest(
        run_id='r',
        phase=3,
        sources=('sim', 'sim_2'),
        episodes=np.array([1, 2], np.uint32),
        first_steps=np.array([0, 7], np.uint32),
        lengths=np.array([2, 3], np.uint32),
        worths=np.array([np.nan, 0.5], np.float32),
    ),
    Commit: Commit(
        run_id='r',
        phase=1,
        sources=('a', 'b'),
        transitions=np.array([-1, 2**40]),
        scorers=('c',),
        scores=np.array([4]),
        dropped=('d',),
        transition_digests=('ab', 'cd'),
        score_digests=('ef',),
        policy_digest='01',
        labels_digest='23',
        kept_labels_digest='45',
        previous='67',
    ),
    StepRewards: StepRewards(
        run_id='r',
        phase=1,
        version=2,
        part=0,
        parts=1,
        source='sim',
        episodes=np.array([1, 2], np.uint32),
        first_steps=np.array([0, 7], np.uint32),
        lengths=np.array([2, 3], np.uint32),
        labels=ODD,
        commit='89',
    ),
    EpisodeResult: EpisodeResult(
        run_id='r',
        source='sim',
        purpose='random',
        step=1,
        version=-1,
        episode=2,
        length=3,
        true_return=0.1,
        composite_return=0.2,
        score=0.3,
        terminated=True,
    ),
    TrueRewards: TrueRewards(
        run_id='r', source='sim', sequence=1, phase=2, episode=3, first_step=4, rewards=ODD
    ),
    Metrics: Metrics(
        run_id='r',
        role='reward',
        node='reward',
        phase=1,
        step=2,
        names=('x', 'y'),
        values=np.array([0.1, np.nan]),
    ),
}


def of_ros(record):
    """The message of a record as ROS decodes it."""
    return deserialize_message(
        definitions.encode(record, STAMP_NS), messages.message_type(type(record))
    )


def of_bytes(message):
    """The record in the bytes that ROS makes of a message."""
    kind = next(kind for kind in TOPICS if kind.__name__ == type(message).__name__)
    return definitions.decode(kind, bytes(serialize_message(message)))


@pytest.mark.parametrize('record_type', TOPICS, ids=lambda t: t.__name__)
def test_bytes_are_decoded_and_encoded_without_ros_as_ros_does(record_type):
    record = EXAMPLES[record_type]
    message = of_ros(record)
    assert message.stamp == STAMP
    assert same(of_bytes(message), record)
    raw = bytes(serialize_message(message))
    assert definitions.stamp_of(raw) == STAMP_NS
    # what ROS leaves between two fields is not the same every time
    assert len(raw) == len(definitions.encode(record, STAMP_NS))
    for field in fields(record):
        ours, theirs = getattr(record, field.name), getattr(message, field.name)
        if isinstance(ours, np.ndarray):
            assert ours.tobytes() == theirs.tobytes(), field.name
        elif isinstance(ours, (tuple, bytes)):
            assert list(ours) == list(theirs), field.name
        else:
            assert ours == theirs, field.name


def test_a_message_adds_a_stamp_its_sender_and_a_signature():
    for record_type in TOPICS:
        names = list(messages.message_type(record_type).get_fields_and_field_types())
        own = [f.name for f in fields(record_type)]
        assert names == ['stamp', *own, 'sender', 'signature']


def test_arrived_arrays_are_memory_of_our_own():
    raw = bytearray(definitions.encode(transitions()))
    record = definitions.decode(Transitions, raw)
    raw[:] = bytes(len(raw))
    assert same(record, transitions())
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
    message = of_ros(EXAMPLES[record_type])
    setattr(message, field, getattr(message, field)[:wrong])
    with pytest.raises(RecordError) as refused:
        of_bytes(message)
    assert said in str(refused.value)
    assert TOPICS[record_type] in str(refused.value)


def test_a_chunk_without_steps_is_refused_and_says_whose_it_is():
    message = of_ros(transitions())
    message.steps = 0
    with pytest.raises(RecordError, match="from 'sim'.*steps of at least 1"):
        of_bytes(message)


def test_a_number_that_does_not_fit_its_field_is_not_sent():
    with pytest.raises(RecordError, match='Transitions cannot be written'):
        definitions.encode(replace(transitions(), phase=-1))


def test_every_topic_has_a_quality_of_service_readers_and_writers():
    topics = set(TOPICS.values())
    assert set(qos.QUALITIES) == topics
    assert set(readers()) == set(WRITERS) == topics - {'presence'}


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
    reading = readers(settings.labels_steps)
    for role in settings.roles.keys() & wanted:
        topics = {TOPICS[kind] for kind in wanted[role]} - {'run'}
        assert topics == {t for t, roles in reading.items() if role in roles and t != 'run'}


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
