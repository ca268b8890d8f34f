"""A node asks for what it lacks: the learner or, for what is old, the recorder."""

from dataclasses import dataclass, field

import pytest

from codetr_ros.bags.definitions import encode
from codetr_ros.cores.core import Part
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.cores.simulator import Simulator
from codetr_ros.nodes.asking import SERVICE, Answer
from codetr_ros.nodes.catching_up import Fetcher
from codetr_ros.nodes.fetching import AFTER, AGAIN
from codetr_ros.nodes.peers import Peers
from codetr_ros.records import INITIAL_VERSION, Commit, Policy
from helpers.builders import commit, policy, presence, tiny


class Waits(Part):
    """A core that waits for the policy of a phase."""

    subscribes = (Policy,)
    unpermitted: int | None = 3


@dataclass
class Asked:
    """A node that answers at once."""

    service: str
    answer: Answer
    questions: list[int] = field(default_factory=list)
    ready: bool = True
    busy: bool = False

    def ask(self, phase, answered, kinds=()):
        assert kinds in (['codetr_msgs/msg/Policy'], ['codetr_msgs/msg/Commit'])
        self.questions.append(phase)
        answered(self.answer)


@pytest.fixture
def fetcher():
    """A fetcher, the nodes that it asks, what it takes, and its clock."""
    asked = {
        '/learner/fetch_phase': Asked('/learner/fetch_phase', Answer(None, 'it is not kept')),
        SERVICE: Asked(SERVICE, Answer(None, 'it is not committed')),
    }
    taken, now, peers = [], [0.0], Peers('sim')
    peers.note(presence('learner', node='/learner'), 0.0)
    made = Fetcher(
        asked.__getitem__,
        peers,
        lambda kind, data: taken.append(kind),
        Log(),
        phases=False,
        clock=lambda: now[0],
    )
    return made, asked, taken, now


class Log:
    def warning(self, message):
        pass

    info = warning


def sent():
    return Answer(3, '', [(Policy, encode(policy(phase=3)))])


def test_a_policy_that_stays_out_is_asked_of_the_learner_and_taken_if_it_was_lost(fetcher):
    made, asked, taken, now = fetcher
    learner = asked['/learner/fetch_phase']
    learner.answer = sent()
    for now[0], questions, policies in ((0.0, 0, 0), (AFTER, 1, 0), (AFTER + AGAIN, 2, 1)):
        made.check(Waits())
        assert (len(learner.questions), len(taken)) == (questions, policies)
    assert asked[SERVICE].questions == []


def test_a_policy_that_the_learner_keeps_no_more_is_asked_of_the_recorder(fetcher):
    made, asked, taken, now = fetcher
    asked[SERVICE].answer = sent()
    for now[0] in (0.0, AFTER):
        made.check(Waits())
    assert asked[SERVICE].questions == [3]
    assert taken == [Policy]


def test_what_is_answered_to_be_still_to_come_was_not_asked_for_in_vain(fetcher):
    made, asked, _, now = fetcher
    assert made.asked_for == {}
    made.check(Waits())
    assert made.asked_for == {'policy': 0.0}
    now[0] = AFTER
    made.check(Waits())  # neither the learner nor the recorder has it
    assert made.asked_for == {'policy': AFTER}
    asked['/learner/fetch_phase'].ready = False
    now[0] = AFTER + AGAIN
    made.check(Waits())
    assert made.asked_for == {'policy': AFTER}
    core = Waits()
    core.unpermitted = None
    made.check(core)
    assert made.asked_for == {}


def test_nobody_is_asked_by_a_core_that_waits_for_no_policy(fetcher):
    made, asked, _, now = fetcher
    core = Waits()
    core.unpermitted = None
    for now[0] in (0.0, AFTER, AFTER + AGAIN):
        made.check(core)
    assert not any(each.questions for each in asked.values())


def test_a_simulator_waits_for_the_next_phase_until_its_policy_has_come():
    settings = tiny()
    core = Simulator(settings.run_spec('run'), settings, 'sim')
    assert core.unpermitted == 0
    core.receive(policy(sources=('sim',)))
    assert core.unpermitted is None
    core.close()


def test_an_evaluator_waits_for_the_policy_with_the_next_version_to_be_evaluated():
    settings = tiny()
    core = Evaluator(settings.run_spec('run'), settings, 'evaluate')
    due = [INITIAL_VERSION, *(v for v in range(settings.phases) if settings.evaluated(v))]
    phases = [0, *(version + settings.lag for version in due[1:])]
    assert core.unpermitted == phases[0]
    core.receive(policy(phase=0, random=True, network='', weights=b''))
    assert core.unpermitted == phases[1]
    core.close()


class Behind(Part):
    """A core that takes phases in, of which it has the first five."""

    subscribes = (Commit,)
    missing: int | None = 5
    due = 5
    permitted = 7
    committed: int | None = None

    def catch_up(self, newest):
        self.committed = newest


@pytest.mark.parametrize('gone_by', [(), (5,), (6,)])
def test_a_phase_whose_commit_came_too_early_is_asked_for_at_once(fetcher, gone_by):
    """Else a node that is one commit behind stays so: the next comes too early as well."""
    made, asked, _, now = fetcher
    core = Behind()
    core.gone_by = gone_by
    asked[SERVICE].answer = Answer(5)
    made.check(core)
    assert asked[SERVICE].questions == ([5] if 5 in gone_by else [])
    now[0] = AFTER
    made.check(core)
    assert asked[SERVICE].questions == [5]


@pytest.mark.parametrize(('phase', 'behind'), [(4, 5), (6, 6), (7, 7), (8, 5)])
def test_a_commit_that_is_set_aside_is_one_more_that_the_node_is_behind(fetcher, phase, behind):
    made, *_ = fetcher
    core = Behind()
    made.behind = 5
    assert made.later(commit(phase=phase), core)
    assert made.behind == behind
    assert core.committed == (phase if phase in (6, 7) else None)
