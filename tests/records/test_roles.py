"""The table of roles: who publishes what to whom."""

import sys

import pytest

from codetr_ros.cores.desks import Desks
from codetr_ros.cores.people import SimulatedPeople
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.scoring import Desk
from codetr_ros.records import ROLES, TOPICS, Presence
from codetr_ros.records.roles import (
    TABLE,
    WRITERS,
    command,
    needed,
    published_by,
    read_by,
    readers,
    subscribed,
)
from helpers.builders import tiny

FLOW = """
run                learner                                sim evaluate reward score desk record
task               sim                                    desk learner reward record
policy             learner                                sim evaluate record
transitions        sim                                    record reward learner score desk
composite_rewards  sim score desk                         record reward
preferences        score desk                             record reward
commits            record                                 reward learner score desk
step_rewards       reward                                 learner record
score_requests     reward                                 score desk record
episodes           sim evaluate                           record
true_rewards       sim                                    score record
metrics            sim evaluate reward learner record     record
"""
"""Topic, who publishes on it and who must read it, where a reward node labels steps."""


def split(line):
    """A line of FLOW: topic, publishers and readers."""
    return line[:19].strip(), set(line[19:58].split()), set(line[58:].split())


@pytest.mark.parametrize('line', FLOW.strip().splitlines(), ids=lambda line: line.split()[0])
def test_each_topic_has_its_publishers_and_its_readers(line):
    topic, publishing, reading = split(line)
    assert set(WRITERS[topic]) == publishing
    assert set(readers()[topic]) == reading
    assert {role for role in ROLES if topic in published_by(role)} == publishing


def test_where_nobody_labels_steps_the_learner_reads_the_scores_instead_of_labels():
    changed = {topic for topic in WRITERS if readers()[topic] != readers(labelled=False)[topic]}
    assert changed == {'composite_rewards', 'preferences', 'step_rewards'}
    assert 'learner' in readers(labelled=False)['composite_rewards']
    assert 'learner' not in readers(labelled=False)['step_rewards']


def test_nobody_who_learns_reads_true_rewards_or_results():
    for role in ('reward', 'learner'):
        for labelled in (True, False):
            topics = {TOPICS[kind] for kind in read_by(role, labelled)}
            assert not topics & {'true_rewards', 'episodes', 'metrics'}


def test_every_kind_of_record_is_published_and_read_by_somebody():
    kinds = set(TOPICS) - {Presence}  # everybody's
    assert {kind for role in TABLE.values() for kind in role.publishes} == kinds
    assert {kind for role in TABLE.values() for kind in role.reads} == kinds


def test_the_recorder_reads_what_decides_when_a_phase_is_whole():
    assert set(Recorder.subscribes) < set(subscribed('record'))


def test_simulated_people_read_what_others_wait_for_them_to_read():
    assert set(SimulatedPeople.subscribes) == set(subscribed('score'))


def test_a_desk_reads_what_is_said_that_it_reads_and_no_true_rewards():
    for core in (Desk, Desks):
        assert set(core.subscribes) == set(subscribed('desk'))
    assert not {'true_rewards', 'episodes'} & {TOPICS[kind] for kind in read_by('desk')}


def test_a_node_relies_only_on_roles_that_publish_what_it_reads():
    for role, row in TABLE.items():
        for other in row.relies_on:
            assert set(TABLE[other].publishes) & {*row.reads, *(row.reads_unlabelled or ())}, role


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({}, {'sim': 1, 'evaluate': 1, 'reward': 1, 'record': 1, 'learner': 1}),
        ({'simulators': 3}, {'sim': 3, 'evaluate': 1, 'reward': 1, 'record': 1, 'learner': 1}),
        ({'evaluate_every': 0}, {'sim': 1, 'reward': 1, 'record': 1, 'learner': 1}),
        ({'method': 'hc'}, {'sim': 1, 'evaluate': 1, 'record': 1, 'learner': 1}),
        (
            {'scorer': 'simulated'},
            {'sim': 1, 'evaluate': 1, 'reward': 1, 'score': 1, 'record': 1, 'learner': 1},
        ),
        # the loop goes on without a person
        (
            {'scorer': 'person'},
            {'sim': 1, 'evaluate': 1, 'reward': 1, 'record': 1, 'learner': 1},
        ),
    ],
    ids=['all', 'several simulators', 'no evaluation', 'no labels', 'simulated people', 'person'],
)
def test_a_run_needs_the_roles_that_its_settings_ask_for_and_starts_the_learner_last(
    changes, expected
):
    assert list(needed(tiny(**changes)).items()) == list(expected.items())


def test_what_starts_a_node_is_a_command_that_can_be_typed(tmp_path, monkeypatch):
    monkeypatch.setenv('PATH', str(tmp_path))
    assert command('evaluate') == f'{sys.prefix}/lib/sim_node/evaluate'
    (tmp_path / 'ros2').touch(0o755)
    assert command('evaluate') == 'ros2 run sim_node evaluate'
    assert command('record') == 'ros2 run codetr_ros record'
