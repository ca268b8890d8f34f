"""A made-up arm of two joints with what real ones have: inertia, latency, noise, faults.

No ROS in here: `stand_in.py` is the node, `make_bag.py` records a bag without any.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

TARGET = np.array([0.5, 1.2])  # [m]
FASTEST = np.array([1.5, 2.0])  # [rad/s] of shoulder and elbow
TURNS = 2.4  # [rad] to either side, where a joint meets its stop
TICK = 0.005  # [s] of the simulation


def hand(joints: np.ndarray) -> np.ndarray:
    """Where the hand of an arm with links of one metre is.

    Args:
        joints: (..., 2) shoulder and elbow [rad].
    """
    upper, fore = joints[..., 0], joints.sum(-1)
    return np.stack([np.cos(upper) + np.cos(fore), np.sin(upper) + np.sin(fore)], -1)


def nearness(joints: np.ndarray) -> np.ndarray:
    """How near the hand is to the target: 1 on it, 0.37 a metre away."""
    return np.exp(-np.linalg.norm(hand(joints) - TARGET, axis=-1))


@dataclass(frozen=True)
class Faults:
    """What goes wrong with an arm, drawn by a seed."""

    noise: float = 0.004  # [rad] of each measured position; five times as much of a speed
    latency: float = 0.02  # [s] from a command to the motor, at least
    jitter: float = 0.01  # [s] by which that varies, and when measurements are published
    dropped: float = 0.01  # share of the measurements and commands that get lost
    stuck: float = 0.02  # times a second that a joint sticks
    stuck_for: float = 0.4  # [s]

    @classmethod
    def none(cls) -> 'Faults':
        """Nothing goes wrong."""
        return cls(0, 0, 0, 0, 0, 0)


@dataclass
class Arm:
    """The arm.

    Args:
        seed: of its starts and faults.
        faults: what goes wrong.
    """

    seed: int = 0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        self._starts = np.random.default_rng([self.seed, 0])
        self._luck = np.random.default_rng([self.seed, 1])
        self.time = 0.0
        self.joints, self.speed = np.zeros(2), np.zeros(2)
        self._command = np.zeros(2)
        self._coming: deque[tuple[float, np.ndarray]] = deque()  # commands under way
        self._stuck = np.zeros(2)  # until when each joint sticks [s]
        self.log: list[dict[str, Any]] = []  # what went wrong, which nobody sees

    def _note(self, kind: str, **what: Any) -> None:
        self.log.append({'time': round(self.time, 3), 'fault': kind} | what)

    def reset(self) -> None:
        """Go to a start of its own choice, at rest."""
        self.joints = self._starts.uniform(-1.5, 1.5, 2)
        self.speed[:], self._command[:] = 0, 0
        self._coming.clear()

    def command(self, speeds: np.ndarray) -> None:
        """Take a command [rad/s], which reaches the motors later or never."""
        if self._luck.random() < self.faults.dropped:
            self._note('command dropped')
            return
        delay = self.faults.latency + self.faults.jitter * self._luck.random()
        wanted = np.clip(speeds, -FASTEST, FASTEST)
        self._coming.append((self.time + delay, wanted))

    def stop(self) -> None:
        """Stop the motors: no command has come for too long."""
        self._coming.clear()
        self._command[:] = 0

    def tick(self) -> None:
        """Let `TICK` seconds pass."""
        self.time += TICK
        while self._coming and self._coming[0][0] <= self.time:
            self._command = self._coming.popleft()[1]
        for joint in range(2):
            if self._luck.random() < self.faults.stuck * TICK:
                self._stuck[joint] = self.time + self.faults.stuck_for
                self._note('joint stuck', joint=joint, seconds=self.faults.stuck_for)
        self.speed += (self._command - self.speed) * TICK / 0.08
        self.speed[self._stuck > self.time] = 0
        self.joints = self.joints + self.speed * TICK
        beyond = np.abs(self.joints) > TURNS
        self.speed[beyond] = 0
        self.joints = np.clip(self.joints, -TURNS, TURNS)

    def measured(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Positions [rad] and speeds [rad/s] as measured; None where the message got lost."""
        if self._luck.random() < self.faults.dropped:
            self._note('measurement dropped')
            return None
        noise = self.faults.noise * self._luck.normal(size=(2, 2))
        return self.joints + noise[0], self.speed + 5 * noise[1]

    def pause(self) -> float:
        """Seconds by which the next measurement is late."""
        return float(self.faults.jitter * self._luck.random())


def taken(log: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The faults noted so far, each once."""
    while log:
        yield log.pop(0)
