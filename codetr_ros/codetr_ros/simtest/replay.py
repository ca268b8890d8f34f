"""A run learnt again from what its recorder has, as it wrote it."""

from collections.abc import Iterable

from codetr_ros.config import Settings
from codetr_ros.cores.core import Core
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.records import Record, RunSpec, StepRewards


def replayed(
    run: RunSpec, settings: Settings, records: Iterable[Record]
) -> tuple[str | None, str | None]:
    """Digests of the policy and of the reward model that learn from these records alone.

    Args:
        run: the run.
        settings: its settings.
        records: what was recorded, in that order.
    """
    learner = Learner(run, settings, 'learner', None)
    labeller = Labeller(run, settings, 'reward', None) if settings.labels_steps else None
    cores: list[Core[Record]] = [learner] if labeller is None else [labeller, learner]
    works = {id(core): core.work() for core in cores}

    def work() -> None:
        for core in cores:
            while (given := next(works[id(core)])) is not None:
                for record in given:
                    if isinstance(record, StepRewards):
                        learner.receive(record)

    for record in records:
        for core in cores:
            if isinstance(record, core.subscribes) and not isinstance(record, StepRewards):
                core.receive(record)
        work()
    reward_model = None if labeller is None else labeller.report().reward_model_sha256
    return learner.report().policy_sha256, reward_model
