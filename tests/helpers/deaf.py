"""Nodes that no records of a kind reach: the network has lost them all."""

from codetr_ros.records import Commit, Policy, TaskSpec, Transitions
from codetr_ros.ros.node import run_node
from codetr_ros.ros.simulating import Simulating
from codetr_ros.ros.wiring import Wiring
from reward_node.reward import load
from sim_node.sim import load as load_sim


class Deaf(Wiring):
    def take(self, kind, message):
        if kind is not Transitions:
            super().take(kind, message)


def main() -> int:
    return run_node('reward', 'reward', load, wire=Deaf)


class Uncommitted(Wiring):
    def take(self, kind, message):
        if kind is not Commit:
            super().take(kind, message)


def uncommitted() -> int:
    return run_node('reward', 'reward', load, wire=Uncommitted)


class Unannounced(Wiring):
    def take(self, kind, message):
        if kind is not TaskSpec:
            super().take(kind, message)


def unannounced() -> int:
    return run_node('reward', 'reward', load, wire=Unannounced)


class Unpermitted(Simulating):
    def take(self, kind, message):
        if kind is not Policy:
            super().take(kind, message)


def unpermitted() -> int:
    return run_node('sim', 'sim', load_sim, wire=Unpermitted)
