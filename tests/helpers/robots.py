"""A robot of two joints that is driven by velocity, its mapping, and a clock that a test turns."""

from types import SimpleNamespace
from typing import Any

from codetr_ros.robots.mapping import Mapping

MAPPING: dict[str, Any] = {
    'source': 'arm',
    'observation': [
        {'topic': '/joint_states', 'fields': ['position', 'velocity'], 'joints': ['a', 'b']}
    ],
    'action': {'topic': '/command', 'fields': ['data'], 'low': [-1.5, -2.0], 'high': [1.5, 2.0]},
    'sampling': {'max_age': 0.25},
    'live': {
        'rate': 10.0,
        'episode_steps': 5,
        'command': {'type': 'std_msgs/msg/Float64MultiArray', 'kind': 'velocity', 'safe': 0.0},
        'watchdog': {'learner': 0.0},
    },
}


def rules(live: dict[str, Any] | None = None, **changes: Any) -> Mapping:
    """The mapping, changed."""
    made = MAPPING | changes
    made['live'] = MAPPING['live'] | (live or {})
    return Mapping.model_validate(made)


def joints(a: float = 0.0, b: float = 0.0, speed: float = 0.0) -> SimpleNamespace:
    """A message of the joints, in an order of their own."""
    return SimpleNamespace(
        name=['b', 'gripper', 'a'], position=[b, 9.0, a], velocity=[speed, 9.0, speed]
    )


class Clock:
    """A clock that a test turns [s]."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now
