"""Who takes part in a run, and who publishes what to whom: the one table of it.

Everybody publishes `Presence` and reads it; the table leaves it out. All else about roles derives
from here: what cores subscribe to, whom a node waits for, what a launcher starts.
"""

import shutil
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Protocol

from codetr_ros.records.kinds import (
    TOPICS,
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Policy,
    Preference,
    Presence,
    RunSpec,
    ScoreRequest,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)


class DecidingSettings(Protocol):
    """The settings of a run that decide who takes part."""

    @property
    def simulators(self) -> int:
        """How many simulators share the steps."""

    @property
    def evaluate_every(self) -> int:
        """Steps between evaluations; 0: none."""

    @property
    def labels_steps(self) -> bool:
        """Whether a reward node labels steps, from which the policy is then learnt."""

    @property
    def scorer(self) -> str:
        """Who scores segments."""


@dataclass(frozen=True)
class Role:
    """One kind of node.

    Attributes:
        package: the ROS package of its executable.
        executable: the executable, which is also the node's name unless it is remapped.
        publishes: kinds of records that it publishes.
        reads: kinds of records that must reach it.
        relies_on: roles without whom it cannot finish: while it still waits for something, a node
            of such a role has finished only if it was stopped.
        count: how many nodes a run needs.
        reads_unlabelled: what it reads instead where nobody labels steps.
        dispensable: whether a run that has begun goes on and ends well without it.
    """

    package: str
    executable: str
    publishes: tuple[type, ...]
    reads: tuple[type, ...]
    relies_on: tuple[str, ...]
    count: Callable[[DecidingSettings], int] = lambda settings: 1
    reads_unlabelled: tuple[type, ...] | None = None
    dispensable: bool = False


TABLE: dict[str, Role] = {
    'sim': Role(
        'sim_node', 'sim',
        publishes=(TaskSpec, Transitions, CompositeReward, EpisodeResult, TrueRewards, Metrics),
        reads=(RunSpec, Policy),
        relies_on=('learner',),
        count=lambda settings: settings.simulators,
    ),
    'evaluate': Role(
        'sim_node', 'evaluate',
        publishes=(EpisodeResult, Metrics),
        reads=(RunSpec, Policy),
        relies_on=('learner',),
        count=lambda settings: int(settings.evaluate_every > 0),
        dispensable=True,
    ),
    'reward': Role(
        'reward_node', 'reward',
        publishes=(StepRewards, ScoreRequest, Metrics),
        reads=(RunSpec, TaskSpec, Transitions, CompositeReward, Preference, Commit),
        relies_on=('record',),
        count=lambda settings: int(settings.labels_steps),
    ),
    'learner': Role(
        'learner_node', 'learner',
        publishes=(RunSpec, Policy, Metrics),
        reads=(TaskSpec, Transitions, Commit, StepRewards),
        reads_unlabelled=(TaskSpec, Transitions, CompositeReward, Preference, Commit),
        relies_on=('reward', 'record'),
    ),
    'score': Role(
        'codetr_ros', 'score',
        publishes=(CompositeReward, Preference),
        reads=(RunSpec, Transitions, TrueRewards, ScoreRequest, Commit),
        relies_on=('sim', 'record'),
        count=lambda settings: int(settings.scorer == 'simulated'),
    ),
    'desk': Role(
        'codetr_ros', 'score',
        publishes=(CompositeReward, Preference),
        reads=(RunSpec, TaskSpec, Transitions, ScoreRequest, Commit),
        relies_on=('sim', 'record'),
        # nobody waits for a person or a program that scores: they come and go
        count=lambda settings: 0,
    ),
    'record': Role(
        'codetr_ros', 'record',
        publishes=(Commit, Metrics),
        reads=tuple(kind for kind in TOPICS if kind not in (Presence, Commit)),
        relies_on=('sim', 'learner'),
    ),
}  # fmt: skip
"""Every role by its name."""

ROLES = tuple(TABLE)


def command(role: str) -> str:
    """What starts a node of a role, for people. An installation from wheels has no `ros2`."""
    package, executable = TABLE[role].package, TABLE[role].executable
    if shutil.which('ros2') is None:
        return f'{sys.prefix}/lib/{package}/{executable}'
    return f'ros2 run {package} {executable}'


def needed(settings: DecidingSettings) -> dict[str, int]:
    """How many nodes of each role a run needs, in the order in which they start: the learner,
    which makes the run, last.
    """
    order = sorted(TABLE, key=lambda role: role == 'learner')
    return {role: count for role in order if (count := TABLE[role].count(settings))}


def read_by(role: str, labelled: bool = True) -> tuple[type, ...]:
    """Kinds of records that must reach a role.

    Args:
        role: its name.
        labelled: whether a reward node labels steps (`Settings.labels_steps`).
    """
    instead = None if labelled else TABLE[role].reads_unlabelled
    return TABLE[role].reads if instead is None else instead


def subscribed(role: str, labelled: bool = True) -> tuple[type, ...]:
    """What of it the role's core takes in: the run itself is its node's business."""
    return tuple(kind for kind in read_by(role, labelled) if kind is not RunSpec)


def published_by(role: str) -> tuple[str, ...]:
    """Topics that a role publishes on."""
    return tuple(TOPICS[kind] for kind in TOPICS if kind in TABLE[role].publishes)


def _by_topic(kinds_of: Callable[[str], Collection[type]]) -> dict[str, tuple[str, ...]]:
    return {
        topic: tuple(role for role in TABLE if kind in kinds_of(role))
        for kind, topic in TOPICS.items()
        if kind is not Presence
    }


def readers(labelled: bool = True) -> dict[str, tuple[str, ...]]:
    """Roles that must read what is published on a topic, by topic.

    Args:
        labelled: whether a reward node labels steps (`Settings.labels_steps`).
    """
    return _by_topic(lambda role: read_by(role, labelled))


WRITERS = _by_topic(lambda role: TABLE[role].publishes)
"""Roles that publish on a topic, by topic."""

READ_BY_ITSELF = {'record': (TOPICS[Metrics],)}
"""Topics on which a role receives what it publishes itself. It writes its commits to the bag
before it publishes them."""
