"""Messages from anywhere are bounded where they enter, whatever they claim."""

from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.records import Presence, RecordError, metrics
from codetr_ros.records.bounds import LARGEST_COUNT, LONGEST_NAME, check_bounds
from codetr_ros.records.shown import LONGEST_SHOWN, shown, worth_a_line
from helpers.builders import (
    commit,
    policy,
    run,
    score,
    score_request,
    step_rewards,
    task_spec,
    transitions,
)

PRESENCE = Presence(
    run_id='run',
    role='sim',
    node='/r/sim',
    instance_id='x',
    settings_hash='',
    finished=False,
    topics=('task',),
    published=np.array([LARGEST_COUNT], np.uint64),
    missed=0,
)
METRICS = metrics('run', 'sim', 'sim', -1, 0, {'a': np.nan})
SOUND = [
    run(), task_spec(), transitions(), score(), commit(), policy(), step_rewards(), PRESENCE,
    METRICS,
]  # fmt: skip
LONG = 'n' * (LONGEST_NAME + 1)


@pytest.mark.parametrize('record', SOUND, ids=lambda record: type(record).__name__)
def test_what_nodes_publish_is_within_bounds(record):
    check_bounds(record)


@pytest.mark.parametrize(
    ('record', 'why'),
    [
        (replace(PRESENCE, published=np.array([2**64 - 1], np.uint64)),
         'Presence.published is 18446744073709551615: it must be numbers from 0 to'),
        (replace(PRESENCE, missed=2**63), 'Presence.missed is'),
        (replace(PRESENCE, topics=('rosout',)), "Presence.topics is 'rosout'"),
        (replace(PRESENCE, topics=('task', 'task')), 'names of which none comes twice'),
        (replace(PRESENCE, role='god'), "Presence.role is 'god': it must be one of sim"),
        (replace(PRESENCE, node='a\nFATAL: b'), r"Presence.node is 'a\nFATAL: b'"),
        (transitions(source=LONG), 'at most 255 characters, not 256'),
        (transitions(sequence=2**63), 'Transitions.sequence is'),
        (task_spec(observation_size=2**31), 'TaskSpec.observation_size is 2147483648: it must be '
         'from 1 to 100000'),
        (task_spec(action_size=0), 'TaskSpec.action_size is 0'),
        (task_spec(horizon=2**32 - 1), 'TaskSpec.horizon is 4294967295'),
        (task_spec(r_max=float('nan')), 'TaskSpec.r_max is nan'),
        (task_spec(control_period=-1.0), 'TaskSpec.control_period is -1.0'),
        (commit(transitions=np.array([-2])), 'Commit.transitions is -2'),
        (commit(scores=np.array([2**62])), 'Commit.scores is 4611686018427387904'),
        (policy(sources=tuple(map(str, range(10_001)))), 'at most 10000 names, not 10001'),
        (policy(network='n' * 70_000), 'at most 65536 characters, not 70000'),
        (replace(METRICS, role='x'), "Metrics.role is 'x'"),
        (replace(METRICS, step=2**60), 'Metrics.step is'),
    ],
)  # fmt: skip
def test_what_no_run_has_is_refused_naming_field_value_and_bound(record, why):
    with pytest.raises(RecordError) as refused:
        check_bounds(record)
    assert why in str(refused.value)
    assert len(str(refused.value)) < 500
    assert str(refused.value).isprintable()


def test_a_request_may_name_a_source_for_each_segment_and_a_node_may_wait_for_many():
    check_bounds(score_request(firsts=(0, 7, 14)))
    check_bounds(replace(PRESENCE, doing='waits for ' + 'a node; ' * 200))
    with pytest.raises(RecordError, match='Presence.doing is .* at most 4096 characters'):
        check_bounds(replace(PRESENCE, doing='x' * 4097))


def test_two_scorers_of_whom_a_commit_names_nothing_new_have_the_same_digest():
    check_bounds(commit(score_digests=('e3b0', 'e3b0'), scorers=('a', 'b')))


def test_what_is_shown_is_neither_endless_nor_able_to_forge_a_line():
    assert shown('Reacher-v5') == 'Reacher-v5'
    assert shown('ü\x1b[31m\nINFO') == r'ü\x1b[31m\nINFO'
    assert shown('x' * 10**6) == f'{"x" * LONGEST_SHOWN}... (1000000 characters)'


def test_of_many_refusals_the_log_has_the_first_ten_and_every_thousandth():
    assert [n for n in range(1, 3001) if worth_a_line(n)] == [*range(1, 11), 1000, 2000, 3000]
