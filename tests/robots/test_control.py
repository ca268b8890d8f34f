"""What the robot is told, step by step, and what is recorded of it. The clock is virtual."""

import numpy as np
import pytest

from codetr_ros.config.cuts import Cuts
from codetr_ros.robots.control import NO_NEXT, TOO_LATE, Control
from codetr_ros.robots.guard import Guard, Hold
from codetr_ros.robots.live_scores import LiveScores
from codetr_ros.robots.reset import Resetting
from codetr_ros.robots.senses import Senses
from codetr_ros.robots.steplog import StepLog
from helpers.robots import joints, rules

ACTION = np.array([0.5, -0.5], np.float32)
COMMAND = [0.75, -1.0]
SAFE = [0.0, 0.0]


class Bench:
    """A control on a bench: it publishes joints at each step, unless told not to."""

    def __init__(self, live: dict | None = None, phase_steps: int = 100, **changes) -> None:
        mapping = rules(live, **changes)
        self.now = 0.0
        self.sent: list[list[float]] = []
        self.asked = 0
        self.records: list = []
        self.hold: Hold | None = None
        self.senses = Senses(mapping)
        self.guard = Guard(mapping.live, self.senses, 0.0)
        log = StepLog('run', 'arm', lambda phase: phase_steps)
        self.control = Control(
            mapping, self.senses, self.guard, self, log,
            lambda command: self.sent.append(command.tolist()),
            Resetting(mapping.live.reset, self.ask),
            LiveScores(mapping, 'run', 'arm', Cuts(5, 0), lambda: log.phase),
        )  # fmt: skip
        self.control.activate()

    def ask(self) -> None:
        self.asked += 1

    def withheld(self) -> Hold | None:
        return self.hold

    def act(self, observation, step):
        return ACTION

    def step(self, times: int = 1, seen: bool = True, late: float = 0.0, **measured) -> None:
        for _ in range(times):
            self.now += 0.1 + late
            if seen:
                self.senses.take('/joint_states', joints(self.now, **measured), self.now - 0.01)
            self.records += self.control.tick(self.now)

    @property
    def steps(self) -> int:
        return sum(record.steps for record in self.records)


def test_steps_of_an_episode_are_recorded_with_what_was_commanded():
    bench = Bench()
    bench.step(6)
    assert bench.sent == [COMMAND] * 6  # the next episode has begun
    (record,) = bench.records
    assert (record.steps, record.episode, record.truncated, record.terminated) == (5, 0, True, 0)
    assert record.observations[:, 0] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    assert record.actions.tolist() == [ACTION.tolist()] * 5


def test_what_is_recorded_is_the_command_after_the_limits():
    bench = Bench({'limits': {'change': 1.5}})  # 0.15 a step
    bench.step(6)
    assert bench.sent[:2] == [pytest.approx([0.15, -0.15]), pytest.approx([0.3, -0.3])]
    assert bench.records[0].actions[0] == pytest.approx([0.1, -0.075])
    assert bench.control.counts['commands changed by limit change'] == 6


POSITION = {'topic': '/joint_states', 'fields': ['position'], 'joints': ['a', 'b']}
BY_POSITION = {
    'command': {'type': 'std_msgs/msg/Float64MultiArray', 'kind': 'position', 'safe': 'hold'},
    'limits': {'change': 1.0, 'position': POSITION | {'low': -2.0, 'high': 2.0}},
}


def test_the_first_command_changes_no_faster_than_the_limit_from_where_the_robot_is():
    bench = Bench(BY_POSITION)
    bench.step()  # joint a is at 0.1, and the policy wants 0.75
    assert bench.sent == [pytest.approx([0.2, -0.1])]
    bench.step(2)
    bench.control.deactivate(bench.now)
    bench.now += 1.0  # somebody moves it meanwhile
    bench.control.activate()
    bench.step()
    assert bench.sent[-1] == pytest.approx([1.3, -0.1])  # joint a is at 1.4


