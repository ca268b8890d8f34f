"""Signed answers of `fetch_phase` fit one request, and nothing of them can be changed."""

import time

import numpy as np
import pytest
import rclpy
from codetr_msgs.srv import FetchPhase

from codetr_ros.bags.definitions import decode
from codetr_ros.nodes.asking import NEWEST
from codetr_ros.nodes.outbox import Outbox
from codetr_ros.ros.fetch import Asker, answer_signature
from codetr_ros.ros.link import Link
from codetr_ros.ros.resend import serve_outbox
from helpers.builders import transitions

KEY, SERVICE = bytes(range(32)), '/r/fetch_phase'
REQUEST = {'run_id': 'run', 'phase': 3, 'kinds': ['a'], 'part': 1, 'nonce': np.ones(16, np.uint8)}
RESPONSE = {
    'found': True, 'reason': '', 'types': ['a'], 'lengths': [2], 'cdr': b'ab', 'phase': 3,
    'parts': 2,
}  # fmt: skip
OTHERS = {
    'run_id': 'other', 'phase': 4, 'kinds': ['a', 'b'], 'part': 2,
    'nonce': np.zeros(16, np.uint8), 'found': False, 'reason': 'why', 'types': ['b'],
    'lengths': [1], 'cdr': b'ba', 'parts': 3,
}  # fmt: skip


def signature(key=KEY, service=SERVICE, request=(), response=()):
    asked = FetchPhase.Request(**REQUEST | dict(request), requester='/r/learner')
    answered = FetchPhase.Response(**RESPONSE | dict(response))
    return answer_signature(key, service, asked, answered)


def test_an_answer_has_one_signature():
    assert signature() == signature()
    assert signature() != signature(key=bytes(32))
    assert signature() != signature(service='/r/sim/fetch_phase')


@pytest.mark.parametrize('name', REQUEST)
def test_an_answer_to_another_request_has_another(name):
    assert signature() != signature(request={name: OTHERS[name]})


@pytest.mark.parametrize('name', RESPONSE)
def test_an_answer_that_was_changed_has_another(name):
    assert signature() != signature(response={name: OTHERS[name]})


def test_every_field_but_the_name_for_logs_is_covered():
    asked = set(FetchPhase.Request.get_fields_and_field_types()) - {'requester'}
    answered = set(FetchPhase.Response.get_fields_and_field_types()) - {'signature'}
    assert (asked, answered) == (set(REQUEST), set(RESPONSE))


@pytest.fixture
def links(ros_domain):
    """Who asks, who has something to answer, and who has no key."""
    rclpy.init(args=['test', '--ros-args', '-r', '__ns:=/r'])
    made = [Link(name) for name in ('asker', 'sim', 'liar')]
    for link in made[:2]:
        link.key = KEY
    yield made
    for link in made:
        link.close()
    rclpy.try_shutdown()


def test_a_false_answer_is_refused_and_the_true_one_awaited(links):
    asker, sim, liar = links
    outbox, refused, answers, asked = Outbox(5, None), [], [], []
    outbox.keep(transitions(), stamp=1)
    asker.refuse = lambda what, error: refused.append(str(error))

    def lie(request, response):
        asked.append(request.phase)
        response.found, response.phase, response.parts = True, 7, 1
        return response

    liar.node.create_service(FetchPhase, 'sim/fetch_phase', lie)
    serve_outbox(sim, 'run', outbox)
    question = Asker(asker, '/r/sim/fetch_phase', 'run')
    asker.handle(0.05)
    end = time.monotonic() + 150.0
    while not refused and time.monotonic() < end:
        if question.ready and not question.busy:
            question.ask(NEWEST, answers.append)
        liar.handle(0.02)  # it answers first
        for link in (sim, asker):
            link.handle(0.02)
    while not answers and time.monotonic() < end:
        for link in links:
            link.handle(0.02)
    assert "an answer of '/r/sim/fetch_phase' to the question for phase" in refused[0]
    assert asked
    assert {answer.phase for answer in answers} == {0}
    (kind, data) = answers[-1].messages[0]
    assert decode(kind, data).observations.tobytes() == transitions().observations.tobytes()


def test_where_answers_take_long_that_to_the_same_question_of_before_will_do(links):
    asker, other, _ = links
    asker.key = None
    asked, forgotten, answers = [], [], []

    def answer(request, response):
        asked.append(request.phase)
        response.found, response.phase, response.parts = True, request.phase, 1
        if len(asked) in {3, 4}:
            response.found, response.reason = False, 'too late'
        return response

    other.node.create_service(FetchPhase, 'sim/fetch_phase', answer)
    question, end = Asker(asker, '/r/sim/fetch_phase', 'run'), time.monotonic() + 150.0
    while not question.ready and time.monotonic() < end:
        asker.handle(0.02)
    question.ask(7, forgotten.append)  # another question takes its place
    for taker in (forgotten, forgotten, answers):  # before anybody has answered
        question.ask(8, taker.append)
    while len(asked) < 4 or not answers:
        assert time.monotonic() < end
        for link in (other, asker):
            link.handle(0.02)
    assert asked == [7, 8, 8, 8]
    assert [(each.phase, each.reason) for each in answers] == [(8, '')]
    assert forgotten == []
