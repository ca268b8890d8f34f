"""One control step after the other: observe, decide whether the robot may act, command, record.

No ROS and no clock in here: whoever owns the loop calls `tick` when a step is due.
"""

from collections import Counter
from collections.abc import Callable
from typing import Protocol

import numpy as np

from codetr_ros.records import F32, F64, Transitions
from codetr_ros.robots.guard import SPEED, STOP, Guard, Hold
from codetr_ros.robots.limits import Limiter
from codetr_ros.robots.live_scores import LiveScores
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.reset import Resetting
from codetr_ros.robots.senses import Senses
from codetr_ros.robots.steplog import StepLog

NO_NEXT = 'steps without an observation after them'
TOO_LATE = 'steps that were cut, as the next came too late'
POLICY = 'policy'


class Policy(Protocol):
    """What decides the actions of a robot."""

    def withheld(self) -> Hold | None:
        """Why it does not act now; None if it does."""

    def act(self, observation: F32, step: int) -> F32:
        """The action (A,) in [-1, 1] for an observation (O,) at a step of an episode."""


class Control:
    """Drives a robot, and records what it did.

    Args:
        rules: the mapping; its part `live` must be there.
        senses: what the robot observes.
        guard: decides whether it may be driven.
        policy: decides the actions.
        log: records the steps.
        send: sends a command (A,) to the robot.
        reset: lets the robot reset itself.
        scores: what the robot scores itself.
    """

    def __init__(
        self,
        rules: Mapping,
        senses: Senses,
        guard: Guard,
        policy: Policy,
        log: StepLog,
        send: Callable[[F64], None],
        reset: Resetting,
        scores: LiveScores,
    ) -> None:
        live = rules.live
        assert live is not None
        self._rules, self._live = rules, live
        self.senses, self.guard = senses, guard
        self.limiter = Limiter(rules)
        self._policy = policy
        self._log = log
        self._send_on = send
        self.reset = reset
        self.scores = scores
        self.active = False
        self.running = False  # an episode is under way
        self.held: Hold | None = None
        self._pending: tuple[F32, F32] | None = None  # observation and action of a begun step
        self._sent: F64 | None = (
            None  # the last command; None: the robot is at rest, for all one knows
        )
        self._tick_at: float | None = None
        self._over = False  # a message has ended the episode
        self.counts: Counter[str] = Counter()

    # ---- what others ask for

    def activate(self) -> None:
        """Drive the robot from the next step on."""
        self.active = True
        self._sent = None  # others may have moved it
        self.reset.begin()

    def deactivate(self, now: float) -> list[Transitions]:
        """Send the safe command once more, now [s], and then none; returns the last record."""
        self._drop_pending()
        records = self._end(now) if self.active else []
        if self.active:
            self._safe()
        self.active = False
        return records

    def stop(self, why: str) -> None:
        """Stop the robot at once, before the next step is due."""
        self.guard.stop(why)
        self.halt()

    def halt(self) -> None:
        """Send the safe command at once, and drop the step that was begun."""
        self._drop_pending()
        if self.active:
            self._safe()

    def _drop_pending(self, why: str = NO_NEXT) -> None:
        """Drop the step that was begun, if there is one."""
        if self._pending is not None:
            self._pending = None
            self.counts[why] += 1
            self.scores.step_dropped()

    def end_episode(self) -> None:
        """End the episode with the next step: a message has ended it."""
        self._over = self.running

    # ---- the loop

    def tick(self, now: float) -> list[Transitions]:
        """Take one control step, due now [s]; returns the records that are ready."""
        if not self.active:
            return []
        observation = self.senses.observe(now)
        self.held = self.guard.look(now)
        records = self._complete(observation, now)
        self.held = self.held or self._policy.withheld()
        if self.running and self._episode_ends():
            records += self._end(now, self._over and self._rules.episode.terminal)
        if not self.running:
            self._try_to_begin(now)
        if self.running and observation is not None:
            records += self._act(observation, now)
        self.scores.look(now)
        return records

    def _complete(self, observation: F32 | None, now: float) -> list[Transitions]:
        """Complete the step that was begun, with the observation after it."""
        late = self._tick_at is not None and (
            now - self._tick_at > self._live.watchdog.late * self._live.period
        )
        self._tick_at = now
        if self._pending is None:
            return []
        unsound = self.held is not None and self.held.kind in (STOP, SPEED)
        if observation is None or unsound or late:
            self._drop_pending(TOO_LATE if late else NO_NEXT)
            return self._end(now)
        pending, self._pending = self._pending, None
        records = self._log.add(*pending, observation, now)
        self.scores.step_whole(self._log.length, now)
        return records

    def _episode_ends(self) -> bool:
        full = self._log.length >= self._live.episode_steps
        return self._over or full or self.held is not None

    def _end(self, now: float, terminated: bool = False) -> list[Transitions]:
        """End the episode now [s], if there is one."""
        self._over = False
        if not self.running:
            return []
        self.running = False
        self.reset.begin()
        if self.held is not None:
            self.counts[f'episodes cut by {self.held.kind}'] += 1
        self.scores.end(now)
        records = self._log.end(terminated)
        self.counts['episodes'] += bool(records)
        return records

    def _try_to_begin(self, now: float) -> None:
        """Begin an episode if nothing holds the robot; else keep it safe."""
        if self.held is not None:
            self.counts[f'control steps held by {self.held.kind}'] += 1
            self._safe()
            return
        self.held = self.reset.look(now)
        if self.held is None:
            self._log.begin()
            self.scores.begin(self._log.episode, now)
            self.running = True
        elif self.reset.silent:
            self._sent = None  # it moves by itself
        else:
            self._safe()

    def _act(self, observation: F32, now: float) -> list[Transitions]:
        """Send what the policy asks for, within the limits; no limit holds what is no number."""
        wanted = self._policy.act(observation, self._log.length)
        if not np.isfinite(wanted).all():
            self.held = Hold(POLICY, f'the policy asks for {wanted.tolist()}, which is no action')
            self._safe()
            return self._end(now)
        positions = self.senses.positions()
        before = self.limiter.rest(positions) if self._sent is None else self._sent
        made = self.limiter.command(wanted, before, positions)
        for name in made.changed_by:
            self.counts[f'commands changed by limit {name}'] += 1
        self._send(made.command)
        self._pending = (observation, made.action)
        self.scores.step_begun(now)
        return []

    def _safe(self) -> None:
        command = self.limiter.safe(self.senses.positions())
        if command is not None:
            self._send(command)

    def _send(self, command: F64) -> None:
        self._sent = command
        self._send_on(command)
