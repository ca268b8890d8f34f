"""The checks of a policy before a simulator or the evaluator acts under it."""

from typing import Protocol

from codetr_ros.config import Settings
from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.policy.network import NetworkError
from codetr_ros.records import INITIAL_VERSION, Policy, Record, RecordError, RunSpec, describe
from codetr_ros.records.checks import check_run


class Stage(Protocol):
    """Where a policy is to act: an environment, or a robot."""

    @property
    def name(self) -> str:
        """The name of the task."""

    @property
    def observation_size(self) -> int:
        """O."""

    @property
    def action_size(self) -> int:
        """A."""

    @property
    def horizon(self) -> int:
        """Steps after which an episode is truncated."""


def check_policy(policy: Record, run: RunSpec, settings: Settings, receiver: str) -> Policy:
    """Refuse a record that is not a policy of this run.

    Raises:
        RecordError: another kind of record, another run, steps that do not match the sources, a
            phase or version that the run does not have.
    """
    if not isinstance(policy, Policy):
        raise RecordError(
            f'{receiver} takes policies only, not {describe(policy)}: remove this subscription'
        )
    check_run(policy, run)
    if len(policy.steps) != len(policy.sources):
        raise RecordError(
            f'{describe(policy)}: steps has {len(policy.steps)} entries for '
            f'{len(policy.sources)} sources ({", ".join(policy.sources)}): the learner must give '
            'each source its steps'
        )
    last = settings.phases - 1
    if not (
        0 <= policy.phase <= last + settings.lag and INITIAL_VERSION <= policy.version <= last
    ):
        raise RecordError(
            f'{describe(policy)}: this run has phases 0 to {last + settings.lag} and versions '
            f'{INITIAL_VERSION} to {last}: the learner must stay within them'
        )
    return policy


def acting_policy(policy: Policy, environment: Stage, settings: Settings) -> ActingPolicy | None:
    """The policy to act with in an environment; None for the uniformly random one.

    Args:
        policy: the record that the learner published.
        environment: where it is to act.
        settings: of the run: the steps n of a segment.

    Raises:
        RecordError: the weights are of another architecture or for other segments, missing or not
            finite.
    """
    if policy.random:
        return None
    try:
        return ActingPolicy.from_record(
            policy,
            environment.observation_size,
            environment.action_size,
            settings.within(environment.horizon).longest,
        )
    except NetworkError as error:
        raise RecordError(
            f'{describe(policy)} cannot act in task {environment.name!r}: {error}'
        ) from error
