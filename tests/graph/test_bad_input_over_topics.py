"""What must not be taken in is refused by the nodes that get it, said and counted, and the run
ends as if it had never come.
"""

import re
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.config import Settings
from codetr_ros.policy.actor import Actor, weights_bytes
from codetr_ros.policy.network import describe_network
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Policy,
    Presence,
    Record,
    StepRewards,
)
from codetr_ros.records.digests import digest
from codetr_ros.records.roles import read_by
from helpers.builders import commit, policy, score, step_rewards, tiny, transitions
from helpers.holding import held
from helpers.nodes import Nodes, Witness, domain
from helpers.runs import finish, start, write

pytestmark = pytest.mark.slow  # all of them look at one run

OBSERVATION, ACTION = 9, 1  # of InvertedDoublePendulum-v5
STEPS = 3000
HELD = 4  # the phase that is not permitted before all that must be refused has come
LATER = 1_000_000  # a sequence number that the run never reaches


def chunk(**changes) -> Record:
    """Five steps as this task has them, with numbers that are not due."""
    fit = {
        'observations': np.zeros((6, OBSERVATION), np.float32),
        'actions': np.zeros((5, ACTION), np.float32),
    }
    return transitions(**({'sequence': LATER} | fit | changes))


def of_another_architecture(settings: Settings) -> Policy:
    """The last phase's policy, for a task with one number more."""
    hidden = settings.sac.hidden
    return policy(
        phase=settings.phases - 1,
        version=settings.phases - 1,
        random=False,
        network=describe_network(OBSERVATION + 1, ACTION, hidden),
        weights=weights_bytes(Actor(OBSERVATION + 1, ACTION, hidden)),
    )


MADE_UP = 'ab' * 32


def early_commits(newest: Commit) -> list[Commit]:
    """Commits of the phase under way: one that names nothing, and one that follows on the newest
    and differs from what will come.
    """
    names, numbers = (), np.empty(0, np.int64)
    empty = {'sources': names, 'transitions': numbers, 'scorers': names, 'scores': numbers}
    following = replace(
        newest,
        phase=newest.phase + 1,
        previous=digest(newest),
        transitions=newest.transitions + 1,
        transition_digests=(MADE_UP,),
    )
    return [commit(phase=newest.phase + 1, **empty), following]


def early_labels(newest: Commit) -> list[StepRewards]:
    """Labels, complete, of the newest phase and of that under way."""
    phases = newest.phase, newest.phase + 1
    return [step_rewards(phase=phase, commit=MADE_UP) for phase in phases]


def another_permission() -> Policy:
    """Permission for a phase that is over, for other steps than it had."""
    return policy(steps=np.array([100], np.uint32))


def bad_transitions() -> list[Record]:
    nan = np.zeros((6, OBSERVATION), np.float32)
    nan[2, 1] = np.nan
    return [
        chunk(observations=nan),
        chunk(run_id='another'),
        chunk(observations=np.zeros((6, OBSERVATION - 1), np.float32)),
        chunk(observations=np.zeros((7, OBSERVATION), np.float32)),
        chunk(),  # sound, but nothing between the last and this one ever came
        chunk(sequence=0),  # has come before
    ]


JUNK = {kind: bytes(range(7, 200)) for kind in TOPICS}
"""What is no message at all, on each topic."""


def bad_scores(known: CompositeReward) -> list[Record]:
    """Scores of a visitor, and of the simulator.

    Args:
        known: one that 'sim' has given.
    """
    visitor = {'scorer': 'visitor', 'value': 7.5}
    return [
        score(**visitor, sequence=0, episode=LATER),
        score(**visitor, sequence=1, first_step=3),
        replace(known, **visitor, sequence=2),  # of a segment that 'sim' has scored
        known,  # the very message of before
        score(value=np.nan),
        score(scorer='stranger'),
    ]


BETWEEN_PHASES = {'sim': 'permission', 'record': 'permission', 'reward': 'the commit'}
"""What nodes wait for while the learner permits no further phase."""


def waits_for(what: str, node: Presence | None) -> bool:
    """Whether a node has waited for so long that it has taken all that was on its way."""
    return node is not None and f'waits for {what}' in node.doing and node.waiting > 2


@dataclass
class Outcome:
    """What a run with an intruder left, and the digests of one without."""

    nodes: Nodes
    codes: dict[str, int | None]
    expected: dict[str, str]

    def refusals(self, node: str, topic: str) -> list[str]:
        """Why a node says that it refused messages of a topic."""
        return re.findall(rf"refused on '{topic}' \(number \d+\): (.*)", self.nodes.log(node))


