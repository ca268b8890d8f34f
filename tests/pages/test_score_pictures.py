"""The pictures and curves on the page to score."""

import json
from http.client import HTTPConnection
from threading import Event

from codetr_ros.cores.camera import Pictures
from helpers.builders import commit, score_request
from helpers.http import ask
from helpers.score_page import DOT, a_desk, judged, served

PATIENCE = 120.0  # [s]


def test_a_segment_that_can_be_drawn_is_shown_in_pictures(tab):
    with served(a_desk(), frames=lambda segment: Pictures([DOT])) as (server, _):
        opened = tab(server.url)
        opened.get_by_alt_text('the robot, sim, episode 0, steps 35 to 41').wait_for()


def test_why_a_segment_has_no_pictures_stands_above_its_curves(tab):
    with served(a_desk(), frames=lambda segment: Pictures(note='it was <dark>')) as (server, _):
        opened = tab(server.url)
        opened.get_by_text('it was <dark>').wait_for()
        opened.locator('#one canvas').first.wait_for()


def test_what_somebody_looks_at_stays_though_the_run_asks_for_other_segments_by_now(tab):
    desk = a_desk(asked=1)
    with served(desk, frames=lambda segment: Pictures([DOT])) as (server, page):
        opened = tab(server.url)
        opened.get_by_alt_text('the robot, sim, episode 0, steps 35 to 41').wait_for()
        desk.receive(score_request(phase=1, firsts=[14, 56], length=7))
        page.tick()
        opened.get_by_text('2 wait').wait_for()
        opened.get_by_text('steps 35 to 41').first.wait_for()
        opened.keyboard.press('4')
        opened.get_by_text('Number 0: 4 for sim, episode 0, steps 35 to 41').wait_for()
        opened.get_by_alt_text('the robot, sim, episode 0, steps 14 to 20').wait_for()
        assert judged(desk) == [(35, 4.0)]


def asked_for_pictures(first):
    return {'segment': ['sim', 0, first, 7], 'frames': True}


class Slow:
    """Draws segments, none before it is let go."""

    def __init__(self):
        self.begun, self.going_on, self.drawn = Event(), Event(), []

    def __call__(self, segment):
        self.drawn.append(segment[2])
        self.begun.set()
        assert self.going_on.wait(PATIENCE)
        return Pictures([DOT])


def test_pictures_of_a_segment_that_was_judged_before_they_came_are_asked_for_no_more(tab):
    slow = Slow()
    with served(a_desk(), frames=slow) as (server, _):
        opened = tab(server.url)
        opened.locator('#one canvas').first.wait_for()  # pictures are asked for with them

        def given_up(sent):
            return sent.post_data_json == asked_for_pictures(35)

        with opened.expect_event('requestfailed', given_up):
            opened.keyboard.press('1')
        slow.going_on.set()
        opened.get_by_alt_text('the robot, sim, episode 0, steps 14 to 20').wait_for()


def test_pictures_that_nobody_waits_for_any_more_are_not_drawn():
    slow = Slow()

    def wait_for(port, first):
        connection = HTTPConnection('127.0.0.1', port, timeout=PATIENCE)
        sent = json.dumps(asked_for_pictures(first))
        connection.request('POST', '/segment', sent, {'Content-Type': 'application/json'})
        return connection

    with served(a_desk(), frames=slow) as (server, _):
        port = server.address.port
        first = wait_for(port, 35)
        assert slow.begun.wait(PATIENCE)
        wait_for(port, 14).close()
        last = wait_for(port, 56)
        for _ in range(3):  # by then the server has noticed who has gone
            assert ask(port, '/').status == 200
        slow.going_on.set()
        for connection in (first, last):
            assert json.loads(connection.getresponse().read()) == {'frames': [DOT], 'note': ''}
            connection.close()
    assert slow.drawn == [35, 56]


def test_curves_that_did_not_come_are_asked_for_again(tab):
    desk = a_desk(asked=0)
    with served(desk) as (server, page):
        opened = tab(server.url)
        opened.get_by_text('steps 63 to 69').wait_for()
        opened.locator('#one canvas').first.wait_for()
        opened.route('**/segment', lambda route: route.abort(), times=1)
        with opened.expect_response('**/segment') as answer:  # one that failed is none
            opened.keyboard.press('3')
            opened.get_by_text('Failed to fetch').wait_for()
            desk.receive(commit())
            page.tick()
        assert answer.value.ok
        opened.errors.clear()  # of the one that failed: it has come before the answer
