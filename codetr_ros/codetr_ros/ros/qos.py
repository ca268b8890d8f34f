"""Quality of service, named once per topic: every topic is reliable, and `config.queues` states
which are transient local, and how deep their queues are.
"""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from codetr_ros.config import Settings
from codetr_ros.config.queues import QUALITIES, depth

__all__ = ['QUALITIES', 'depth', 'profile']


def profile(topic: str, settings: Settings | None = None) -> QoSProfile:
    """QoS profile of a topic, for publishers and subscriptions alike."""
    durable = QUALITIES[topic].transient_local
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth(topic, settings),
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE,
    )
