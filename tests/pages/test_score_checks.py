"""What the page to score sends is checked like a message."""

import json

import pytest

from codetr_ros.cores.scoring import ScoringError
from codetr_ros.pages.address import PageError
from codetr_ros.pages.scoring import Points
from helpers.builders import commit
from helpers.http import ask
from helpers.score_page import SETTINGS, a_desk, given, served


@pytest.mark.parametrize(
    ('sent', 'reason'),
    [
        ([], 'no object'),
        ({'segment': ['sim', 0, 35, 7], 'value': 9}, 'not on your scale'),
        ({'segment': ['sim', 0, 35, 7], 'value': 2.5}, 'not on your scale'),
        ({'segment': ['sim', 0, 35, 7], 'value': '5'}, 'value is no number'),
        ({'segment': ['sim', 0, 35, 7], 'value': True}, 'value is no number'),
        ({'segment': ['sim', 0, 35, 7]}, 'value is missing'),
        ({'segment': ['sim', 0, 36, 7], 'value': 1}, 'no such segment'),
        ({'segment': ['sim', 5, 35, 7], 'value': 1}, 'no such segment'),
        ({'segment': ['sim', -1, 35, 7], 'value': 1}, '-1 is no number'),
        ({'segment': ['sim', 0, 35], 'value': 1}, 'must be [source'),
        ({'segment': ['x' * 300, 0, 35, 7], 'value': 1}, 'must be [source'),
        ({'segment': ['sim', 0, 35, 7], 'value': 1, 'run': 1}, 'unknown: run'),
        (
            {'segment': ['sim', 0, 35, 7], 'other': ['sim', 0, 35, 7], 'outcome': 1},
            'compared with itself',
        ),
        (
            {'segment': ['sim', 0, 35, 7], 'other': ['sim', 0, 14, 7], 'outcome': 0.3},
            'outcome 0.3',
        ),
    ],
    ids=range(14),
)
def test_what_cannot_be_a_judgement_is_refused_and_nothing_is_published(sent, reason):
    desk = a_desk()
    with served(desk) as (server, _):
        answer = ask(
            server.address.port,
            '/judge',
            {'Content-Type': 'application/json'},
            'POST',
            json.dumps(sent).encode(),
        )
    assert answer.status == 422
    assert reason in answer.text
    assert given(desk) == []


def test_nothing_is_taken_once_the_run_has_ended():
    desk = a_desk()
    desk.receive(commit(phase=SETTINGS.phases - 1))
    with pytest.raises(ScoringError, match='the run has ended'):
        desk.score(('sim', 0, 35, 7), 1)


@pytest.mark.parametrize('scale', ['1:2', '1:10', '5', '1:x', '9:1', ''])
def test_a_scale_has_three_to_nine_points_or_is_any_number(scale):
    with pytest.raises(PageError, match='is no scale: give the lowest'):
        Points.of(scale)