def test_after_a_reset_in_which_it_moved_by_itself_a_robot_starts_from_where_it_is():
    reset = {'by': 'service', 'service': '/reset'}
    bench = Bench(BY_POSITION | {'reset': reset, 'episode_steps': 2})
    bench.step()
    bench.control.reset.answered(True)
    bench.step(3)  # an episode, and the reset is asked for
    bench.now = 0.0  # joint a goes back to its start
    bench.senses.forget()
    bench.control.reset.answered(True)
    bench.step()
    assert bench.sent[-1] == pytest.approx([0.2, -0.1])


def test_what_a_policy_asks_for_is_no_command_where_it_is_no_number():
    bench = Bench()
    bench.step(3)
    bench.act = lambda observation, step: np.array([np.nan, 0.5], np.float32)
    bench.step()
    assert bench.sent[-1] == SAFE
    assert 'asks for [nan, 0.5], which is no action' in bench.control.held.why
    assert (bench.records[0].steps, bench.records[0].truncated) == (3, True)
    assert bench.control.counts['episodes cut by policy'] == 1
    del bench.act
    bench.step()
    assert bench.sent[-1] == COMMAND


def test_without_an_observation_the_safe_command_leaves_and_the_open_step_is_dropped():
    bench = Bench()
    bench.step(3)
    bench.step(3, seen=False)  # within max_age an old observation holds
    assert bench.sent[-2:] == [COMMAND, SAFE]
    assert bench.control.held is not None and bench.control.held.kind == 'observation'
    assert '/joint_states is 0.31 s old' in bench.control.held.why
    (record,) = bench.records
    assert (record.steps, record.truncated) == (4, True)
    assert bench.control.counts[NO_NEXT] == 1
    bench.step(2)
    assert bench.sent[-1] == COMMAND
    bench.step(6)
    assert [r.episode for r in bench.records] == [0, 1]


def test_a_stop_sends_the_safe_command_at_once_and_lasts_until_a_person_resumes():
    bench = Bench({'stop': {'topic': '/stop'}})
    bench.step(3)
    bench.guard.stop_message(True, bench.now)
    bench.control.halt()
    assert bench.sent[-1] == SAFE  # before the next step is due
    bench.step(2)
    assert bench.sent[-2:] == [SAFE, SAFE]
    assert (bench.records[0].steps, bench.records[0].truncated) == (2, True)
    assert 'still true' in bench.guard.resume()
    bench.guard.stop_message(False, bench.now)
    bench.step()
    assert bench.sent[-1] == SAFE  # releasing is not resuming
    assert bench.guard.resume() is None
    bench.step()
    assert bench.sent[-1] == COMMAND


def test_a_stop_topic_that_falls_silent_stops_the_robot():
    bench = Bench({'stop': {'topic': '/stop', 'age': 0.35}})
    bench.guard.stop_message(False, 0.0)
    bench.step(3)
    assert bench.sent[-1] == COMMAND
    bench.step()
    assert bench.sent[-1] == SAFE and bench.guard.stopped


def test_a_missing_heartbeat_holds_the_robot_until_it_is_there_again():
    bench = Bench({'watchdog': {'heartbeat': '/beat', 'heartbeat_age': 0.25, 'learner': 0.0}})
    bench.step(3)
    assert bench.sent == [COMMAND, COMMAND, SAFE]
    assert bench.records[0].steps == 2  # that of the last command is whole: it was observed
    bench.guard.heartbeat(bench.now)
    bench.step()
    assert bench.sent[-1] == COMMAND


def test_a_learner_that_falls_silent_holds_the_robot():
    bench = Bench({'watchdog': {'learner': 0.25}})
    bench.step(3)
    assert bench.control.held.why == 'the learner was silent for 0.3 s'


