"""Policy learners: SAC on step rewards, and the methods that learn from the scores themselves."""

from collections.abc import Callable

from codetr_ros.config import Settings
from codetr_ros.learners.base import PolicyLearner
from codetr_ros.learners.from_labels import FromLabels, FromLabelsOnDevice
from codetr_ros.learners.hc import HC
from codetr_ros.learners.lirpg import Lirpg

METHODS: dict[str, Callable[[Settings, int, int], PolicyLearner]] = {'hc': HC, 'lirpg': Lirpg}
"""Policy learners by their name in `settings.method`. Every other method is a reward method: it
labels steps, and SAC learns from the labels."""


def make(settings: Settings, observation_size: int, action_size: int) -> PolicyLearner:
    """Make the policy learner that the settings name.

    Args:
        settings: the run's settings.
        observation_size: O of the task.
        action_size: A of the task.

    Raises:
        DeviceError: the device of the settings is not available.
    """
    from_labels = FromLabels if settings.device == 'cpu' else FromLabelsOnDevice
    learner = METHODS.get(settings.method, from_labels)
    return learner(settings, observation_size, action_size)
