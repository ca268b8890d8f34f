"""The recorder asks one node after the other, and takes the answers of the one that it asks."""

import logging

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


def test_an_answer_that_comes_when_another_node_is_asked_is_passed_over():
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
    sim = nodes['/sim/fetch_phase']
    sim.busy = False  # it has not answered in time
    sweeper.check()
    learner = nodes['/learner/fetch_phase']
    sim.answer(0)
    assert taken == []
    learner.answer(0)
    assert len(taken) == 1
    sweeper.check()  # the node that had not answered is asked once more
    sim.answer(1)
    assert len(taken) == 2
    assert not sweeper.busy
