"""The topic of a camera, beside those of the run: its pictures are shown to people who score."""

import time
from collections.abc import Sequence
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.serialization import deserialize_message
from rclpy.validate_topic_name import validate_topic_name

from codetr_ros.bags.definitions import stamp_of
from codetr_ros.cores.camera import LARGEST, Camera, PictureError, decoded, unpacked
from codetr_ros.records import Transitions
from codetr_ros.records.shown import worth_a_line
from codetr_ros.ros.commands import message_class
from codetr_ros.ros.driver import SENSOR
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.wiring import Wiring

IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
LOOK_EVERY = 0.5  # [s] between two looks at who publishes
SHORTEST = 12
"""Bytes in which a message has a stamp."""


def wrong_topic(topic: str) -> str | None:
    """Why nothing can be published on a topic, in words; None if it can."""
    try:
        validate_topic_name(topic)
    except InvalidTopicNameException as error:
        return f'{topic!r} is no name of a topic: {" ".join(str(error).split())}'
    return None


class CameraWiring(Wiring):
    """The wiring of a desk beside which a camera looks at the robot.

    Args:
        member: the node's membership.
        joined: the run that it has joined.
        camera: holds the pictures.
    """

    def __init__(self, member: Membership, joined: Joined, camera: Camera) -> None:
        super().__init__(member, joined)
        self._camera = camera
        self._look_at = 0.0
        self._open = False

    def take(self, kind: type, message: Any) -> None:
        """Take a message of the run; those with steps with the time at which they were stamped."""
        if kind is not Transitions or len(message) < SHORTEST:
            super().take(kind, message)
            return
        with self._camera.stamped(stamp_of(message)):
            super().take(kind, message)

    def show(self, given: Sequence[Any], doing: str) -> None:
        """Log how far the node has come, and subscribe to the camera once somebody publishes."""
        super().show(given, doing)
        now = time.monotonic()
        if not self._open and now >= self._look_at:
            self._look_at = now + LOOK_EVERY
            self._find()

    def _find(self) -> None:
        node, topic = self.member.link.node, self._camera.topic
        there = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
        types = sorted({info.topic_type for info in there})
        kind = next((each for each in types if each in (IMAGE, COMPRESSED)), None)
        if kind is None:
            if types:
                self._camera.problem = (
                    f'{topic} has type {", ".join(types)}: name a topic of type {IMAGE} or '
                    f'{COMPRESSED}'
                )
            return
        self._open = True
        self._camera.problem = f'no picture has come on {topic} yet'
        of_type = message_class(kind)

        def store(data: bytes) -> None:
            # here, not later: what is too much is not even kept
            if self._camera.due(time.monotonic()):
                self.member.link.store(self._take_picture, of_type, data, node.get_clock().now())
            else:  # noted all the same: else what came behind it waits for the next turn
                self.member.link.store(lambda: None)

        node.create_subscription(of_type, topic, store, SENSOR, raw=True)
        self.log.info(f'shows pictures of {topic} ({kind})')

    def _take_picture(self, of_type: Any, data: bytes, now: Any) -> None:
        try:
            if len(data) > LARGEST:
                raise PictureError(f'{len(data)} bytes: {LARGEST} are taken at most')
            message = deserialize_message(data, of_type)
            stamp = message.header.stamp
            at = stamp.sec * 10**9 + stamp.nanosec or now.nanoseconds
            if hasattr(message, 'format'):
                picture = decoded(message.data.tobytes())
            else:
                size = message.width, message.height, message.step
                picture = unpacked(message.encoding, *size, message.data.tobytes())
            self._camera.take(at, picture)
        except Exception as error:  # noqa: BLE001 - bytes from anywhere: what they raise is not known
            number = self._camera.refuse(error)
            if worth_a_line(number):
                self.log.error(f'number {number}: {self._camera.problem}')
