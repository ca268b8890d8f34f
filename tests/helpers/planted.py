"""Episodes whose step rewards are known and of which any composite reward is told."""

from collections.abc import Callable

import numpy as np

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F64, CompositeReward, TrueRewards
from codetr_ros.rewards.base import RewardMethod, segment_steps
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

Reward = Callable[[F64, F64, F64], F64]
Score = Callable[[F64], float]


def progress(s: F64, a: F64, after: F64) -> F64:
    """How far the first component gets, less what the actions cost: as running tasks have it."""
    reward: F64 = 2 * (after[:, 0] - s[:, 0]) + 0.5 * s[:, 1] - 0.3 * (a * a).sum(1)
    return reward


def memory(
    reward: Reward,
    score: Score,
    delay: int = 10,
    segments: int = 200,
    seed: int = 0,
    noise: float = 0.0,
    irregular: bool = False,
    components: int = O,
    terminated: bool = False,
) -> Trajectories:
    """One episode of whole segments, the step rewards in it too.

    Args:
        reward: of steps, from s (m, O), a (m, A) and s'.
        score: of a segment's step rewards.
        delay: steps of a segment; the most of them where `irregular`.
        segments: how many.
        seed: of everything random.
        noise: deviation of what is added to each step's reward.
        irregular: lengths are drawn from half the delay on.
        components: of an observation, O.
        terminated: the episode ends in a terminal state.
    """
    rng = np.random.default_rng(seed)
    lengths = np.full(segments, delay)
    if irregular:
        lengths = rng.integers(max(1, delay // 2), delay + 1, segments)
    steps = int(lengths.sum())
    # components that wander slowly, as states do
    s = np.zeros((steps + 1, components))
    for t in range(1, steps + 1):
        s[t] = 0.9 * s[t - 1] + rng.normal(size=components) * 0.4
    observations = s.astype(np.float32)
    actions = rng.uniform(-1, 1, (steps, A)).astype(np.float32)
    wide = observations.astype(np.float64)
    rewards = reward(wide[:-1], actions.astype(np.float64), wide[1:])
    rewards = (rewards + noise * rng.normal(size=steps)).astype(np.float32)
    made = Trajectories(
        components, A, delay, steps + 1, 1000, true_rewards=True, regular=not irregular
    )
    made.append(
        builders.transitions(
            steps=steps,
            observations=observations,
            actions=actions,
            terminated=terminated,
            truncated=not terminated,
        )
    )
    made.append_true_rewards(
        TrueRewards(
            run_id='run',
            source='sim',
            sequence=0,
            phase=0,
            episode=0,
            first_step=0,
            rewards=rewards,
        )
    )
    first = 0
    for number, length in enumerate(lengths.tolist()):
        part = rewards[first : first + length].astype(np.float64)
        made.score(
            CompositeReward(
                run_id='run',
                source='sim',
                scorer='sim',
                sequence=number,
                episode=0,
                first_step=first,
                length=length,
                value=score(part),
            )
        )
        first += length
    return made


def within(method: RewardMethod, data: Trajectories) -> float:
    """Correlation of labels and true rewards, each segment's mean removed from both."""
    batch = data.segments.batch(data.segments.ids(), method.context)
    inside = segment_steps(batch)
    n = inside.sum(1, keepdims=True)
    assert batch.true_rewards is not None
    both = (method.label(batch).astype(np.float64), batch.true_rewards.astype(np.float64))
    centred = [(x - (x * inside).sum(1, keepdims=True) / n)[inside] for x in both]
    return float(np.corrcoef(*centred)[0, 1])
