"""A memory of scored segments for any reward method."""

import numpy as np
import torch

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, TrueRewards
from codetr_ros.rewards.base import RewardMethod
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

DELAY = 7
LENGTHS = (24, 14, 3)  # a short last segment, none, and an episode shorter than a segment


def filled(true_rewards: bool = True) -> Trajectories:
    memory = Trajectories(O, A, DELAY, 1000, 100, true_rewards)
    rng = np.random.default_rng(1)
    for episode, steps in enumerate(LENGTHS):
        observations = rng.normal(size=(steps + 1, O)).astype(np.float32)
        memory.append(
            builders.transitions(
                steps=steps,
                sequence=episode,
                episode=episode,
                observations=observations,
                truncated=True,
            )
        )
        step_rewards = rng.normal(2.0, 1.0, steps).astype(np.float32)
        if true_rewards:
            memory.append_true_rewards(
                TrueRewards(
                    run_id='run',
                    source='sim',
                    sequence=episode,
                    phase=0,
                    episode=episode,
                    first_step=0,
                    rewards=step_rewards,
                )
            )
        for first in range(0, steps, DELAY):
            part = step_rewards[first : first + DELAY]
            memory.score(
                CompositeReward(
                    run_id='run',
                    source='sim',
                    scorer='sim',
                    sequence=first,
                    episode=episode,
                    first_step=first,
                    length=len(part),
                    value=float(part.sum()),
                )
            )
    return memory


def batch_of(memory: Trajectories, method: RewardMethod) -> SegmentBatch:
    return memory.segments.batch(memory.segments.ids(), method.context)


def equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
