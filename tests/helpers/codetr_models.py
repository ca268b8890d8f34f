"""Reward transformers of a few weights, and the segments that they learn from."""

from dataclasses import replace

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.seeding import generator
from codetr_ros.simulation.composite import composite
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

DELAY = 6
TOKENS = ('pair', 'merged')


def settings(**changes) -> Settings:
    """Small networks without dropout; `label='rhat'` sets codetr.label, `delay=4` the delay."""
    own = {'delay', 'target_scale', 'reward_unit', 'method', 'seed'}
    small = {
        # steps depend on each other from the start, so that what is seen where can be told
        'codetr__initialisation': 'lecun',
        'codetr__dropout': 0.0,
        'codetr__head_scale': 'inverse_sqrt',
        'codetr__layers': 2,
        'codetr__window': 10,
        'delay': DELAY,
    }
    named = {name if name in own else f'codetr__{name}': value for name, value in changes.items()}
    return builders.tiny(**small | named)


def memory(lengths=(20, 15), delay=DELAY, kind='sum', seed=0) -> Trajectories:
    """Episodes of these lengths, all segments scored; a step's reward depends on it alone."""
    rng = np.random.default_rng(seed)
    found = Trajectories(O, A, delay, 10_000, 1000)
    for episode, steps in enumerate(lengths):
        observations = rng.normal(2.0, 3.0, (steps + 1, O)).astype(np.float32)
        actions = rng.uniform(-1, 1, (steps, A)).astype(np.float32)
        rewards = np.tanh(observations[:-1, 0] - 2) + actions[:, 0].astype(np.float64)
        found.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=episode,
                phase=0,
                episode=episode,
                first_step=0,
                steps=steps,
                observations=observations,
                actions=actions,
                terminated=False,
                truncated=True,
                phase_end=False,
                scores_due=0,
            )
        )
        for first in range(0, steps, delay):
            part = rewards[first : first + delay]
            value = composite(kind, part.astype(np.float64), 3.0, delay)
            found.score(
                CompositeReward(
                    run_id='run',
                    source='sim',
                    scorer='sim',
                    sequence=first,
                    episode=episode,
                    first_step=first,
                    length=len(part),
                    value=value,
                )
            )
    return found


def model(data: Trajectories, steps: int = 3, **changes) -> Codetr:
    """A model that has taken a few gradient steps, so that nothing is 0 or symmetric any more."""
    made = Codetr(settings(**changes), O, A)
    made.prepare(data)
    for step in range(steps):
        made.gradient_step(data, generator(0, step))
    return made


def whole(data: Trajectories, context: int = 0) -> SegmentBatch:
    return data.segments.batch(data.segments.ids(), context)


def changed(batch: SegmentBatch, row: int, step: int) -> SegmentBatch:
    """The batch with another observation and action at one step."""
    observations, actions = batch.observations.copy(), batch.actions.copy()
    observations[row, step] += 1.0
    actions[row, step] -= 0.5
    return replace(batch, observations=observations, actions=actions)


def padded(batch: SegmentBatch, by: int, value: float = 0.0) -> SegmentBatch:
    wider = [(0, 0), (0, by), (0, 0)]
    return replace(
        batch,
        observations=np.pad(batch.observations, wider, constant_values=value),
        actions=np.pad(batch.actions, wider, constant_values=value),
    )
