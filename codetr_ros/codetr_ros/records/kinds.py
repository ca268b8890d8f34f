"""The kinds of records: one frozen dataclass for each message of `codetr_msgs`.

A record has the fields of its message, with the same names, in the same order (the message adds a
`stamp`, from which nothing learns, its sender and a signature). Records know nothing of ROS;
`codetr_ros.bags.definitions` turns one into the other. Fields are given by name: many neighbours
have one type, and two that changed places would go unnoticed. Arrays are numpy; their shapes use
T = steps, O = observation size, A = action size.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

PROTOCOL_VERSION = 2
"""Raised whenever a field changes its meaning; nodes of different versions refuse each other.

Fields are only ever appended, with a default, so that bags of older versions stay readable. Since
version 2 commits carry digests.
"""

MESSAGE_BYTES = 200_000
"""The most bytes of a message's arrays: the middleware's shared-memory segment holds 512 KB."""

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U32 = NDArray[np.uint32]
I64 = NDArray[np.int64]
U64 = NDArray[np.uint64]

INITIAL_VERSION = -1
"""Policy version of the untrained policy; version k is the policy published after training on
phase k.
"""


FIRST, EQUAL, SECOND = OUTCOMES = (1.0, 0.5, 0.0)
"""Outcomes of a preference: which of the two segments is better."""


class RecordError(ValueError):
    """A record that must be refused: names value, field, source and remedy."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RunSpec:
    """The announcement of a run, with every setting that its nodes share. From learner to all."""

    run_id: str
    protocol_version: int
    seed: int
    settings: str  # canonical JSON of `config.Settings`
    settings_hash: str  # sha256 of `settings`


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Presence:
    """Announces a node: on start, once a second, and a last time when it has finished.

    `published` counts the records that it has published so far on each of `topics`, so that a
    subscriber can count those it has not received. `missed` is this node's own count: records that
    others have published on topics it reads, and that have not reached it after a while.
    """

    run_id: str
    role: str  # one of `roles.ROLES`
    node: str  # fully qualified node name; its last part names the sources where role is 'sim'
    instance_id: str  # a new one at each start of the process; names the process for its machine
    settings_hash: str  # empty while the node still waits for the run, and once it has given up
    finished: bool
    topics: tuple[str, ...]
    published: U64  # (len(topics),)
    missed: int  # lost on the way to this node, all topics together
    doing: str = ''  # what it does or waits for, for people
    waiting: float = 0.0  # [s] for which it has waited for that; 0 while it works


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class TaskSpec:
    """The task that a source simulates. From each simulator to all."""

    run_id: str
    protocol_version: int
    source: str
    task: str
    observation_size: int
    action_size: int
    horizon: int  # steps after which an episode is truncated, if not before
    control_period: float  # seconds of simulated time that a step takes; 0 where unknown
    r_max: float  # the largest reward of one step, for score normalisation


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Policy:
    """The permission for one phase, with the policy to act under. From the learner to the
    simulators.

    Steps that are all zero permit nothing: every phase of the run has already been permitted.
    """

    run_id: str
    phase: int
    version: int  # INITIAL_VERSION or the phase after whose training these weights were published
    sources: tuple[str, ...]
    steps: U32  # (len(sources),) steps that each source takes in this phase
    random: bool  # act uniformly at random; `weights` is then empty
    network: str  # JSON description of the network the weights belong to
    weights: bytes  # safetensors


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Transitions:
    """Consecutive steps of one episode in one phase. From a simulator to recorder, reward and
    learner.
    """

    run_id: str
    source: str
    sequence: int  # 0, 1, 2, ... for each source
    phase: int
    episode: int  # 0, 1, 2, ... for each source
    first_step: int  # index within the episode of the first of these steps
    steps: int  # T
    observations: F32  # (T+1, O): the observation before each step, and the one after the last
    actions: F32  # (T, A) in [-1, 1]
    # the last step ended the episode in a terminal state: nothing is bootstrapped from it
    terminated: bool
    truncated: bool  # the last step ended the episode otherwise: at its horizon or before
    phase_end: bool  # these are the source's last steps of the phase
    scores_due: int  # on phase_end: composite rewards due for segments that ended in this phase


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CompositeReward:
    """The score of one segment. From its scorer to recorder, reward or learner."""

    run_id: str
    source: str  # the source of the segment
    scorer: str  # the name of its scorer
    sequence: int  # 0, 1, 2, ... for each scorer, scores and preferences together
    episode: int
    first_step: int
    length: int
    value: float  # NaN: the segment has no score (`score_missing`), or its scorer cannot tell


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Preference:
    """Which of two segments is better. From its scorer to recorder, reward or learner."""

    run_id: str
    scorer: str  # the name of its scorer
    sequence: int  # among the numbers of its scorer's scores
    source: str  # the source of the first segment
    episode: int
    first_step: int
    length: int
    other_source: str  # the source of the second segment
    other_episode: int
    other_first_step: int
    other_length: int
    outcome: float  # one of `OUTCOMES`; NaN: the scorer cannot decide


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Commit:
    """Confirms that a phase is on disk, and names all that belongs to it. From recorder to reward
    and learner.
    """

    run_id: str
    phase: int
    sources: tuple[str, ...]
    transitions: I64  # (len(sources),) last sequence number of each source, -1 for none yet
    scorers: tuple[str, ...]
    scores: I64  # (len(scorers),) last sequence number of each scorer, -1 for none yet
    dropped: tuple[str, ...]  # sources left out of the phase, and those not there again
    # digests as `records.digests` makes them; those of bags of protocol 1 are empty
    transition_digests: tuple[str, ...] = ()  # of each source
    score_digests: tuple[str, ...] = ()  # of each scorer
    policy_digest: str = ''
    labels_digest: str = ''  # of the newest phase whose labels this phase's policy was learnt with
    kept_labels_digest: str = ''  # of what the bag keeps of these labels
    previous: str = ''  # of the commit before


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class StepRewards:
    """New and changed labels after a phase, in parts. From reward to learner and recorder.

    A row is a segment, whole the first time. Later it may be some consecutive steps of one
    (`relabel` 'drawn'), to which `first_steps` and `lengths` then refer.
    """

    run_id: str
    phase: int
    version: int  # of the reward model: gradient steps taken
    part: int
    parts: int
    source: str  # empty where the part is empty
    episodes: U32  # (S,) the segment's episode
    first_steps: U32  # (S,)
    lengths: U32  # (S,)
    labels: F32  # (sum of lengths,) segment after segment
    commit: str = ''  # digest of the phase's commit, of which they were made


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ScoreRequest:
    """The segments whose scores are worth most, the most valuable first. From reward to scorers,
    recorder and people.
    """

    run_id: str
    phase: int
    sources: tuple[str, ...]
    episodes: U32  # (len(sources),)
    first_steps: U32  # (len(sources),)
    lengths: U32  # (len(sources),)
    worths: F32  # (len(sources),) how far each score may be off; NaN: not known


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class EpisodeResult:
    """The result of one episode. From simulators (training) and the evaluator to the recorder."""

    run_id: str
    source: str
    purpose: str  # 'training', 'evaluation', or 'random': an evaluation of the random policy
    # training steps that the policy has learnt from (evaluation), or that the run has taken if all
    # its sources are as far in the phase as this one (training)
    step: int
    version: int  # policy version
    episode: int
    length: int
    true_return: float
    composite_return: float
    score: float  # composite_return / that of an agent that earns r_max at every step
    terminated: bool


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class TrueRewards:
    """The environment's own step rewards, for evaluation only: no node learns from them."""

    run_id: str
    source: str
    sequence: int  # that of the Transitions it belongs to
    phase: int
    episode: int
    first_step: int
    rewards: F32  # (T,)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Metrics:
    """Named numbers at a step. From every node to recorder and people."""

    run_id: str
    role: str
    node: str
    phase: int
    step: int  # training steps taken in the run so far
    names: tuple[str, ...]
    values: F64  # (len(names),)


