"""The reward node, which no transitions reach: as if the network had lost them all."""

import sys

from codetr_ros.records import Transitions
from codetr_ros.ros.node import run_node
from codetr_ros.ros.wiring import Wiring
from reward_node.reward import load


class Deaf(Wiring):
    def take(self, kind, message):
        if kind is not Transitions:
            super().take(kind, message)


if __name__ == '__main__':
    sys.exit(run_node('reward', 'reward', load, wire=Deaf))
