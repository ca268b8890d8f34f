"""The reward methods, from composite rewards to step rewards, behind one small protocol."""

from codetr_ros.config import Settings
from codetr_ros.rewards.aggregate import Aggregate
from codetr_ros.rewards.base import RewardMethod, RewardModelError
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.rewards.diaster import Diaster
from codetr_ros.rewards.evidence.method import Evidence
from codetr_ros.rewards.ircr import Ircr
from codetr_ros.rewards.learned import Learned
from codetr_ros.rewards.lrr import Lrr
from codetr_ros.rewards.mil_lstm import MilLstm
from codetr_ros.rewards.mlp import Mlp
from codetr_ros.rewards.rbt import Rbt
from codetr_ros.rewards.redistribution import LastStep, Ones, Random, TrueReward, Uniform
from codetr_ros.rewards.residual import CodetrOnEvidence
from codetr_ros.rewards.rrd import Rrd
from codetr_ros.system.devices import usable

METHODS: dict[str, type[RewardMethod]] = {
    method.name: method
    for method in (
        Codetr,
        LastStep,
        Rbt,
        Rrd,
        Ircr,
        Diaster,
        Lrr,
        MilLstm,
        Mlp,
        Aggregate,
        Evidence,
        Uniform,
        Random,
        TrueReward,
        Ones,
    )
}
"""Reward methods by their name in `settings.method`."""


def kind(settings: Settings) -> type[RewardMethod]:
    """The reward method that the settings name.

    Raises:
        RewardModelError: there is no such method.
    """
    if settings.method not in METHODS:
        raise RewardModelError(
            f'method = {settings.method!r}: there is no such reward method; '
            f'choose one of {", ".join(METHODS)}'
        )
    if settings.method == Codetr.name and settings.codetr.base == 'evidence':
        return CodetrOnEvidence
    return METHODS[settings.method]


def check_device(settings: Settings) -> None:
    """Refuse a reward device that is not there, unless the method has no use for it.

    Raises:
        RewardModelError: there is no such method.
        DeviceError: the device is not there.
    """
    if issubclass(kind(settings), Learned):
        usable(settings.reward_device, 'reward_device')


def make(settings: Settings, observation_size: int, action_size: int) -> RewardMethod:
    """Make the reward method that the settings name.

    Args:
        settings: the run's settings.
        observation_size: O of the task.
        action_size: A of the task.

    Raises:
        RewardModelError: there is no such method.
    """
    return kind(settings)(settings, observation_size, action_size)
