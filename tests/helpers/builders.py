"""Records made by hand, for tests: small, valid, and easy to make wrong in one field."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from codetr_ros.config import Settings, load
from codetr_ros.records import (
    PROTOCOL_VERSION,
    Commit,
    CompositeReward,
    Policy,
    Presence,
    RunSpec,
    ScoreRequest,
    StepRewards,
    TaskSpec,
    Transitions,
)

OBSERVATION, ACTION = 3, 2


def tiny(**changes: Any) -> Settings:
    """Settings of a run that takes seconds: `codetr__layers=2` sets codetr.layers."""
    small = {
        'task': 'InvertedDoublePendulum-v5',
        'steps': 1200,
        'phase_steps': 200,
        'warmup_steps': 400,
        'delay': 7,
        'evaluate_every': 400,
        'evaluate_episodes': 2,
        'memory_steps': 900,
        'sac.hidden': (16, 16),
        'sac.batch': 16,
        'sac.burst': 30,
        'codetr.base': 'none',
        'codetr.layers': 1,
        'codetr.heads': 2,
        'codetr.embedding': 16,
        'codetr.batch': 8,
        'codetr.first_gradient_steps': 5,
        'codetr.gradient_steps': 2,
        'rrd.hidden': (16,),
        'rrd.subsequences': 4,
        'rrd.subsequence_steps': 5,
        'rrd.first_gradient_steps': 5,
        'rrd.gradient_steps': 2,
        'diaster.hidden': (16,),
        'diaster.width': 8,
        'diaster.batch': 8,
        'diaster.first_gradient_steps': 5,
        'diaster.gradient_steps': 2,
        'lrr.hidden': (16,),
        'lrr.batch': 8,
        'lrr.first_gradient_steps': 5,
        'lrr.gradient_steps': 2,
        'mil_lstm.hidden': (16, 8),
        'mil_lstm.head': (8,),
        'mil_lstm.batch': 8,
        'mil_lstm.first_gradient_steps': 5,
        'mil_lstm.gradient_steps': 2,
        'aggregate.hidden': (16,),
        'aggregate.batch': 8,
        'aggregate.first_gradient_steps': 5,
        'aggregate.gradient_steps': 2,
        'mlp.hidden': (16,),
        'mlp.batch': 8,
        'mlp.first_gradient_steps': 5,
        'mlp.gradient_steps': 2,
        'codetr.dropout': 0.1,  # so that equality covers the random masks too
    }
    return load('quick').changed(
        small | {name.replace('__', '.'): value for name, value in changes.items()}
    )


def run(settings: Settings | None = None, run_id: str = 'run') -> RunSpec:
    return (settings or tiny()).run_spec(run_id)


def task_spec(**changes: Any) -> TaskSpec:
    spec = TaskSpec(
        run_id='run',
        protocol_version=PROTOCOL_VERSION,
        source='sim',
        task='a task',
        observation_size=OBSERVATION,
        action_size=ACTION,
        horizon=1000,
        control_period=0.05,
        r_max=1.0,
    )
    return replace(spec, **changes)


def transitions(**changes: Any) -> Transitions:
    """Five steps of episode 0 unless changed; arrays fit `steps`."""
    steps = changes.get('steps', 5)
    rng = np.random.default_rng(0)
    chunk = Transitions(
        run_id='run',
        source='sim',
        sequence=0,
        phase=0,
        episode=0,
        first_step=0,
        steps=steps,
        observations=rng.normal(size=(steps + 1, OBSERVATION)).astype(np.float32),
        actions=rng.uniform(-1, 1, (steps, ACTION)).astype(np.float32),
        terminated=False,
        truncated=False,
        phase_end=False,
        scores_due=0,
    )
    return replace(chunk, **changes)


def score(**changes: Any) -> CompositeReward:
    return replace(
        CompositeReward(
            run_id='run',
            source='sim',
            scorer='sim',
            sequence=0,
            episode=0,
            first_step=0,
            length=7,
            value=1.5,
        ),
        **changes,
    )


def commit(**changes: Any) -> Commit:
    last = np.zeros(1, np.int64)
    return replace(
        Commit(
            run_id='run',
            phase=0,
            sources=('sim',),
            transitions=last,
            scorers=('sim',),
            scores=last - 1,
            dropped=(),
        ),
        **changes,
    )


def policy(**changes: Any) -> Policy:
    """Permission for phase 0: 200 random steps of 'sim'."""
    return replace(
        Policy(
            run_id='run',
            phase=0,
            version=-1,
            sources=('sim',),
            steps=np.array([200], np.uint32),
            random=True,
            network='',
            weights=b'',
        ),
        **changes,
    )


def presence(
    role: str = 'sim', published: Mapping[str, int] | None = None, **changes: Any
) -> Presence:
    """A node of a role that takes part and has published so much, by topic."""
    counts = published or {}
    made = Presence(
        run_id='run',
        role=role,
        node=f'/r/{role}',
        instance_id=role,
        settings_hash='hash',
        finished=False,
        topics=tuple(counts),
        published=np.array(list(counts.values()), np.uint64),
        missed=0,
    )
    return replace(made, **changes)


def step_rewards(**changes: Any) -> StepRewards:
    episode, first, length = (np.array([n], np.uint32) for n in (0, 0, 5))
    return replace(
        StepRewards(
            run_id='run',
            phase=0,
            version=1,
            part=0,
            parts=1,
            source='sim',
            episodes=episode,
            first_steps=first,
            lengths=length,
            labels=np.arange(5, dtype=np.float32),
        ),
        **changes,
    )


def follow(before: Transitions) -> np.ndarray:
    """Observations of five steps that begin where `before` ended."""
    observations = transitions().observations.copy()
    observations[0] = before.observations[-1]
    return observations


def same(a: Any, b: Any) -> bool:
    """Whether two records are equal in every bit."""
    if type(a) is not type(b):
        return False
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, np.ndarray):
            if x.dtype != y.dtype or x.shape != y.shape or x.tobytes() != y.tobytes():
                return False
        elif x != y:
            return False
    return True


def score_request(firsts=(0,), length=7, **changes: Any) -> ScoreRequest:
    """For segments of one episode of 'sim' that begin with these steps."""
    count = len(firsts)
    return replace(
        ScoreRequest(
            run_id='run',
            phase=0,
            sources=('sim',) * count,
            episodes=np.zeros(count, np.uint32),
            first_steps=np.array(firsts, np.uint32),
            lengths=np.full(count, length, np.uint32),
            worths=np.full(count, np.nan, np.float32),
        ),
        **changes,
    )
