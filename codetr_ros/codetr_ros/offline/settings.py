"""The settings of a fit, beyond those of a run."""

from typing import Literal

from pydantic import Field

from codetr_ros.config import Group

OF_NO_EFFECT = frozenset(
    [
        *('task', 'composite', 'beta', 'steps', 'phase_steps', 'warmup_steps', 'overlap'),
        *('simulators', 'envs', 'evaluate_every', 'evaluate_episodes', 'r_max', 'device'),
        *('record_relabels', 'relabel', 'relabel_steps', 'sac', 'hc', 'lirpg'),
    ]
)
"""Settings of simulating and of learning a policy: given by the data, or not used by a fit."""


class FitSettings(Group):
    """How a reward model is fitted to bags."""

    schedule: Literal['epochs', 'phases'] = Field(
        'epochs',
        description='epochs: on all of the data, with early stopping on held-out episodes; '
        'phases: as the run itself learnt, commit by commit, bit for bit',
    )
    validation: float = Field(
        0.2,
        ge=0.01,
        le=0.5,
        description='share of the steps, in whole episodes, that is held out (epochs)',
    )
    gradient_steps: int = Field(5000, ge=1, le=10**8, description='most gradient steps (epochs)')
    check_every: int = Field(
        100, ge=1, le=10**6, description='gradient steps between two looks at the held-out loss'
    )
    patience: int = Field(
        10,
        ge=1,
        le=10**6,
        description='looks without a lower held-out loss before the fit ends (epochs)',
    )
    part_steps: int = Field(
        1000,
        ge=1,
        le=10**8,
        description='gradient steps on the episodes in memory before others are read, if '
        'memory_steps do not hold them all (epochs)',
    )
    stretch_steps: int = Field(
        10_000,
        ge=1,
        le=10**8,
        description='longer episodes are cut between segments into parts of about this many '
        'steps, each held out or not by itself (epochs)',
    )
