"""Scores on a robot's own topic, live: which segment each is of. The clock is virtual."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from codetr_ros.config import SettingsError
from codetr_ros.cores.robot import Robot
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.robots import conversion, live_scores
from helpers.builders import policy, run, tiny
from helpers.robots import Clock, joints, rules

PERIOD = 0.1


def stamped(value: float, at: float) -> SimpleNamespace:
    """A message of a number and the time that it is of [s]."""
    stamp = SimpleNamespace(sec=int(at), nanosec=round(at % 1 * 1e9))
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), data=value)


class Bench:
    """A robot at a free pace whose episodes have ten steps, and a topic with scores.

    Args:
        score: the part `score` of the mapping, beside its topic.
        settings: other settings of the run.
        more: other parts of the mapping.
    """

    def __init__(self, score: dict[str, Any], more: dict | None = None, **settings: Any) -> None:
        small = {
            'task': 'robot/arm', 'evaluate_every': 0, 'delay': 5, 'phase_steps': 10,
            'scorer': 'topic', 'pace': 'free', 'steps': 1000, 'warmup_steps': 1000,
        }  # fmt: skip
        self.settings = tiny(**(small | settings))
        self.clock = Clock()
        made = rules({'episode_steps': 10}, **(more or {}), score={'topic': '/score', **score})
        self.robot = Robot(run(self.settings), self.settings, 'robot', made, self.clock)
        self.work = self.robot.work()
        self.records: list[Any] = []
        next(self.work)
        self.sense()
        next(self.work)
        self.robot.driving.activate()
        self.robot.receive(policy(sources=('robot',), steps=np.array([10], np.uint32)))

    def sense(self) -> None:
        self.robot.senses.take('/joint_states', joints(self.clock.now), self.clock.now)

    def step(self, times: int = 1) -> float:
        """Take control steps; a time within the last of them [s]."""
        for _ in range(times):
            self.clock.now += PERIOD + 1e-6
            self.sense()
            self.listen()
        return self.clock.now + PERIOD / 2

    def listen(self) -> None:
        while (given := next(self.work)) is not None:
            self.records += given

    def score(self, value: float, at: float | None = None) -> None:
        message = SimpleNamespace(data=value) if at is None else stamped(value, at)
        self.robot.driving.score_message('/score', message, self.clock.now + PERIOD / 2)
        self.listen()

    @property
    def scores(self) -> list[tuple[int, int, int, float]]:
        """Episode, first step, length and value of each score, in the order of their numbers."""
        given = [r for r in self.records if isinstance(r, CompositeReward)]
        assert [r.sequence for r in given] == list(range(len(given)))
        assert {(r.source, r.scorer) for r in given} <= {('robot', 'robot')}
        return [(r.episode, r.first_step, r.length, r.value) for r in given]

    def count(self, what: str) -> int:
        return self.robot.report().counters.get(what, 0)


def test_a_score_is_of_the_segment_whose_steps_it_follows():
    bench = Bench({'of': 'since_last'})
    bench.step(5)
    bench.score(1.5)
    assert bench.scores == []  # the fifth step is not whole before the sixth begins
    bench.step(5)
    assert bench.scores == [(0, 0, 5, 1.5)]
    bench.score(2.5)
    bench.step(1)
    assert bench.scores == [(0, 0, 5, 1.5), (0, 5, 5, 2.5)]


def test_a_score_that_comes_late_by_its_stamp_is_of_its_own_segment_and_joins_a_later_commit():
    bench = Bench({'of': 'window', 'seconds': 0.5, 'stamp': 'header.stamp', 'late': 60.0})
    after = bench.step(5)
    bench.step(27)
    bench.score(3.0, at=after)
    assert bench.scores == [(0, 0, 5, 3.0)]
    phases = [r.phase for r in bench.records if isinstance(r, Transitions)]
    assert max(phases) == 2  # the segment is of phase 0, which is long over
    assert bench.count(live_scores.LATE) == 1


def test_headers_of_a_score_are_its_time_where_the_mapping_has_it_so():
    more = {'time': 'log'}
    bench = Bench({'of': 'last_steps', 'steps': 5, 'time': 'header'}, more)
    after = bench.step(5)
    bench.step(3)
    bench.score(3.0, at=after)
    assert bench.scores == [(0, 0, 5, 3.0)]


def test_segments_without_a_score_are_no_error_and_are_counted():
    bench = Bench({'of': 'since_last', 'late': 0.0})
    bench.step(5)
    bench.score(1.0)
    bench.step(40)
    assert bench.scores == [(0, 0, 5, 1.0)]
    assert bench.count(live_scores.GIVEN) == 1
    whole = sum(r.steps for r in bench.records if isinstance(r, Transitions)) // 5
    assert bench.count(live_scores.WITHOUT) in (whole - 1, whole)  # the newest step is kept back


def test_a_score_of_nearly_a_segment_is_taken_as_of_it_and_one_of_two_halves_is_dropped(caplog):
    bench = Bench({'of': 'last_steps', 'steps': 5})
    bench.step(6)
    bench.score(1.0)  # of steps 1 to 5
    bench.step(2)
    bench.score(2.0)  # of steps 3 to 7: two of the first segment, three of the second
    bench.step(4)
    assert bench.scores == [(0, 0, 5, 1.0)]
    assert bench.count(live_scores.INEXACT) == 1
    assert bench.count(conversion.SCORE_AGAIN) == 1


def test_a_score_of_no_one_segment_is_dropped_counted_and_logged_with_what_to_do(caplog):
    bench = Bench({'of': 'since_last'})
    bench.step(10)
    bench.score(1.0)  # of all ten steps
    bench.step(3)
    assert bench.scores == []
    assert bench.count(live_scores.NO_SEGMENT) == 1
    assert 'Let `delay` be as long as what a score is of' in caplog.text


def test_a_verdict_on_the_whole_attempt_before_is_corrected_by_a_second_one():
    bench = Bench({'of': 'last_episode', 'again': 'replace', 'late': 5.0}, delay='episode')
    bench.step(13)
    bench.score(-4.0)
    bench.step()  # which shows that the attempt under way goes on: the verdict is not of it
    bench.score(4.0)
    bench.step()
    assert bench.scores == [(0, 0, 10, -4.0), (0, 0, 10, 4.0)]
    assert bench.count(conversion.SCORE_REPLACED) == 1


def test_a_score_that_names_its_episode_is_of_it_however_many_have_begun():
    more = {'episode': {'topic': '/over', 'id': 'data'}}
    rule = {'of': 'episode', 'id': 'name', 'field': 'value', 'late': 2.5}
    bench = Bench(rule, more, delay='episode')
    for name in range(5):
        bench.step(7)
        bench.robot.driving.episode_message(SimpleNamespace(data=name))
        bench.step(1)
        if name == 1:
            message = SimpleNamespace(name=0, value=9.0)
            bench.robot.driving.score_message('/score', message, bench.clock.now)
    bench.step(20)
    assert bench.scores == [(0, 0, 7, 9.0)]


def test_scores_that_cannot_be_read_or_used_are_counted_and_given_to_nobody(caplog):
    bench = Bench({'of': 'since_last', 'field': 'value'})
    bench.step(5)
    bench.score(1.0)
    bench.robot.driving.score_message(
        '/score', SimpleNamespace(value=float('nan')), bench.clock.now
    )
    bench.step(10)
    assert bench.scores == []
    assert bench.count(live_scores.UNREADABLE) == 1
    assert bench.count(conversion.SCORE_NOT_FINITE) == 1
    assert "/score has no field 'value'" in caplog.text


@pytest.mark.parametrize(
    ('score', 'settings', 'said'),
    [
        ({}, {'scorer': 'simulator'}, 'start the learner with scorer:=topic'),
        ({'of': 'last_episode'}, {}, 'start the learner with delay:=episode'),
        ({'of': 'episode', 'id': 'a'}, {'delay': 'episode'}, 'score.id = a without score.late'),
    ],
)
def test_a_mapping_whose_scores_the_run_cannot_take_is_refused(score, settings, said):
    more = {'episode': {'topic': '/over', 'id': 'data'}}
    with pytest.raises(SettingsError, match=said):
        Bench(score, more, **settings)


def test_where_others_are_named_as_scorers_the_score_topic_is_left_alone():
    bench = Bench({}, scorers=('inspection',))
    assert bench.robot.driving.rules.score is None
    bench.step(30)
    assert bench.scores == []
