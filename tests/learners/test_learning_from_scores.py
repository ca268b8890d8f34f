"""That the learners of scores learn from them: a toy in which the best action is the observation,
and only the sum over four steps is scored.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from codetr_ros.config import Settings
from codetr_ros.learners.hc import HC
from codetr_ros.learners.lirpg import Lirpg
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.policy.acting import ActingPolicy
from helpers.builders import score, tiny, transitions

torch.set_num_threads(1)

DELAY = 4
Act = Callable[[np.ndarray, int], np.ndarray]


class Toy:
    """One endless episode; the reward of a step is -(action - observation)^2."""

    def __init__(self) -> None:
        self.memory = Trajectories(1, 1, DELAY, 10_000, 100)
        self.rng = np.random.default_rng(0)
        self.last = np.zeros(1, np.float32)
        self.steps = 0

    def play(self, act: Act, steps: int) -> float:
        """Take steps into the memory, with their scores; their mean reward."""
        observations = self.rng.uniform(-1, 1, (steps + 1, 1)).astype(np.float32)
        observations[0] = self.last
        actions = [act(o, t) for t, o in enumerate(observations[:-1], self.steps)]
        chunk = transitions(
            first_step=self.steps,
            steps=steps,
            observations=observations,
            actions=np.array(actions, np.float32),
        )
        self.memory.append(chunk)
        rewards = -((chunk.actions - observations[:-1]) ** 2)[:, 0].astype(np.float64)
        for i, value in enumerate(rewards.reshape(-1, DELAY).sum(1).tolist()):
            first = self.steps + i * DELAY
            self.memory.score(score(first_step=first, length=DELAY, value=value))
        self.last = observations[-1]
        self.steps += steps
        return float(rewards.mean())

    def at_random(self, observation: np.ndarray, step: int) -> np.ndarray:
        return self.rng.uniform(-1, 1, 1)


def off(act: Act) -> float:
    """Mean squared distance from the best action: 0.37 for the action 0."""
    observations = np.linspace(-1, 1, 21, dtype=np.float32)[:, None]
    return float(np.mean([(act(o, t) - o) ** 2 for t, o in enumerate(observations)]))


@pytest.mark.slow
@pytest.mark.parametrize('history', ['singleton', 'recurrent'])
def test_hc_finds_the_best_action_from_scores_of_random_ones(history: str) -> None:
    settings = tiny(
        method='hc',
        delay=DELAY,
        phase_steps=200,
        warmup_steps=200,
        hc__history=history,
        hc__width=16,
        sac__hidden=(32, 32),
        sac__batch=64,
        sac__discount=0.9,
        sac__initial_temperature=0.05,
        sac__target_entropy=-2.0,
    )
    hc, toy = HC(settings, 1, 1), Toy()
    toy.play(toy.at_random, 1000)
    for _ in hc.train(0, toy.memory):
        pass
    acting = ActingPolicy(hc.actor, DELAY)
    assert off(lambda o, t: acting.act(o, step=t)) < 0.2


def reward_of_lirpg(settings: Settings, phases: int) -> float:
    """Mean reward of the last phase, the first of which is random."""
    lirpg, toy = Lirpg(settings, 1, 1), Toy()
    for phase in range(phases):
        acting = ActingPolicy(lirpg.actor)

        def with_noise(observation: np.ndarray, _: int, acting: ActingPolicy = acting):
            return acting.act(observation, toy.rng.standard_normal(1, dtype=np.float32))

        reward = toy.play(with_noise if phase else toy.at_random, settings.phase_steps)
        for _ in lirpg.train(phase, toy.memory):
            pass
    return reward


@pytest.mark.slow
def test_lirpg_learns_a_reward_that_teaches_the_best_action() -> None:
    """The policy sees the intrinsic reward alone: left as it was made, it teaches something else.

    Random actions earn -0.67.
    """
    settings = tiny(
        method='lirpg',
        delay=DELAY,
        phase_steps=200,
        warmup_steps=200,
        steps=10_000,
        lirpg__hidden=(16, 16),
        lirpg__batch=50,
        lirpg__epochs=5,
        lirpg__discount=0.9,
        lirpg__trace_decay=0.9,
        lirpg__learning_rate=3e-3,
        lirpg__reward_learning_rate=1e-2,
    )
    assert reward_of_lirpg(settings, 11) > -0.3
    frozen = settings.changed({'lirpg.reward_learning_rate': 1e-9})
    assert reward_of_lirpg(frozen, 11) < -0.6
