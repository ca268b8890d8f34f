"""Turn ordinary topics into steps and scores, message by message, by a mapping.

Messages come in order of time, where `now` is the time of a message: when it was received (its log
time), or what its own header states. The rules of time:

* The last value received holds (zero-order hold), at most `max_age` seconds for observations.
* A step begins with each command, or at a fixed rate from an episode's first command on. Its
  observation and action are those that hold at its begin; its next observation is the one that
  holds at the begin of the next step.
* An episode ends at a message that matches the episode rule, where no command comes for `gap`
  seconds, where the clock goes back, and where a step has no observation that is young and
  finite: no step crosses a hole.
* The next observation of an episode's last step is the one that holds at the episode's end, or,
  if that is earlier, as long after the step's begin as the step before took. If nothing was
  observed in between, the step is dropped.
* `episode_scores` decides which steps a score is of.

Everything that is dropped is counted.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from codetr_ros.bags.reader import Message
from codetr_ros.offline.errors import FitError
from codetr_ros.records import F32, F64, MESSAGE_BYTES, CompositeReward, Transitions
from codetr_ros.robots.conversion import JOINTS_DOUBLED, Conversion
from codetr_ros.robots.doubled_joints import DoubledJoints
from codetr_ros.robots.episode_scores import EpisodeScores
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.message_fields import NS
from codetr_ros.robots.values import Values, names_a_joint_twice, numbers

NO_OBSERVATION = 'samples without an observation within max_age'
NOT_FINITE = 'samples that are not finite'
NO_NEXT = 'last steps of episodes without an observation after them'
CLIPPED = 'commands beyond low or high, clipped'
NO_JOINTS = 'messages without all of the joints'
JOINT_TWICE = 'messages that name one of the joints twice'
CLOCK_BACK = 'times that the clock went back, which ended the episode'


Timed = tuple[Transitions | CompositeReward, int]
"""A record and its time [ns]."""


@dataclass
class _Step:
    time: int
    observation: F64
    action: F64


class Converter:
    """Makes records of messages, one after the other.

    Args:
        rules: the mapping.
        run_id: of the records.
    """

    def __init__(self, rules: Mapping, run_id: str) -> None:
        self.conversion = Conversion()
        self._rules = rules
        self._run_id = run_id
        self._now = 0  # [ns] never goes back
        self._shift = 0  # [ns] by which it is ahead of the clock of the bag
        self._held: list[tuple[int, F64] | None] = [None] * len(rules.observation)
        self._seconds = 0  # [ns] that the last whole step took; 0 in an episode's first
        # the values that held `_seconds` after the pending step's begin, once that time has passed
        self._then: tuple[int, list[tuple[int, F64] | None]] | None = None
        self._command: tuple[int, F64] | None = None
        self._tick: int | None = None  # when the next step begins, at a fixed rate
        self._pending: _Step | None = None  # begun, without its next observation yet
        self._steps: list[_Step] = []  # whole and not yet written
        self._last: F64 = np.empty(0)  # the observation after them
        self._episode = -1
        self._open = False
        self._written = 0  # steps of the episode that were written
        self._cut: int | None = None  # when steps of an episode were lost last, as it went on
        self._score_topic = rules.score.topic if rules.score else None
        self._scores = EpisodeScores(rules, run_id, self.conversion)
        self._sequence = 0
        self._joints: dict[Values, DoubledJoints] = {}

    def feed(self, message: Message) -> Iterator[Timed]:
        """Take a message; yields the records that it completes.

        Messages come in order of time. An earlier one means that the clock went back.
        """
        if message.time + self._shift < self._now:
            yield from self._clock_back(message.time)
        self._now = message.time + self._shift
        self.conversion.messages[message.topic] += 1
        yield from self._until(self._now)
        self._scores.advance(self._now)
        self._look()
        for i, values in enumerate(self._rules.observation):
            if values.topic == message.topic:
                array = self._numbers(message, values)
                if array is not None:
                    self._held[i] = (self._now, array)
        if message.topic == self._rules.action.topic:
            array = self._numbers(message, self._rules.action)
            if array is not None:
                yield from self._commanded(array)
        if message.topic == self._score_topic:
            self._scores.take(message, self._now)
        if message.topic == self._rules.episode.topic and self._ends(message):
            yield from self._end(self._now, self._rules.episode.terminal)
            self._scores.name_episode(message)
            self._cut = None

    def finish(self) -> Iterator[Timed]:
        """End the last episode; yields its records."""
        yield from self._end_all()
        yield from self._give_scores()
        if jumps := sum(joints.count for joints in self._joints.values()):
            self.conversion.dropped[JOINTS_DOUBLED] += jumps

    def _end_all(self) -> Iterator[Timed]:
        """Do what is due by now, and end the episode."""
        yield from self._until(self._now + 1)
        yield from self._end(None)

    def _clock_back(self, time: int) -> Iterator[Timed]:
        """End the episode, and hold no value: the clock starts again, at an earlier time [ns]."""
        yield from self._end_all()
        self._held = [None] * len(self._held)
        self._then = self._cut = None
        self._shift = self._now + 1 - time
        self._scores.clock_back(self._shift)
        self.conversion.dropped[CLOCK_BACK] += 1

    def _give_scores(self) -> Iterator[Timed]:
        """Yield the scores that are still held: no more can come."""
        self._scores.advance(self._now + 1)
        for score in self._scores.finish():
            yield score, self._now - self._shift

    def _numbers(self, message: Message, values: Values) -> F64 | None:
        array = numbers(message.message, values)
        if array is not None and values.joints:
            self._joints.setdefault(values, DoubledJoints()).take(array)
        if array is None:
            twice = names_a_joint_twice(message.message, values)
            self.conversion.dropped[JOINT_TWICE if twice else NO_JOINTS] += 1
        return array

    def _ends(self, message: Message) -> bool:
        return self._rules.episode.ends(message.message)

    # ------------------------------------------------------------------------------------------
    # steps

    def _until(self, now: int) -> Iterator[Timed]:
        """Do what is due before `now` by time alone: steps at a fixed rate, and gaps."""
        gap = round(self._rules.episode.gap * NS)
        while self._command is not None:
            over = self._command[0] + gap
            if self._tick is not None and self._tick < now and self._tick <= over:
                yield from self._begin(self._tick, self._command[1])
                if self._tick is not None:
                    assert self._rules.sampling.rate is not None
                    self._tick += round(NS / self._rules.sampling.rate)
            elif over < now:
                yield from self._end(None)
            else:
                return

    def _commanded(self, values: F64) -> Iterator[Timed]:
        fresh = self._command is None
        self._command = (self._now, values)
        if self._rules.sampling.by == 'command':
            yield from self._begin(self._now, values)
        elif fresh or self._tick is None:
            self._tick = self._now

    def _look(self) -> None:
        """Keep the values that hold after a step's usual time, in case the step is the last."""
        if self._pending is not None and self._then is None and self._seconds:
            over = self._pending.time + self._seconds
            if self._now > over:
                self._then = (over, list(self._held))

    def _observed(self, now: int, held: list[tuple[int, F64] | None]) -> F64 | None:
        """The observation that holds now; None where a part is missing or too old."""
        oldest = now - round(self._rules.sampling.max_age * NS)
        parts = [one[1] for one in held if one is not None and one[0] >= oldest]
        return np.concatenate(parts) if len(parts) == len(held) else None

    def _begin(self, now: int, command: F64) -> Iterator[Timed]:
        """Begin a step."""
        observation = self._observed(now, self._held)
        if observation is None or not (_finite(observation) and _finite(command)):
            lost = NO_OBSERVATION if observation is None else NOT_FINITE
            self.conversion.dropped[lost] += 1
            if self._open or self._cut is not None:
                self._cut = now
            yield from self._end(now)
            return
        action = self._scaled(command)
        self._check_sizes(len(observation), len(action))
        if self._pending is not None:
            self._seconds = now - self._pending.time
            self.conversion.shortest = min(self.conversion.shortest, self._seconds / NS)
            self.conversion.longest = max(self.conversion.longest, self._seconds / NS)
            yield from self._complete(observation)
        elif not self._open:
            self._open = True
            self._episode += 1
            self._written = 0
            continues = self._cut is not None and now - self._cut <= self._rules.episode.gap * NS
            self._cut = None
            for score in self._scores.begin_episode(self._episode, now, continues):
                yield score, self._now - self._shift
        self._pending = _Step(now, observation, action)
        self._then = None
        self._scores.step_begun(now)

    def _complete(self, observation: F64) -> Iterator[Timed]:
        """Complete the pending step with its next observation."""
        assert self._pending is not None
        room = max(1, MESSAGE_BYTES // (4 * (len(observation) + len(self._pending.action))))
        if len(self._steps) >= room:
            yield from self._write(False, False)
        self._steps.append(self._pending)
        self._last = observation
        self._pending = None

    def _end(self, now: int | None, terminal: bool = False) -> Iterator[Timed]:
        """End the episode, if there is one.

        Args:
            now: when it ends [ns]; when its last step began, if None.
            terminal: whether its end is a terminal state.
        """
        pending, self._command, self._tick = self._pending, None, None
        if pending is not None:
            self._look()
            when, held = self._then or (self._now, self._held)
            seen = any(one is not None and one[0] > pending.time for one in held)
            after = self._observed(when, held) if seen else None
            if after is not None and _finite(after):
                yield from self._complete(after)
            else:
                self.conversion.dropped[NO_NEXT] += 1
                self._pending = None
                self._scores.step_dropped()
        if self._steps:
            self.conversion.episodes += 1
            yield from self._write(terminal, not terminal)
        elif self._open and not self._written:
            self._episode -= 1  # no step of it is left
        self._open = False
        self._seconds = 0
        self._scores.end_episode(now)

    def _scaled(self, command: F64) -> F64:
        low, high = np.asarray(self._rules.action.low), np.asarray(self._rules.action.high)
        for name, bound in (('low', low), ('high', high)):
            if bound.size not in (1, len(command)):
                raise FitError(
                    f'mapping: action.{name} has {bound.size} values, a command on '
                    f'{self._rules.action.topic} has {len(command)}'
                )
        scaled: F64 = 2 * (command - low) / (high - low) - 1
        if (np.abs(scaled) > 1 + 1e-9).any():
            self.conversion.dropped[CLIPPED] += 1
        return np.clip(scaled, -1, 1)

    def _check_sizes(self, observations: int, actions: int) -> None:
        sizes = (observations, actions)
        if self.conversion.sizes == (0, 0):
            self.conversion.sizes = sizes
        if self.conversion.sizes != sizes:
            raise FitError(
                f'observations and actions had the sizes {self.conversion.sizes}, and now '
                f'{sizes}: a field in the mapping has no fixed length. Name elements, or joints'
            )

    def _write(self, terminated: bool, truncated: bool) -> Iterator[Timed]:
        steps, self._steps = self._steps, []
        observations = [step.observation for step in steps] + [self._last]
        chunk = Transitions(
            run_id=self._run_id,
            source=self._rules.source,
            sequence=self._sequence,
            phase=0,
            episode=self._episode,
            first_step=self._written,
            steps=len(steps),
            observations=_f32(observations),
            actions=_f32([step.action for step in steps]),
            terminated=terminated,
            truncated=truncated,
            phase_end=False,
            scores_due=0,
        )
        self._sequence += 1
        self._written += len(steps)
        self.conversion.steps += len(steps)
        yield chunk, self._now - self._shift


def _finite(values: F64) -> bool:
    """Whether all values are finite in float32."""
    return bool((np.abs(values) <= np.finfo(np.float32).max).all())


def _f32(rows: list[F64]) -> F32:
    return np.asarray(rows, np.float64).astype(np.float32)
