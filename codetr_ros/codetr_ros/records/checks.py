"""Checks of a record before any part of a run takes it."""

import numpy as np

from codetr_ros.records import (
    OUTCOMES,
    CompositeReward,
    Preference,
    Record,
    RecordError,
    RunSpec,
    TaskSpec,
    Transitions,
    describe,
)


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
