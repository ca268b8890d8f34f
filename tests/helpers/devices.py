"""A memory D as a run fills it, and what must be true of what a device holds of it."""

import numpy as np
import pytest
import torch

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import StepRewards, Transitions

OBSERVATION, ACTION, DELAY = 5, 3, 4
needs_gpu = pytest.mark.skipif(
    not torch.cuda.is_available(), reason='torch finds no GPU here: device=cuda cannot be tried'
)


class Run:
    """Episodes and labels of one or more sources, made up as they are asked for."""

    def __init__(self, capacity: int = 1000, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.memory = Trajectories(OBSERVATION, ACTION, DELAY, capacity, 50)
        self._next: dict[str, tuple[int, int, np.ndarray]] = {}

    def steps(self, count: int, source: str = 'sim', end: str = '') -> None:
        """Steps that go on where the source's last ones ended."""
        first = self.rng.standard_normal(OBSERVATION).astype(np.float32)
        number, step, observation = self._next.get(source, (0, 0, first))
        observations = self.rng.standard_normal((count + 1, OBSERVATION)).astype(np.float32)
        observations[0] = observation
        actions = self.rng.uniform(-1, 1, (count, ACTION)).astype(np.float32)
        self.memory.append(
            Transitions(
                run_id='run',
                source=source,
                sequence=0,
                phase=0,
                episode=number,
                first_step=step,
                steps=count,
                observations=observations,
                actions=actions,
                terminated=end == 'terminated',
                truncated=end == 'truncated',
                phase_end=False,
                scores_due=0,
            )
        )
        self._next[source] = (
            (number + 1, 0, first) if end else (number, step + count, observations[-1])
        )

    def label(self, source: str, number: int, first: int, length: int) -> None:
        """New labels for steps of an episode."""
        labels = self.rng.standard_normal(length).astype(np.float32)
        self.memory.apply(
            StepRewards(
                run_id='run',
                phase=0,
                version=0,
                part=0,
                parts=1,
                source=source,
                episodes=np.array([number], np.uint32),
                first_steps=np.array([first], np.uint32),
                lengths=np.array([length], np.uint32),
                labels=labels,
            )
        )

    def filled(self, episodes: int = 6, length: int = 20) -> Trajectories:
        """The memory with some labelled episodes, every other one terminated."""
        for number in range(episodes):
            self.steps(length, end='terminated' if number % 2 else 'truncated')
            self.label('sim', number, 0, length)
        return self.memory
