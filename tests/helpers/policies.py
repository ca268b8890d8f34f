"""Trained policies and their files, for the robot of `helpers.robots`."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from codetr_ros.policy.actor import KINDS, StandardisedActor, weights_bytes
from codetr_ros.policy.network import PLAIN, Network
from codetr_ros.records import Policy
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.policy_export import export
from codetr_ros.robots.policy_file import PolicyFile
from codetr_ros.robots.robot_facts import RobotFacts
from helpers.builders import tiny
from helpers.robots import rules

JOINT_STATE = 'sensor_msgs/msg/JointState'


def policy(network: Network, seed: int = 0, gain: float = 1.0) -> Policy:
    """What a learner would publish: random weights with biases.

    Args:
        network: what it is.
        seed: of the weights.
        gain: factor of the last layer.
    """
    torch.manual_seed(seed)
    actor = KINDS[network.kind](network.inputs, network.action_size, network.hidden)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        last = actor.mean if isinstance(actor, StandardisedActor) else actor.heads
        for parameter in last.parameters():
            parameter.mul_(gain)
        if isinstance(actor, StandardisedActor):
            actor.observation_mean.copy_(torch.randn(network.inputs))
            actor.observation_deviation.copy_(torch.rand(network.inputs) + 0.1)
    return Policy(
        run_id='run',
        phase=4,
        version=3,
        sources=(),
        steps=np.zeros(0, np.uint32),
        random=False,
        network=network.describe(),
        weights=weights_bytes(actor),
    )


def facts(mapping: Mapping | None = None, **changes: Any) -> RobotFacts:
    """What the robot of `helpers.robots` is."""
    made = RobotFacts(mapping=mapping or rules(), types={'/joint_states': JOINT_STATE}, sizes=(4,))
    return made.model_copy(update=changes)


def policy_file(
    folder: Path,
    kind: str = PLAIN,
    segment_steps: int = 0,
    robot: RobotFacts | None = None,
    gain: float = 1.0,
) -> PolicyFile:
    """The file `policy.safetensors` of a policy of 4 observations and 2 actions."""
    network = Network(kind, 4, 2, (16, 8), segment_steps)
    settings = tiny(task='robot/arm', evaluate_every=0, delay=5)
    path = folder / 'policy.safetensors'
    return export(policy(network, gain=gain), robot or facts(), settings, path)
