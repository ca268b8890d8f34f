"""All that drives a robot by a policy, learning or not: senses, guard, control and deadlines under
one clock, and what people may ask for.

No ROS in here: a driver sets `send` and `ask_for_reset`, and hands over what the robot publishes.
"""

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from codetr_ros.config.cuts import Cuts
from codetr_ros.records import F64, Transitions
from codetr_ros.robots.control import Control, Policy
from codetr_ros.robots.deadlines import Deadlines
from codetr_ros.robots.errors import MessageError
from codetr_ros.robots.guard import Guard, Hold
from codetr_ros.robots.live_scores import LiveScores
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.reset import Resetting
from codetr_ros.robots.senses import Senses
from codetr_ros.robots.steplog import StepLog

MISSED = 'control deadlines missed'
BACK = 0.1  # [s] by which a clock must go back to have been set back


class Driving:
    """Drives a robot: takes each control step when it is due by the clock.

    Attributes:
        send: sends a command (A,) to the robot; set by its driver.
        ask_for_reset: asks the robot to reset itself; set by its driver.
        clock: seconds, never going back.

    Args:
        rules: the mapping; its part `live` must be there.
        policy: decides the actions.
        log: records the steps.
        clock: seconds, never going back.
        scores: makes records of the robot's own scores; None: nobody wants them.
    """

    def __init__(
        self,
        rules: Mapping,
        policy: Policy,
        log: StepLog,
        clock: Callable[[], float] = time.monotonic,
        scores: LiveScores | None = None,
    ) -> None:
        live = rules.live
        assert live is not None
        self.rules = rules = rules if scores else rules.model_copy(update={'score': None})
        self.scores = scores or LiveScores(rules, '', '', Cuts(1, 0), lambda: 0)
        self.clock = clock
        self.send: Callable[[F64], None] = lambda command: None
        self.ask_for_reset: Callable[[], None] = lambda: None
        self.deadlines = Deadlines(live.period)
        self.senses = Senses(rules)
        self.guard = Guard(live, self.senses, clock())
        reset = Resetting(live.reset, self._ask)
        self.control = Control(
            rules, self.senses, self.guard, policy, log, self._command, reset, self.scores
        )
        self._clock_at = clock()
        self._out: list[Transitions] = []  # made between two steps
        self._counters: Counter[str] = Counter()

    def _command(self, command: F64) -> None:
        self.send(command)  # the driver comes later

    def _ask(self) -> None:
        self.ask_for_reset()

    # ---- the loop

    def begin(self) -> None:
        """Let the first step be due now, if it was activated before anything was observed."""
        if self.control.active:
            self.deadlines.start(self.clock())

    def step(self) -> list[Transitions]:
        """Take the control step that is due, if one is; returns the records that are ready."""
        self._check_clock()
        given, self._out = self._out, []
        if self.deadlines.reached(self.clock()):
            given = given + self.control.tick(self.clock())
        return given

    @property
    def pause(self) -> float:
        """Seconds until the next control step is due."""
        return max(0.0, self.deadlines.due - self.clock())

    def use_clock(self, clock: Callable[[], float]) -> None:
        """Take the time from another clock [s]."""
        self.clock = clock
        self._restart(clock())

    def _restart(self, now: float) -> None:
        self._clock_at = now
        self.guard.restart(now)
        if self.control.active:
            self.deadlines.start(now)

    def _check_clock(self) -> None:
        """Hold nothing that lies in the future, where the clock was set back."""
        now = self.clock()
        if now < self._clock_at - BACK:
            self.senses.forget()
            self.control.halt()
            self._restart(now)
            self._counters['times that the clock went back'] += 1
        self._clock_at = max(now, self._clock_at)

    # ---- what people ask for

    def activate(self) -> None:
        """Drive the robot: the first control step is due now."""
        self.control.activate()
        self.deadlines.start(self.clock())

    def deactivate(self) -> list[Transitions]:
        """Send the safe command once more, then none; returns the last records."""
        given, self._out = self._out, []
        given = given + self.control.deactivate(self.clock())
        self.deadlines.stop()
        return given

    def leave_active(self) -> None:
        """The same between two steps: the next one returns the records."""
        self._out = self.deactivate()

    def stop(self, why: str) -> None:
        """Stop the robot at once, until a person lets it go on."""
        self.control.stop(why)

    def interrupt(self, kind: str, why: str) -> None:
        """Send the safe command at once, and end the episode with the next control step."""
        self.guard.interrupted = Hold(kind, why)
        self.control.halt()
        if self.control.active:
            self.control.held = self.guard.interrupted

    def stop_message(self, pressed: bool) -> None:
        """Take a message of the stop topic; true stops the robot at once."""
        new = pressed and not self.guard.stopped
        self.guard.stop_message(pressed, self.clock())
        if new:
            self.control.halt()

    def episode_message(self, message: Any) -> None:
        """Take a message of the episode topic, which ends the episode where the mapping has it."""
        try:
            ends = self.rules.episode.ends(message)
        except MessageError as error:
            self.senses.unreadable(error)
            return
        if ends:
            assert self.rules.episode.topic is not None
            self.control.end_episode()
            self.scores.end_message(self.rules.episode.topic, message)

    def score_message(self, topic: str, message: Any, now: float) -> None:
        """Take a message of the score topic, received now [s]."""
        self.scores.take(topic, message, now)

    def close(self) -> None:
        """Leave the robot with the safe command."""
        if self.control.active:
            self.control.halt()
            self.control.active = False

    # ---- reports

    def waiting_for(self) -> str:
        """What the robot waits for, for people."""
        if lacking := self.senses.lacking():
            fault = f' ({self.senses.fault})' if self.senses.fault else ''
            return f'the first message on {", ".join(lacking)}{fault}'
        if not self.control.active:
            return 'the service `activate`, which lets it move the robot'
        held = self.control.held
        return held.why if held is not None else 'the next control step'

    def counts(self) -> 'Counter[str]':
        """What was counted: steps, deadlines, what held the robot, and what was of no use."""
        counters = self.control.counts + self.senses.counts + self._counters
        whole = {name: round(value) for name, value in self.deadlines.metrics().items()}
        counters['control steps'] = whole['control_steps']
        counters[MISSED] = whole['deadlines_missed']
        counters['resets that failed'] = self.control.reset.failures
        return counters
