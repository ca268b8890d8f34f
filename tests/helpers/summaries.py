"""A run and its summary, made by hand."""

from dataclasses import replace
from typing import Any

import numpy as np

from codetr_ros import config
from codetr_ros.config import Settings
from codetr_ros.records import Commit, EpisodeResult, Record, metrics
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.runs.summary import Summary

SETTINGS = config.load('quick').changed(
    {'steps': 2500, 'phase_steps': 1000, 'evaluate_every': 1000, 'evaluate_episodes': 2}
)


class Clock:
    """Time that passes when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def commit(phase: int) -> Commit:
    return Commit(
        run_id='r',
        phase=phase,
        sources=('sim',),
        transitions=np.array([9]),
        scorers=('sim',),
        scores=np.array([3]),
        dropped=(),
    )


def episode(**changes: Any) -> EpisodeResult:
    made = EpisodeResult(
        run_id='r',
        source='evaluate',
        purpose='evaluation',
        step=1000,
        version=0,
        episode=0,
        length=40,
        true_return=80.0,
        composite_return=60.0,
        score=0.5,
        terminated=True,
    )
    return replace(made, **changes)


def a_run(settings: Settings = SETTINGS) -> list[Record]:
    """A run of 2500 steps: three phases, evaluations after 1000, 2000 and 2500 steps."""
    said: list[Record] = []
    for i, true in enumerate((10.0, 30.0)):
        said.append(episode(purpose='random', step=0, version=-1, episode=i, true_return=true))
    for phase, step in enumerate((1000, 2000, 2500)):
        said.append(commit(phase))
        said.append(
            metrics(
                'r', 'learner', '/run_r/learner', phase, step, {'critic_loss': 1 / (phase + 1)}
            )
        )
        said.append(metrics('r', 'sim', 'sim', phase, step, {'simulate_seconds': 0.5}))
        said.append(episode(purpose='training', source='sim', step=step - 1, true_return=50.0))
        for i, true in enumerate((100.0 * phase, 100.0 * phase + 50)):
            said.append(
                episode(step=step, version=phase, episode=i, true_return=true, score=true / 1000)
            )
    return said


REPORTED: dict[str, dict[str, Any]] = {
    'sim-sim': {
        'role': 'sim',
        'published': {'task': 1, 'transitions': 100},
        'peak_rss_mb': 80.5,
        'cpu_s': 2.5,
        'wall_s': 9.0,
        'finished': True,
        'error': None,
    },
    'learner-learner': {
        'role': 'learner',
        'published': {'run': 1, 'policy': 4},
        'received': {'transitions': 99},
        'lost': {'transitions': 1},
        'duplicated': {'step_rewards': 2},
        'policy_sha256': 'abc',
        'updates': 1500,
        'counters': {'labels of evicted steps': 7},
    },
    'reward-reward': {
        'role': 'reward',
        'published': {'step_rewards': 3},
        'received': {'transitions': 100, 'composite_rewards': 60},
        'lost': {'composite_rewards': 5},
        'refused': {'composite_rewards': 4},
        'reward_model_sha256': 'def',
        'gradient_steps': 240,
    },
    'record-record': {'role': 'record', 'recorded': {'transitions': 98}, 'bag': '/runs/x/bag'},
}


REPORTS = {
    key: NodeReport.model_validate({'name': key} | known) for key, known in REPORTED.items()
}


def built(**changes: Any) -> dict[str, Any]:
    """The summary as it is written."""
    return run_summary(**changes).model_dump(mode='json')


def run_summary(*more: Record, **changes: Any) -> RunSummary:
    clock = Clock()
    made = Summary(SETTINGS, 'r', in_process=False, clock=clock)
    for record in (*a_run(), *more):
        made.receive(record)
    clock.now += 50
    return made.build(REPORTS, **changes)
