"""The page on which a person scores, with segments that wait on it."""

from contextlib import contextmanager

from codetr_ros.cores.scoring import Desk
from codetr_ros.pages.scoring import Points, ScoringPage
from codetr_ros.records import CompositeReward
from helpers.builders import run, score_request, tiny, transitions

SETTINGS = tiny(scorer='person')  # segments of 7 steps
DOT = 'data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=='


def a_desk(asked=4, scorer='ann'):
    desk = Desk(run(SETTINGS), SETTINGS, scorer)
    desk.receive(transitions(steps=70))
    firsts = [7 * n for n in (5, 2, 8, 1, 3, 0)[:asked]]
    desk.receive(score_request(firsts=firsts, length=7))
    return desk


def given(desk):
    return next(desk.work()) or []


@contextmanager
def served(desk, scale='1:5', frames=None):
    page = ScoringPage(desk, Points.of(scale), frames)
    with page.serve() as server:
        yield server, page


def judged(desk):
    return [(r.first_step, r.value) for r in given(desk) if isinstance(r, CompositeReward)]
