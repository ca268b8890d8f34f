"""The parameters of nodes that are no settings of a run."""

from dataclasses import dataclass

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.parameter import Parameter

from codetr_ros.nodes.silence import LEAVE_OUT_AFTER

Type = Parameter.Type


@dataclass(frozen=True)
class Own:
    """A parameter of the node itself, not a setting of the run."""

    default: str | float | bool
    description: str
    low: float = 0.0
    high: float = 86_400.0
    of_core: bool = False  # the node's core is made with it

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` shows."""
        if isinstance(self.default, (str, bool)):
            kind = Type.STRING if isinstance(self.default, str) else Type.BOOL
            return ParameterDescriptor(
                type=kind.value, description=self.description, read_only=True
            )
        return ParameterDescriptor(
            type=Type.DOUBLE.value,
            description=self.description,
            read_only=True,
            floating_point_range=[FloatingPointRange(from_value=self.low, to_value=self.high)],
        )


OWN: dict[str, Own] = {
    'run_id': Own(
        '',
        'id of the run; in the learner: the id to give it (empty: made from the date), in all '
        'other nodes: the only run to join (empty: any)',
    ),
    'folder': Own(
        '',
        'folder of the run, for checkpoints, bag and the report of the node; empty: nothing is '
        'written',
    ),
    'peer_deadline': Own(
        60.0, 'seconds that the node waits for peers that are missing or silent; 0: for ever'
    ),
}
DRIVING: dict[str, Own] = {
    'autostart': Own(
        False,
        'true: drive the robot as soon as everybody is there; false: wait until somebody '
        'activates it (lifecycle of <node>_driver)',
    ),
    'real_time': Own(
        True,
        'ask the system for real-time scheduling, so that what computes beside this node does '
        'not delay control steps; where that is not allowed, it is logged',
    ),
}
"""Of nodes that drive a robot."""
OWN_OF_ROLE: dict[str, dict[str, Own]] = {
    'learner': {
        'config': Own(
            'quick', 'settings to start from: a preset (quick, cpu, paper) or a YAML file'
        ),
    },
    'reward': {
        'checkpoint': Own(
            '',
            'reward model to start from: the folder of a checkpoint, of a fit or of a run; empty: '
            'a new one. Its method, its sizes and the settings that shape it must be the same',
            of_core=True,
        ),
        'frozen': Own(
            False,
            'true: label with the checkpoint as it is, without learning; false: go on learning',
            of_core=True,
        ),
    },
    'robot': {
        'mapping': Own(
            '', 'the mapping file: the topics of the robot, its limits and its rate', of_core=True
        ),
        **DRIVING,
    },
    'act': {
        'checkpoint': Own(
            '',
            'the policy file that `codetr export` made, or the folder of its run, or one of the '
            "learner's checkpoints there",
        ),
        'mapping': Own(
            '',
            'the mapping file of the robot, if what watches over it (stop, heartbeat, reset) is '
            'other than in training; empty: the mapping in the policy file. What decides how the '
            'policy acts must be the same',
        ),
        'peer_deadline': Own(
            60.0,
            "seconds that the node waits for the robot's topics and their first messages; 0: for "
            'ever',
        ),
        **DRIVING,
    },
    'record': {
        'bag': Own(
            '',
            'folder of the bag; empty: `bag` in `folder`; without a `folder` too: no bag',
        ),
        'leave_out_after': Own(
            LEAVE_OUT_AFTER,
            'seconds of silence after which a simulator of several is left out of the phase, so '
            'that the run goes on without it; 0: never',
        ),
        'bag_split_mb': Own(
            1000.0,
            'megabytes after which the bag continues in a new file; 0: never',
            high=1e6,
        ),
        'bag_keep_free_mb': Own(
            64.0,
            'megabytes to leave free on the disk: when fewer are left, the bag is closed while '
            'there is room for its index, and the run ends; 0: go on until the disk is full',
            high=1e6,
        ),
    },
}


WITHOUT_RUN = ('act',)
"""Kinds of nodes that belong to no run, and have none of its settings."""


def own_parameters(role: str) -> dict[str, Own]:
    """The parameters of a node of this role besides the settings."""
    own = OWN_OF_ROLE.get(role, {})
    return own if role in WITHOUT_RUN else OWN | own


def core_parameters(role: str) -> tuple[str, ...]:
    """The names of those parameters that are passed to the core of this role."""
    return tuple(name for name, own in own_parameters(role).items() if own.of_core)
