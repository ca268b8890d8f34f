"""The reward node, which no transitions reach: as if the network had lost them all."""

import sys

from codetr_ros.records import Transitions
from codetr_ros.ros.node import CoreNode, run_node
from reward_node.reward import load


class Deaf(CoreNode):
    def _take(self, record_type, message):
        if record_type is not Transitions:
            super()._take(record_type, message)


if __name__ == '__main__':
    sys.exit(run_node('reward', 'reward', load, node_class=Deaf))
