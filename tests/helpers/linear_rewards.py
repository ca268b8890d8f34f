"""Episodes whose step rewards are linear and of which only the sums of segments are told, and what
reward methods make of them.
"""

from collections.abc import Sequence

import numpy as np

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F64, CompositeReward
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import Learned
from codetr_ros.seeding import generator, seed_torch
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

DELAY = 8


def linear(observations: F64, actions: F64) -> F64:
    """The reward that is to be found again."""
    return 0.5 * observations[..., 0] - observations[..., 1] + 2 * actions[..., 0] + 1


def memory(
    lengths: Sequence[int] = (64,) * 8,
    delay: int = DELAY,
    seed: int = 0,
    into: Trajectories | None = None,
) -> Trajectories:
    """Episodes of which only the sums of linear step rewards over segments are told.

    They are added to `into`, where it is given.
    """
    rng = np.random.default_rng(seed)
    found = Trajectories(O, A, delay, 10_000, 1000) if into is None else into
    held = sum(len(source.episodes) for source in found.store.sources)
    for episode, steps in enumerate(lengths, held):
        chunk = builders.transitions(
            steps=steps,
            sequence=episode,
            episode=episode,
            observations=rng.normal(2.0, 3.0, (steps + 1, O)).astype(np.float32),
            actions=rng.uniform(-1, 1, (steps, A)).astype(np.float32),
            truncated=True,
        )
        found.append(chunk)
        rewards = linear(
            chunk.observations[:-1].astype(np.float64), chunk.actions.astype(np.float64)
        )
        for first in range(0, steps, delay):
            part = rewards[first : first + delay]
            found.score(
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
    return found


def trained(method: Learned, data: Trajectories, steps: int) -> Learned:
    method.prepare(data)
    for step in range(steps):
        seed_torch(0, step)
        method.gradient_step(data, generator(0, step))
    return method


def recovery(method: Learned, data: Trajectories) -> float:
    """Correlation of inferred and true rewards with each segment's mean removed."""
    batch = data.segments.batch(data.segments.ids(), method.context)
    inside = segment_steps(batch)
    true = linear(batch.observations[:, :-1].astype(np.float64), batch.actions.astype(np.float64))
    labels = method.label(batch).astype(np.float64)
    n = inside.sum(1, keepdims=True)
    centred = [(x - (x * inside).sum(1, keepdims=True) / n)[inside] for x in (labels, true)]
    return float(np.corrcoef(*centred)[0, 1])


def explained(method: Learned, data: Trajectories) -> float:
    """R^2 of the predicted composite rewards."""
    batch = data.segments.batch(data.segments.ids(), method.context)
    residual = method.predict(batch) - batch.values
    return float(1 - np.mean(residual**2) / np.var(batch.values))


def noise(segments: int = 64) -> Trajectories:
    """A memory whose scores have nothing to do with its steps: to be learnt by heart."""
    scores = np.random.default_rng(0).normal(size=segments)
    found = Trajectories(O, A, DELAY, 10_000, 1000)
    for episode, value in enumerate(scores.tolist()):
        rng = np.random.default_rng((1, episode))
        found.append(
            builders.transitions(
                steps=DELAY,
                sequence=episode,
                episode=episode,
                observations=rng.normal(size=(DELAY + 1, O)).astype(np.float32),
                actions=rng.uniform(-1, 1, (DELAY, A)).astype(np.float32),
                truncated=True,
            )
        )
        found.score(builders.score(episode=episode, length=DELAY, value=value))
    return found