@pytest.fixture(scope='module')
def outcome(tmp_path_factory):
    """A run that is held in the middle until everybody has got what an intruder sends."""
    folder = tmp_path_factory.mktemp('intruded')
    # an early segment is looked at again, however late the run is held
    settings = tiny(scorers=('visitor',), steps=STEPS, memory_steps=STEPS)
    alone = start(write(settings, folder / 'alone'), folder / 'alone', '--in-process')
    with (
        domain(),
        held(folder / 'held', HELD) as hold,
        Nodes(settings, folder / 'run') as nodes,
        Witness(nodes) as witness,
    ):
        nodes.start_before(witness)
        witness.until(lambda: witness.committed(HELD - 1) and witness.scores)
        # the simulator begins once it has found the evaluator, which may not have found it yet
        witness.until(lambda: 'everybody is there' in nodes.log('evaluate'))
        # the phase is committed, nobody is still at an earlier one, and no lie can be of it
        for name, what in BETWEEN_PHASES.items():
            witness.until(lambda n=name, what=what: waits_for(what, witness.presence.get(n)))
        witness.say(*bad_transitions())
        witness.say(*bad_scores(witness.scores[0]))
        witness.say(policy())  # the very policy of before
        witness.say(*early_commits(witness.commits[-1]))
        witness.say(*early_labels(witness.commits[-1]))
        witness.say(another_permission(), of_another_architecture(settings))
        witness.say_bytes(*JUNK.items())

        def refused(node, topic):
            return int(witness.counters.get(node, {}).get(f'refused {topic}', 0))

        witness.until(
            lambda: (
                refused('record', 'transitions') == 6
                and refused('reward', 'transitions') == 6
                and refused('learner', 'transitions') == 6
                and refused('record', 'composite_rewards') == 3
                and refused('reward', 'composite_rewards') == 2
                and refused('evaluate', 'policy') == 2
                and refused('sim', 'policy') == refused('record', 'policy') == 3
                and all(
                    refused(node, TOPICS[kind])
                    for node in nodes.names
                    for kind in (Presence, *read_by(nodes.role(node)))
                )
            )
        )
        hold.release()
        codes = nodes.wait()
        expected, _ = finish(alone, folder / 'alone')
        yield Outcome(nodes, codes, expected)


def test_the_run_ends_as_if_nobody_had_intruded(outcome):
    assert set(outcome.codes.values()) == {0}, outcome.codes
    learner, reward = outcome.nodes.report('learner'), outcome.nodes.report('reward')
    assert learner['policy_sha256'] == outcome.expected['policy_sha256']
    assert reward['reward_model_sha256'] == outcome.expected['reward_model_sha256']
    for name in outcome.nodes.names:
        assert outcome.nodes.report(name)['finished']
        assert 'Traceback' not in outcome.nodes.log(name)


@pytest.mark.parametrize('node', ['record', 'reward', 'learner'])
@pytest.mark.parametrize(
    'why',
    [
        'Transitions(source=sim, sequence=1000000, phase=0, episode=0, first_step=0, steps=5, '
        'terminated=False, truncated=False, phase_end=False, scores_due=0): '
        "observations[2, 1] is nan: all values must be finite; mend what 'sim' publishes",
        "is of run 'another', this is run 'run': stop the other run, or give each run a "
        'namespace of its own',
        'observations have shape (6, 8), (6, 9) expected of task InvertedDoublePendulum-v5 as '
        "'sim' announced it",
        "Transitions(sequence=1000000, phase=0) from 'sim': observations has length 63, expected "
        "a multiple of 6 for steps=5; mend what 'sim' publishes on 'transitions'",
    ],
    ids=['NaN', 'another run', 'another size', 'a length that disagrees'],
)
def test_wrong_transitions_are_refused_by_all_that_read_them(outcome, node, why):
    assert sum(why in said for said in outcome.refusals(node, 'transitions')) == 1


@pytest.mark.parametrize('node', ['record', 'reward', 'learner', 'sim', 'evaluate'])
def test_what_is_no_message_is_refused_by_all_that_read_its_topic(outcome, node):
    for kind in (Presence, *read_by(outcome.nodes.role(node))):
        why = f'{kind.__name__} cannot be decoded'
        assert sum(why in said for said in outcome.refusals(node, TOPICS[kind])) == 1, kind


def test_transitions_out_of_sequence_are_refused_by_all_that_read_them(outcome):
    assert re.search(
        r"sequence=1000000.* is out of sequence: \d+ is the next of 'sim'. What lies between "
        r"never arrived: restart 'sim'",
        outcome.refusals('record', 'transitions')[-2],
    )
    for node in ('reward', 'learner'):
        assert re.search(
            r'sequence=1000000.* is out of sequence: the permitted phases hold fewer than 400 '
            r"records, and \d+ is the next of 'sim' to be taken in",
            outcome.refusals(node, 'transitions')[-2],
        )


