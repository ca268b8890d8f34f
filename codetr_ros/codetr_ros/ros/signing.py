"""For nodes of other people: publish messages that the nodes of a run admit.

    import rclpy
    from codetr_msgs.msg import CompositeReward
    from codetr_ros.ros.signing import Signed

    publish = Signed(node, CompositeReward, 'composite_rewards', qos_profile)
    publish(message)    # fills stamp, sender and signature

The key of the run comes from the environment variable that `nodes.signing` names. Without it the
messages are not signed, and only a run without a key takes them. docs/ros.md has the same for
other languages.
"""

import secrets
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message

from codetr_ros.nodes.signing import key_of, signed
from codetr_ros.system.liveness import own_name


def new_instance() -> str:
    """An id for one start of a process: the `sender` of all its messages, and the `instance_id` of
    its presence if it has one. Others on the same machine can look up from it whether the process
    still lives.
    """
    return f'{secrets.token_hex(8)} {own_name()}'.rstrip()


INSTANCE = new_instance()
"""That of this process."""


class Signed:
    """Publishes messages of one topic, signed.

    Args:
        node: the node.
        message_type: one of `codetr_msgs.msg`.
        topic: its name in the namespace of the run, such as 'composite_rewards'.
        qos: as `codetr_ros.ros.qos.profile(topic)`.
        instance: the sender of the messages.
    """

    def __init__(
        self, node: Node, message_type: Any, topic: str, qos: QoSProfile, instance: str = INSTANCE
    ) -> None:
        self._node = node
        self._publisher = node.create_publisher(message_type, topic, qos)
        self._topic = node.resolve_topic_name(topic)
        self._instance = instance
        self._key = key_of()
        self._stamp = 0

    def __call__(self, message: Any) -> None:
        """Fill in stamp, sender and signature of a message, and publish it."""
        self._stamp = max(self._node.get_clock().now().nanoseconds, self._stamp + 1)
        message.stamp.sec, message.stamp.nanosec = divmod(self._stamp, 10**9)
        message.sender = self._instance
        message.signature = np.zeros(len(message.signature), np.uint8)
        data = bytes(serialize_message(message))
        self._publisher.publish(
            data if self._key is None else signed(self._key, self._topic, data)
        )