def test_a_robot_without_a_policy_gets_the_safe_command():
    bench = Bench()
    bench.hold = Hold('permission', 'none')
    bench.step(2)
    assert bench.sent == [SAFE, SAFE] and bench.records == []
    assert bench.control.counts['control steps held by permission'] == 2


def test_a_speed_beyond_its_limit_holds_the_robot_until_a_person_resumes():
    speed = {'topic': '/joint_states', 'fields': ['velocity'], 'joints': ['a', 'b'], 'most': 1.0}
    bench = Bench({'limits': {'speed': speed}})
    bench.step(2)
    bench.step(speed=1.5)
    assert bench.control.held.why == 'a moves at 1.5, its limit is 1'
    bench.step()
    assert bench.sent[-2:] == [SAFE, SAFE]
    assert bench.records[0].steps == 1  # what was measured too fast is no step to learn from
    bench.guard.resume()
    bench.step()
    assert bench.sent[-1] == COMMAND


def test_a_pause_ends_the_episode_with_its_last_whole_step():
    bench = Bench()
    bench.step(3)
    bench.guard.paused = True
    bench.step(2)
    assert bench.sent[-2:] == [SAFE, SAFE] and bench.records[0].steps == 3


def test_a_step_that_took_far_too_long_is_cut():
    bench = Bench()
    bench.step(3)
    bench.step(late=0.5)
    assert bench.records[0].steps == 2 and bench.control.counts[TOO_LATE] == 1
    assert bench.sent[-1] == COMMAND  # the next episode


def test_a_message_ends_the_episode_in_a_terminal_state_where_so_mapped():
    bench = Bench(episode={'topic': '/done', 'terminal': True})
    bench.step(3)
    bench.control.end_episode()
    bench.step()
    assert (bench.records[0].steps, bench.records[0].terminated) == (3, True)
    assert not bench.records[0].truncated


def test_the_robot_resets_itself_between_episodes_and_gets_no_command_meanwhile():
    bench = Bench({'reset': {'by': 'service', 'service': '/reset', 'seconds': 1.0, 'pause': 0.15}})
    bench.step(3)
    assert (bench.sent, bench.asked) == ([], 1)
    bench.step(9)
    assert bench.asked == 2  # no answer: it is asked again
    bench.control.reset.answered(False, 'stuck')
    bench.step()
    assert "whose last answer was 'stuck'" in bench.control.held.why
    bench.control.reset.answered(True)
    bench.step()
    assert bench.sent == [SAFE]  # it comes to rest
    bench.step(2)
    assert bench.sent[-1] == COMMAND


def test_a_late_answer_to_an_earlier_reset_begins_no_episode():
    reset = Resetting(rules({'reset': {'by': 'service', 'service': '/r'}}).live.reset, lambda: 0)
    reset.look(0.0)
    reset.begin()
    reset.answered(True)
    assert reset.look(0.1) is not None


def test_a_person_resets_the_robot_which_is_held_until_then():
    bench = Bench({'reset': {'by': 'person'}})
    bench.step(2)
    assert bench.sent == [SAFE, SAFE] and 'ready' in bench.control.held.why
    assert bench.control.reset.person_is_ready()
    assert not bench.control.reset.person_is_ready()
    bench.step()
    assert bench.sent[-1] == COMMAND


def test_deactivated_it_is_left_with_the_safe_command_and_gets_no_other():
    bench = Bench()
    bench.step(3)
    (last,) = bench.control.deactivate(bench.now)
    assert (last.steps, last.truncated, bench.sent[-1]) == (2, True, SAFE)
    before = len(bench.sent)
    bench.step(3)
    assert len(bench.sent) == before
    bench.control.activate()
    bench.step()
    assert bench.sent[-1] == COMMAND


def test_an_episode_of_which_no_step_became_whole_never_was():
    bench = Bench()
    bench.step()
    bench.step(3, seen=False)
    bench.step(6)
    assert bench.records[0].episode == 0