def test_what_arrives_again_is_counted_as_duplicated_and_dropped(outcome):
    for node in ('record', 'reward', 'learner'):
        said = outcome.nodes.report(node)['duplicated']
        # early commits may make a node fetch a phase, to compare what it has
        again = re.findall(r'(\d+) messages came again', outcome.nodes.log(node))
        fetched = sum(map(int, again))
        assert 1 <= said['transitions'] <= 1 + fetched, node
        own = int(node != 'learner')
        assert own <= said.get('composite_rewards', 0) <= own * (1 + fetched), node
    for node in ('sim', 'record'):
        assert outcome.nodes.report(node)['duplicated']['policy'] == 1, node


@pytest.mark.parametrize(
    'why',
    [
        'episode 1000000, first_step 0, length 7: no such episode is here',
        'episode 0, first_step 3, length 7: there is no such segment. Segments have 7 steps, '
        'start at multiples of 7',
        'the segment has its composite reward already; the first one is kept',
        'value is nan: a composite reward must be finite',
    ],
    ids=['no such episode', 'no such segment', 'scored already', 'NaN'],
)
def test_scores_that_fit_no_segment_are_refused_by_the_reward_node(outcome, why):
    said = [line for line in outcome.nodes.log('reward').splitlines() if why in line]
    assert len(said) == 1
    assert 'nan' in why or "composite reward 7.5 of 'visitor' for 'sim'" in said[0]


def test_a_policy_of_another_architecture_is_refused_naming_both(outcome):
    said = next(s for s in outcome.refusals('evaluate', 'policy') if 'architecture' in s)
    settings = tiny(steps=STEPS)
    last = settings.phases - 1
    assert f'Policy(phase={last}, version={last}' in said
    assert f'needs {describe_network(OBSERVATION, ACTION, settings.sac.hidden)}' in said
    assert (
        f'the policy is {describe_network(OBSERVATION + 1, ACTION, settings.sac.hidden)}' in said
    )


def test_a_phase_that_cannot_have_begun_is_refused(outcome):
    wanted = (
        r'phase 14 cannot have begun: (\d+) is the next to be finished, so that (\d+) is the last'
    )
    due = {}
    for node in ('sim', 'record'):
        (why,) = (s for s in outcome.refusals(node, 'policy') if 'cannot have begun' in s)
        due[node], last = map(int, re.search(wanted, why).groups())
        assert last == due[node] + 1
    assert due == {'sim': HELD, 'record': HELD}


def test_a_phase_that_is_permitted_again_otherwise_is_refused(outcome):
    (said,) = (s for s in outcome.refusals('sim', 'policy') if 'has run' in s)
    assert 'Policy(phase=0' in said and "'sim' has run phase=0 already" in said
    (said,) = (s for s in outcome.refusals('record', 'policy') if 'permits 100 steps' in s)
    assert 'phase 0 has 200: stop the second learner' in said


@pytest.mark.parametrize('node', ['reward', 'learner'])
def test_early_commits_are_refused_without_a_key_too(outcome, node):
    """A commit is compared with what it names, whoever publishes it."""
    log = outcome.nodes.log(node)
    assert 'names no sources, and every phase has steps' in log or (
        'is the newest that can have been permitted' in log
    )
    assert re.search(
        r'refused later \(number \d+\): Commit\(phase=\d+\) is not the one whose digests the '
        r'records have|is the newest that can have been permitted',
        log,
    )


def test_early_labels_are_refused_without_a_key_too(outcome):
    """They are made of no commit, and nobody knows the digest of a commit that is to come."""
    assert re.search('made of (no|the) commit', outcome.nodes.log('learner'))
    log = outcome.nodes.log('record')
    assert f'was made of the commit {MADE_UP!r}' in log
    assert 'is the next to be committed: stop what publishes them' in log


def test_every_refusal_is_counted_in_the_report_of_the_node(outcome):
    refused = {name: outcome.nodes.report(name)['refused'] for name in outcome.nodes.names}
    junk = {
        name: Counter({'presence': 1} | {TOPICS[kind]: 1 for kind in read_by(role)})
        for name, role in ((name, outcome.nodes.role(name)) for name in outcome.nodes.names)
    }
    # the record that a learner announces is read by all
    assert refused == {
        'sim': junk['sim'] + Counter({'policy': 2}),
        'evaluate': junk['evaluate'] + Counter({'policy': 1}),
        'reward': junk['reward']
        + Counter({'transitions': 5, 'composite_rewards': 4, 'commits': 2}),
        'learner': junk['learner']
        + Counter({'transitions': 5, 'run': 1, 'commits': 2, 'step_rewards': 2}),
        'record': junk['record']
        + Counter({'transitions': 5, 'composite_rewards': 2, 'policy': 2, 'step_rewards': 2}),
    }


def test_the_bag_has_nothing_that_was_refused(outcome):
    recorded = outcome.nodes.report('record')['recorded']
    published = [outcome.nodes.report(name)['published'] for name in outcome.nodes.names]
    for topic in ('transitions', 'policy', 'metrics', 'step_rewards', 'true_rewards', 'commits'):
        assert recorded[topic] == sum(each.get(topic, 0) for each in published), topic
