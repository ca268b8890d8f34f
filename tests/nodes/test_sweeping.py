"""The recorder asks all nodes at the same time, and takes what each keeps when that is whole."""

import logging

import pytest

from codetr_ros.bags.definitions import encode
from codetr_ros.nodes.asking import Answer
from codetr_ros.nodes.sweeping import Sweeper
from codetr_ros.records import Transitions
from helpers.builders import transitions


class Node:
    """A node that answers when the test lets it."""

    ready = True

    def __init__(self, service):
        self.service = service
        self.busy = False
        self.questions = []

    def ask(self, phase, answered, kinds=()):
        self.busy = True
        self.questions.append(answered)

    def answer(self, question):
        self.busy = False
        self.questions[question](Answer(0, '', [(Transitions, encode(transitions()))]))


@pytest.fixture
def asked():
    """A sweeper, the nodes by service, and what was taken."""
    nodes, taken = {}, []

    def make(service):
        return nodes.setdefault(service, Node(service))

    def take(kind, data):
        taken.append(kind)
        return True

    log = logging.getLogger()
    sweeper = Sweeper(make, lambda kind, data: False, take, log, lambda: 100.0)
    sweeper.ask(['/sim', '/learner'])
    sweeper.check()
    return sweeper, nodes['/sim/fetch_phase'], nodes['/learner/fetch_phase'], taken


def test_a_node_whose_answer_is_lost_keeps_no_other_waiting_and_is_asked_once_more(asked):
    sweeper, sim, learner, taken = asked
    learner.answer(0)
    assert len(taken) == 1
    sweeper.check()
    assert len(sim.questions) == 1  # it may still answer
    sim.busy = False  # it has not answered in time
    sweeper.check()
    assert (len(sim.questions), len(learner.questions)) == (2, 1)
    sim.answer(1)
    assert len(taken) == 2
    assert not sweeper.busy


def test_an_answer_that_comes_when_the_node_is_asked_once_more_is_passed_over(asked):
    sweeper, sim, learner, taken = asked
    sim.busy = False
    sweeper.check()
    sim.answer(0)
    assert taken == []
    sim.answer(1)
    learner.answer(0)
    assert len(taken) == 2
    assert not sweeper.busy


def test_a_node_that_is_away_is_asked_when_it_is_there_again(asked):
    sweeper, sim, _, taken = asked
    sim.busy = sim.ready = False
    sweeper.check()
    assert len(sim.questions) == 1 and sweeper.busy
    sim.ready = True
    sweeper.check()
    sim.answer(1)
    assert len(taken) == 1
