"""A run on a robot at a free pace, in one process and in virtual time: the real cores, a robot of
two joints, a learner that takes as long as it likes, and scores that come late or never.
"""

from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.robot import Robot
from codetr_ros.records import CompositeReward, Policy, Record, Transitions
from helpers.builders import run, tiny
from helpers.robots import Clock, joints, rules


def settings(**changes: Any) -> Settings:
    small = {
        'task': 'robot/arm', 'pace': 'free', 'scorer': 'topic', 'evaluate_every': 0, 'steps': 400,
        'phase_steps': 40, 'warmup_steps': 80, 'delay': 5, 'method': 'evidence', 'requests': 0,
    }  # fmt: skip
    return tiny(**(small | changes))


class FreeRun:
    """The run, and every record in the order in which it was published.

    Args:
        seed: of how long learning takes, and of when scores come.
        slowest: control steps that the learner takes for a phase, at the most.
    """

    def __init__(self, made: Settings, seed: int, slowest: int) -> None:
        self.settings = made
        self._luck = np.random.default_rng(seed)
        self._slowest = slowest
        spec = run(made)
        self.clock = Clock()
        self.robot = Robot(spec, made, 'robot', rules({'episode_steps': 12}), self.clock)
        self.recorder = Recorder(spec, made, 'record')
        self.labeller = Labeller(spec, made, 'reward', None)
        self.learner = Learner(spec, made, 'learner', None)
        self.cores: list[Any] = [self.robot, self.recorder, self.labeller, self.learner]
        self._works = [core.work() for core in self.cores]
        self._busy = 0  # control steps until the learner looks at its messages again
        self.records: list[Record] = [spec]
        self._position = np.zeros(2)
        self._velocity = np.zeros(2)
        self._later: list[tuple[int, CompositeReward]] = []
        self._given = 0
        self._near: dict[int, list[float]] = {}
        self.tick = 0
        self.robot.driving.send = self._command

    def _command(self, command: np.ndarray) -> None:
        self._velocity = command

    def go(self) -> 'FreeRun':
        """Run to the end."""
        while not all(core.finished for core in self.cores):
            self.step()
            assert self.tick < 20_000, [core.waiting_for() for core in self.cores]
        return self

    def step(self) -> None:
        """Let a control step pass."""
        self.tick += 1
        self.clock.now += 0.1 + 1e-6
        self._position = 0.95 * (self._position + 0.1 * self._velocity)
        self.robot.senses.take('/joint_states', joints(*self._position), self.clock.now)
        if self.robot.senses.size and not self.robot.control.active:
            self.robot.driving.activate()
        self._publish(self._works[0])
        for due, score in [each for each in self._later if each[0] <= self.tick]:
            self._later.remove((due, score))
            self._tell(self._numbered(score))
        for work in self._works[1:3]:
            self._publish(work)
        if self._busy:
            self._busy -= 1
        else:
            self._publish(self._works[3])

    def _numbered(self, score: CompositeReward) -> CompositeReward:
        self._given += 1
        values = {name: getattr(score, name) for name in CompositeReward.__slots__}
        return CompositeReward(**(values | {'sequence': self._given - 1}))

    def _publish(self, work: Any) -> None:
        while (given := next(work)) is not None:
            for record in given:
                self._tell(record)

    def _tell(self, record: Record) -> None:
        self.records.append(record)
        for core in self.cores:
            if type(record) in core.subscribes:
                core.receive(record)
        if isinstance(record, Transitions):
            self._inspect(record)
        elif isinstance(record, Policy):
            self._busy = int(self._luck.integers(0, self._slowest + 1))

    def _inspect(self, chunk: Transitions) -> None:
        """Score segments that are over, late, one in five never."""
        near = self._near.setdefault(chunk.episode, [])
        before = len(near)
        near += np.exp(-np.abs(chunk.observations[1:, 0] - 0.8)).tolist()
        n, over = self.settings.longest, chunk.terminated or chunk.truncated
        for first in range(before - before % n, len(near), n):
            part = near[first : first + n]
            if (len(part) == n or over) and self._luck.random() < 0.8:
                self._later.append((self.tick + int(self._luck.integers(1, 90)), CompositeReward(
                    run_id='run', source='robot', scorer='inspection', sequence=0,
                    episode=chunk.episode, first_step=first, length=len(part), value=sum(part),
                )))  # fmt: skip


def free_run(seed: int = 0, slowest: int = 150, **changes: Any) -> FreeRun:
    """A run, done."""
    return FreeRun(settings(**changes), seed, slowest).go()
