"""Signed answers of `fetch_phase` fit one request, and nothing of them can be changed."""

import numpy as np
import pytest
from codetr_msgs.srv import FetchPhase

from codetr_ros.ros.fetch import answer_signature

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