Record = (
    RunSpec
    | Presence
    | TaskSpec
    | Policy
    | Transitions
    | CompositeReward
    | Preference
    | Commit
    | StepRewards
    | ScoreRequest
    | EpisodeResult
    | TrueRewards
    | Metrics
)

TOPICS: dict[type, str] = {
    RunSpec: 'run',
    Presence: 'presence',
    TaskSpec: 'task',
    Policy: 'policy',
    Transitions: 'transitions',
    CompositeReward: 'composite_rewards',
    Preference: 'preferences',
    Commit: 'commits',
    StepRewards: 'step_rewards',
    ScoreRequest: 'score_requests',
    EpisodeResult: 'episodes',
    TrueRewards: 'true_rewards',
    Metrics: 'metrics',
}
"""The (relative) name of the topic that carries each kind of record."""


def metrics(
    run_id: str, role: str, node: str, phase: int, step: int, values: Mapping[str, float]
) -> Metrics:
    """A `Metrics` record from names and values."""
    numbers = np.array(list(values.values()), np.float64)
    return Metrics(
        run_id=run_id,
        role=role,
        node=node,
        phase=phase,
        step=step,
        names=tuple(values),
        values=numbers,
    )


def describe(record: Record) -> str:
    """Name a record briefly, for errors: its kind and its scalar fields, no arrays."""
    shown = []
    for f in fields(record):
        value: Any = getattr(record, f.name)
        if (f.name != 'run_id' and isinstance(value, (bool, int, float))) or f.name in (
            'source',
            'node',
        ):
            shown.append(f'{f.name}={value}')
    return f'{type(record).__name__}({", ".join(shown)})'
