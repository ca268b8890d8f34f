"""Numbers one by one, each on a topic of its own, for tools that plot topics by name.

A `Metrics` record has many numbers under names that only its own fields give, which rqt_plot,
PlotJuggler and Foxglove cannot tell apart. So each number is published as `std_msgs/Float64` too:
`plot/<node>/<name>`, and `plot/<node>/true_return` and others for the results of episodes. Nothing
learns from these topics and nobody waits for them.
"""

import re
from collections.abc import Mapping

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64

from codetr_ros.records import EpisodeResult, Metrics, Record

BELOW = 'plot'
OF_EPISODES = ('true_return', 'composite_return', 'score', 'length')
DEPTH = 100
"""More than the episodes of most phases, whose results come at once."""


class Plots:
    """Publishes the numbers of a node's records.

    Args:
        node: publishes them.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers: dict[str, Publisher] = {}

    def publish(self, record: Record) -> None:
        """Publish the numbers of a record, if it has any to plot."""
        if isinstance(record, Metrics):
            self._send(dict(zip(record.names, record.values.tolist(), strict=True)))
        elif isinstance(record, EpisodeResult):
            self._send({name: float(getattr(record, name)) for name in OF_EPISODES})

    def _send(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            publisher = self._publishers.get(name)
            if publisher is None:
                publisher = self._publishers[name] = self._node.create_publisher(
                    Float64,
                    topic(self._node.get_name(), name),
                    QoSProfile(
                        depth=DEPTH,
                        reliability=ReliabilityPolicy.RELIABLE,
                        durability=DurabilityPolicy.VOLATILE,
                    ),
                )
            publisher.publish(Float64(data=value))


def topic(node: str, name: str) -> str:
    """The relative name of the topic of a number.

    Args:
        node: name of the node that publishes it.
        name: of the number; what a topic cannot have in its name becomes `_`.
    """
    return f'{BELOW}/{node}/{re.sub("[^A-Za-z0-9_]", "_", name)}'
