"""The robot's part of a run: which policy acts at which step, and when it waits."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from codetr_ros.config import SettingsError
from codetr_ros.cores.robot import Robot
from codetr_ros.learners import registry
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.policy.actor import weights_bytes
from codetr_ros.records import Metrics, Policy, RecordError, TaskSpec, Transitions
from helpers.builders import policy, run, tiny
from helpers.robots import Clock, joints, rules


class Bench:
    """A robot whose joints move with time, a step of the clock for each control step."""

    def __init__(self, live: dict[str, Any] | None = None, **changes: Any) -> None:
        self.settings = tiny(task='robot/arm', evaluate_every=0, delay=5, phase_steps=4, **changes)
        self.clock = Clock()
        self.robot = Robot(run(self.settings), self.settings, 'robot', rules(live), self.clock)
        self.sent: list[list[float]] = []
        self.robot.driving.send = lambda command: self.sent.append(command.tolist())
        self.work = self.robot.work()
        self.records: list[Any] = []
        assert next(self.work) is None
        self.sense()
        (self.spec,) = next(self.work)
        self.robot.driving.activate()

    def sense(self) -> None:
        self.robot.senses.take('/joint_states', joints(self.clock.now), self.clock.now)

    def step(self, times: int = 1) -> None:
        for _ in range(times):
            self.sense()
            while (given := next(self.work)) is not None:
                self.records += given
            self.clock.now += 0.1 + 1e-6  # rounding must not make it early

    def of(self, kind: type) -> list[Any]:
        return [record for record in self.records if isinstance(record, kind)]

    def permit(self, phase: int, seed: int | None = None, **changes: Any) -> Policy:
        """Permit a phase, at random or under the weights that a seed gives."""
        made = policy(
            sources=('robot',), steps=np.array([4], np.uint32), phase=phase, version=phase - 1,
            **changes,
        )  # fmt: skip
        if seed is not None:
            learner = registry.make(self.settings.changed({'seed': seed}), 4, 2)
            weights = weights_bytes(learner.actor)
            made = policy(
                sources=made.sources, steps=made.steps, phase=phase, version=made.version,
                random=False, network=learner.network, weights=weights,
            )  # fmt: skip
        self.robot.receive(made)
        return made


def test_it_announces_itself_once_every_topic_has_brought_something():
    spec = Bench().spec
    assert isinstance(spec, TaskSpec)
    assert (spec.source, spec.task, spec.horizon) == ('robot', 'robot/arm', 5)
    assert (spec.observation_size, spec.action_size, spec.control_period) == (4, 2, 0.1)


def test_it_takes_the_steps_of_a_permitted_phase_and_is_held_until_the_next():
    bench = Bench()
    bench.step(2)
    assert bench.sent == [[0.0, 0.0]] * 2
    bench.permit(0)
    bench.step(6)
    assert bench.sent[-1] == [0.0, 0.0]
    (record,) = bench.of(Transitions)
    assert (record.steps, record.phase, record.phase_end, record.truncated) == (4, 0, True, True)
    assert bench.robot.waiting_for() == 'no policy permits a step'
    bench.permit(1)
    bench.step(6)
    assert [r.phase for r in bench.of(Transitions)] == [0, 1]
    assert [r.phase for r in bench.of(Metrics)] == [0, 1]


def test_an_episode_crosses_a_phase_where_the_next_is_permitted_in_time():
    bench = Bench(overlap=True)
    bench.permit(0)
    bench.permit(1, seed=1)
    bench.step(7)
    first, second = bench.of(Transitions)[:2]
    assert (first.steps, first.phase_end, first.truncated) == (4, True, False)
    assert (second.episode, second.first_step, second.phase) == (0, 4, 1)
    assert bench.robot.versions == {-1: 4, 0: 3}  # a step is of the phase in which it began


def test_a_policy_that_arrives_is_used_from_the_next_control_step_on_and_never_within_one():
    bench = Bench(pace='free')
    old = bench.permit(1, seed=1)
    bench.step(2)
    before = list(bench.sent)
    bench.clock.now -= 0.05  # the command of this step has left, and the next is not due
    bench.permit(2, seed=2)
    assert next(bench.work) is None
    assert bench.sent == before
    assert bench.robot.versions == {old.version: 2}
    bench.clock.now += 0.05
    bench.step()
    assert bench.robot.versions == {old.version: 2, old.version + 1: 1}


def test_a_free_robot_goes_on_under_its_newest_policy_up_to_eight_phases_ahead():
    bench = Bench(pace='free')
    bench.permit(0)
    bench.step(4 * 8 + 10)
    assert max(r.phase for r in bench.of(Transitions)) == 7
    assert 'the learner is 8 phases behind' in bench.robot.waiting_for()
    assert bench.sent[-1] == [0.0, 0.0]
    bench.permit(1)
    bench.step(5)
    assert max(r.phase for r in bench.of(Transitions)) == 8


def test_an_older_policy_that_comes_late_replaces_no_newer_one():
    bench = Bench(pace='free')
    bench.permit(2, seed=2)
    bench.permit(1, seed=1)
    bench.step()
    assert bench.robot.versions == {1: 1}
    assert bench.robot.report().duplicated == {'policy': 1}


def test_it_ends_when_all_steps_are_taken_and_nothing_more_is_permitted():
    bench = Bench(pace='free', steps=8, warmup_steps=8)
    bench.permit(0)
    bench.step(12)
    assert sum(r.steps for r in bench.of(Transitions)) == 8
    assert bench.robot.waiting_for() == 'all steps of the run are taken'
    bench.robot.receive(policy(sources=('robot',), steps=np.array([0], np.uint32), phase=2))
    bench.step()
    assert bench.robot.finished and bench.sent[-1] == [0.0, 0.0]


def test_it_awaits_the_policy_without_which_it_takes_no_further_step():
    bench = Bench(steps=8, warmup_steps=8)
    assert bench.robot.unpermitted == 0
    bench.permit(0)
    assert bench.robot.unpermitted is None
    bench.step(6)
    assert bench.robot.unpermitted == 1
    bench.permit(1)
    bench.step(6)
    assert bench.robot.unpermitted == bench.settings.phases == 2  # which permits nothing more
    bench.robot.receive(policy(sources=('robot',), steps=np.array([0], np.uint32), phase=2))
    assert bench.robot.unpermitted is None


def test_at_its_free_pace_it_awaits_a_newer_policy_only_when_it_is_held_without():
    bench = Bench(pace='free')
    assert bench.robot.unpermitted == 0
    bench.permit(3)  # of those before none is needed any more
    bench.step(4)
    assert bench.robot.unpermitted is None
    bench.step(4 * 11 + 10)
    assert 'the learner is 8 phases behind' in bench.robot.waiting_for()
    assert bench.robot.unpermitted == 4


def test_what_is_recorded_is_what_was_sent():
    bench = Bench({'limits': {'change': 5.0}}, pace='free')
    bench.permit(0)
    bench.step(40)
    actions = np.concatenate([r.actions for r in bench.of(Transitions)])
    sent = np.array(bench.sent)[: len(actions)]
    np.testing.assert_allclose(actions, sent / [1.5, 2.0], atol=1e-6)
    assert (np.abs(np.diff(sent, axis=0)) <= 0.5 + 1e-9).all()
    assert bench.robot.report().counters['commands changed by limit change'] > 0


def test_missed_deadlines_are_counted():
    bench = Bench(pace='free')
    bench.permit(0)
    bench.step(2)
    assert bench.robot.report().counters['control deadlines missed'] == 0, 'none is stated too'
    bench.clock.now += 0.25
    bench.step(8)
    assert bench.robot.report().counters['control deadlines missed'] == 2


def test_wrong_policies_are_refused():
    bench = Bench(pace='free')
    with pytest.raises(RecordError, match="names sources=\\['sim'\\], not 'robot'"):
        bench.robot.receive(policy())
    learner = registry.make(bench.settings, 5, 2)
    wrong = policy(
        sources=('robot',), random=False, network=learner.network,
        weights=weights_bytes(learner.actor),
    )  # fmt: skip
    with pytest.raises(RecordError, match="cannot act in task 'robot/arm'"):
        bench.robot.receive(wrong)


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'task': 'Reacher-v5'}, 'a robot node needs the task of a robot'),
        ({'delay': 6}, 'episodes of the robot have 5 steps'),
    ],
)
def test_a_run_that_is_none_of_a_robot_is_refused(changes, said):
    settings = tiny(**({'task': 'robot/arm', 'evaluate_every': 0} | changes))
    with pytest.raises(SettingsError, match=said):
        Robot(run(settings), settings, 'robot', rules(), Clock())


def test_a_clock_that_is_set_back_cuts_the_episode_and_control_goes_on():
    bench = Bench(pace='free')
    bench.permit(0)
    bench.step(3)
    bench.clock.now -= 50.0
    bench.step(8)
    first = bench.of(Transitions)[0]
    assert (first.steps, first.truncated) == (2, True)
    assert any(bench.sent[-1]) and bench.robot.control.held is None
    counters = bench.robot.report().counters
    assert counters['times that the clock went back'] == 1
    assert counters['control deadlines missed'] == 0


@pytest.mark.parametrize('given_out', [3, 4, 7])
def test_one_that_was_killed_goes_on_behind_what_was_recorded_in_an_episode_of_its_own(given_out):
    before = Bench({'episode_steps': 6}, pace='free')
    before.permit(0)
    while sum(r.steps for r in before.of(Transitions)) < given_out:
        before.step()
    recorded = before.of(Transitions)
    done = sum(r.steps for r in recorded)

    after = Bench({'episode_steps': 6}, pace='free')
    after.robot.restore(recorded)
    after.permit(done // 4)
    after.step(6)
    first = after.of(Transitions)[0]
    assert first.sequence == len(recorded)
    assert (first.episode, first.first_step) == (recorded[-1].episode + 1, 0)
    assert first.phase == done // 4
    memory = Trajectories(4, 2, delay=5, capacity=100, margin=20, cuts=after.settings.cuts)
    for record in (*recorded, *after.of(Transitions)):
        memory.append(record)
    ends = Counter()
    for record in (*recorded, *after.of(Transitions)):
        ends[record.phase] += record.steps
        assert record.phase_end == (ends[record.phase] == 4)
    assert after.robot.report().counters['times that the node was started again'] == 1


def test_one_that_was_killed_takes_a_policy_that_comes_before_the_first_observation():
    settings = Bench(pace='free').settings
    robot = Robot(run(settings), settings, 'robot', rules(), Clock())
    work = robot.work()
    assert next(work) is None
    newest = policy(sources=('robot',), steps=np.array([4], np.uint32), phase=3, version=2)
    robot.receive(newest)
    robot.senses.take('/joint_states', joints(), robot.driving.clock())
    next(work)
    robot.driving.activate()
    next(work)
    assert robot.versions == {2: 1}


def test_a_policy_that_a_learner_publishes_again_is_counted_and_another_refused():
    bench = Bench()
    bench.permit(0)
    bench.permit(0)
    assert bench.robot.report().duplicated == {'policy': 1}
    with pytest.raises(RecordError, match='each phase must be permitted once'):
        bench.permit(0, seed=3)
