"""Checks of a record before any part of a run takes it."""

from math import ceil
from typing import Protocol

import numpy as np

from codetr_ros.records import (
    MESSAGE_BYTES,
    OUTCOMES,
    Commit,
    CompositeReward,
    Policy,
    Preference,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    describe,
)


class LabelSettings(Protocol):
    """The settings of a run that decide how many labels there are."""

    @property
    def memory_steps(self) -> int:
        """Steps that the memory D holds."""

    @property
    def source_count(self) -> int:
        """Number of sources of the run."""


class PhaseSettings(Protocol):
    """The settings of a run that decide which phases there are."""

    @property
    def ahead(self) -> int:
        """Phases by which a source may be ahead of the newest that was learnt from."""

    @property
    def phases(self) -> int:
        """Phases of the run."""


class ScoreSettings(Protocol):
    """The settings of a run that decide whose scores are taken."""

    @property
    def scorers(self) -> tuple[str, ...]:
        """Names of those beside the simulators whose scores are taken."""

    @property
    def scored_elsewhere(self) -> bool:
        """Whether another than the simulator scores."""


PhaseRecord = Policy | Transitions | Commit | StepRewards


def check_run(record: Record, run: RunSpec) -> None:
    """Refuse a record of another run.

    Raises:
        RecordError: names both runs.
    """
    if record.run_id != run.run_id:
        raise RecordError(
            f'{describe(record)} is of run {record.run_id!r}, this is run {run.run_id!r}: stop '
            'the other run, or give each run a namespace of its own'
        )


def check_transitions(chunk: Transitions, spec: TaskSpec) -> None:
    """Refuse steps that the task cannot have.

    Raises:
        RecordError: names the field, its value and what the task has.
    """
    shapes = (
        ('observations', chunk.observations, (chunk.steps + 1, spec.observation_size)),
        ('actions', chunk.actions, (chunk.steps, spec.action_size)),
    )
    for name, array, expected in shapes:
        if chunk.steps < 1 or array.shape != expected:
            raise RecordError(
                f'{describe(chunk)}: {name} have shape {array.shape}, {expected} expected of task '
                f'{spec.task} as {spec.source!r} announced it'
            )
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            step, component = bad[0].tolist()
            raise RecordError(
                f'{describe(chunk)}: {name}[{step}, {component}] is {array[step, component]}: all '
                f'values must be finite; mend what {spec.source!r} publishes'
            )
    if chunk.first_step + chunk.steps > spec.horizon:
        raise RecordError(
            f'{describe(chunk)}: step {chunk.first_step + chunk.steps} lies beyond the horizon '
            f'{spec.horizon} of {spec.task}'
        )


def check_labels(record: StepRewards, settings: LabelSettings) -> None:
    """Refuse labels that cannot be those of a phase.

    Raises:
        RecordError: names the field, its value and what is allowed.
    """
    if not np.isfinite(record.labels).all():
        raise RecordError(
            f'{describe(record)}: '
            f'labels[{int(np.argmin(np.isfinite(record.labels)))}] is not finite'
        )
    if len(record.lengths) and not int(record.lengths.min()):
        raise RecordError(f'{describe(record)}: a length is 0: a segment has steps')
    most = most_parts(settings)
    if not record.part < record.parts <= most:
        raise RecordError(
            f'{describe(record)}: part {record.part} of {record.parts}: the labels of a phase '
            f'have 1 to {most} parts, numbered from 0'
        )


def check_scorer(judgement: CompositeReward | Preference, settings: ScoreSettings) -> None:
    """Refuse a judgement of somebody who is not asked for any.

    Raises:
        RecordError: names the scorer, and the setting that admits it.
    """
    scorer = judgement.scorer
    if scorer in settings.scorers or (settings.scored_elsewhere and not settings.scorers):
        return
    if not settings.scored_elsewhere and scorer == judgement.source:
        return
    raise RecordError(
        f'{describe(judgement)} is by {scorer!r}, who is no scorer of this run: start the run '
        f'with scorers={[*settings.scorers, scorer]}'
    )


def check_phase(record: PhaseRecord, due: int, settings: PhaseSettings) -> None:
    """Refuse a record of a phase that nobody has permitted yet.

    Args:
        record: the record.
        due: the next phase to be finished here. The phases before it are permitted, and so many
            more as a source may be ahead.
        settings: the settings of the run.

    Raises:
        RecordError: names the phase and the last that may be under way.
    """
    last = min(due + settings.ahead, settings.phases + settings.ahead - 1)
    if record.phase > last:
        raise RecordError(
            f'{describe(record)}: phase {record.phase} cannot have begun: {due} is the next to be '
            f'finished, so that {last} is the last that may be permitted'
        )


def most_parts(settings: LabelSettings) -> int:
    """The most parts in which the labels of a phase travel: at most 4 bytes for each label and 12
    for its segment, in parts of which all but the last of each source are half full at least.
    """
    return settings.source_count + ceil(16 * settings.memory_steps / HALF_A_PART)


HALF_A_PART = MESSAGE_BYTES // 2
"""Bytes of a part of step rewards that are always filled."""

LARGEST_SCORE = 1e100
"""The largest amount of a composite reward: squares of larger ones have no float64 any more."""


def usable_score(value: float) -> bool:
    """Whether a composite reward can be computed with: it is finite and not beyond all measure."""
    return abs(value) <= LARGEST_SCORE


def check_score(reward: CompositeReward, delay: int, missing: bool = False) -> None:
    """Refuse a composite reward that no segment can have.

    Args:
        reward: the record.
        delay: the most steps of a segment.
        missing: whether a segment may have no score, which NaN states.

    Raises:
        RecordError: names the field and its value.
    """
    if missing and np.isnan(reward.value):
        pass
    elif not np.isfinite(reward.value):
        remedy = '' if missing else '; where scores may be missing, set score_missing'
        raise RecordError(
            f'{describe(reward)}: value is {reward.value}: a composite reward must be finite'
            f'{remedy}'
        )
    elif not usable_score(reward.value):
        raise RecordError(
            f'{describe(reward)}: value is {reward.value}: a composite reward must be from '
            f'-{LARGEST_SCORE:g} to {LARGEST_SCORE:g}'
        )
    if not 1 <= reward.length <= delay:
        raise RecordError(
            f'{describe(reward)}: length is {reward.length}: a segment has 1 to {delay} steps'
        )


def check_preference(preference: Preference, delay: int) -> None:
    """Refuse a preference that nobody can have.

    Args:
        preference: the record.
        delay: the most steps of a segment.

    Raises:
        RecordError: names the field and its value.
    """
    outcome = preference.outcome
    if outcome not in OUTCOMES and not np.isnan(outcome):
        raise RecordError(
            f'{describe(preference)}: outcome is {outcome}: must be 1 (the first segment is '
            'better), 0 (the second), 0.5 (both are as good) or NaN (cannot decide)'
        )
    for name in ('length', 'other_length'):
        if not 1 <= getattr(preference, name) <= delay:
            raise RecordError(
                f'{describe(preference)}: {name} is {getattr(preference, name)}: a segment has 1 '
                f'to {delay} steps'
            )
    first = (preference.source, preference.episode, preference.first_step)
    if first == (preference.other_source, preference.other_episode, preference.other_first_step):
        raise RecordError(
            f'{describe(preference)} compares a segment with itself: compare two of them'
        )
