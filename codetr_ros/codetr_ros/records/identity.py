"""What makes two records the same one: a node that began again publishes some of them again."""

from collections.abc import Callable
from typing import Any

from codetr_ros.records.kinds import (
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Policy,
    Preference,
    Presence,
    Record,
    RunSpec,
    ScoreRequest,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)

_IDENTITY: dict[type, Callable[[Any], tuple[Any, ...]]] = {
    RunSpec: lambda r: (r.run_id,),
    Presence: lambda r: (r.instance_id, r.finished, tuple(r.published.tolist())),
    TaskSpec: lambda r: (r.source,),
    Policy: lambda r: (r.phase,),
    Transitions: lambda r: (r.source, r.sequence),
    CompositeReward: lambda r: (r.scorer, r.sequence),
    Preference: lambda r: (r.scorer, r.sequence),
    Commit: lambda r: (r.phase,),
    StepRewards: lambda r: (r.phase, r.part),
    ScoreRequest: lambda r: (r.phase,),
    # in training too, numbers repeat: those of episodes whose steps were dropped
    EpisodeResult: lambda r: (r.source, r.purpose, r.version, r.episode),
    TrueRewards: lambda r: (r.source, r.sequence),
    Metrics: lambda r: (r.role, r.node, r.phase, r.names),
}


def identity(record: Record) -> tuple[Any, ...]:
    """What no other record of this kind has in a run, unless it is the same one again."""
    return _IDENTITY[type(record)](record)


def phase_of(record: Record, phase_steps: int) -> int | None:
    """The phase that a record belongs to; None for one that belongs to none or, as a score,
    does not name it.

    Args:
        record: the record.
        phase_steps: environment steps of a phase.
    """
    if isinstance(record, EpisodeResult):
        if record.purpose != 'training':
            return max(0, record.version)  # it learnt from that phase
        return max(0, record.step - 1) // phase_steps
    return getattr(record, 'phase', None)
