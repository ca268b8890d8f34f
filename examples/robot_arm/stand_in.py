"""A robot that knows nothing of this project: an arm as a ROS 2 node, in real time.

    .venv/bin/python examples/robot_arm/stand_in.py --seed 0 --log /tmp/arm_faults.jsonl

It publishes /joint_states (sensor_msgs/JointState) fifty times a second and takes velocities on
/arm/velocity_commands (std_msgs/Float64MultiArray). Without a command for 0.3 s it stops. The
service /arm/reset (std_srvs/Trigger) brings it to the start of another attempt. A camera beside it
scores each second of movement, counted from an attempt's first command: /arm/score
(std_msgs/Float64) at once, /arm/late_score (geometry_msgs/PointStamped, in point.x) some seconds
later, stamped with the end of that second, and not always.

Messages are noisy, late and get lost, and joints stick now and then: what goes wrong is in the
log, and in no message. Each kind is a parameter of the node (noise, latency, jitter, dropped,
stuck, stuck_for), which may be changed while it runs.
"""

import argparse
import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from arm import TICK, Arm, Faults, nearness, taken
from geometry_msgs.msg import PointStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger

PERIOD = 0.02  # [s] between two measurements
PATIENCE = 0.3  # [s] without a command, after which the motors stop
RESETTING = 0.25  # [s] that a reset takes
SCORED = 1.0  # [s] of movement that a score is of
SHORTEST = 0.7  # [s] of it that the last score of an attempt is of, at the least


class StandIn(Node):
    """The arm as a node.

    Args:
        arm: the arm.
        log: where faults, and what the arm really did, are written.
        late: seconds by which a stamped score is late, at the most.
        missing: share of the stamped scores that never come.
    """

    def __init__(
        self, arm: Arm, log: Path | None, late: float = 2.0, missing: float = 0.1
    ) -> None:
        super().__init__('arm')
        self._arm = arm
        self._log = log.open('w') if log else None
        self._began = time.monotonic()
        self._commanded = 0.0  # when the last command came, by the arm's time
        self._resetting = 0.0  # until when
        self._next = PERIOD
        self._near: list[float] = []
        self._camera = Camera(self, arm, late, missing)
        self._joints = self.create_publisher(JointState, '/joint_states', 10)
        self.create_subscription(Float64MultiArray, '/arm/velocity_commands', self._command, 10)
        self.create_service(Trigger, '/arm/reset', self._reset)
        self.create_timer(PERIOD / 4, self._catch_up)
        for kind, value in asdict(arm.faults).items():
            self.declare_parameter(kind, float(value))
        self.add_on_set_parameters_callback(self._change)
        self._write_faults()
        arm.reset()

    def _change(self, parameters: list[Any]) -> SetParametersResult:
        """Let other things go wrong from now on."""
        changes = {p.name: p.value for p in parameters if p.name in asdict(self._arm.faults)}
        if not all(isinstance(value, float) and value >= 0 for value in changes.values()):
            return SetParametersResult(successful=False, reason='a number from 0 on is needed')
        self._arm.faults = replace(self._arm.faults, **changes)
        self._write_faults()
        return SetParametersResult(successful=True)

    def _write_faults(self) -> None:
        self._write({'time': round(self._arm.time, 3), 'faults': asdict(self._arm.faults)})

    def _command(self, message: Float64MultiArray) -> None:
        self._commanded = self._arm.time
        if self._arm.time >= self._resetting:
            self._camera.begin()
            self._arm.command(np.asarray(message.data))

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._write({'time': round(self._arm.time, 3), 'attempt': self._near})
        self._near = []
        self._camera.end()
        self._arm.reset()
        self._resetting = self._arm.time + RESETTING
        response.success = True
        return response

    def _catch_up(self) -> None:
        """Let the arm's time follow that of the machine."""
        now = time.monotonic() - self._began
        while self._arm.time + TICK <= now:
            if self._arm.time - self._commanded > PATIENCE:
                self._arm.stop()
            self._arm.tick()
            self._camera.look()
            if self._arm.time >= self._next:
                self._publish()
        for fault in taken(self._arm.log):
            self._write(fault)

    def _publish(self) -> None:
        self._next = self._arm.time + PERIOD + self._arm.pause()
        self._near.append(round(float(nearness(self._arm.joints)), 4))
        measured = self._arm.measured()
        if measured is None:
            return
        (shoulder, elbow), speeds = measured
        message = JointState()
        message.header.stamp = self.get_clock().now().to_msg()
        message.name = ['elbow', 'gripper', 'shoulder']
        message.position = [float(elbow), 0.02, float(shoulder)]
        message.velocity = [float(speeds[1]), 0.0, float(speeds[0])]
        self._joints.publish(message)

    def _write(self, line: dict[str, Any]) -> None:
        if self._log:
            self._log.write(json.dumps(line) + '\n')
            self._log.flush()


class Camera:
    """Scores each second of an attempt: how near the hand was to the target, 20 at best.

    Args:
        node: publishes the scores.
        arm: what it looks at.
        late: seconds by which a stamped score is late, at the most.
        missing: share of the stamped scores that never come.
    """

    def __init__(self, node: Node, arm: Arm, late: float, missing: float) -> None:
        self._node, self._arm = node, arm
        self._late, self._missing = late, missing
        self._luck = np.random.default_rng([arm.seed, 2])
        self._since: float | None = None  # begin of the second under way, by the arm's time
        self._near: list[float] = []
        self._waiting: list[tuple[float, PointStamped]] = []
        # of the clock, at the begin of the arm's time
        self._epoch = node.get_clock().now() - Duration(seconds=arm.time)
        self._at_once = node.create_publisher(Float64, '/arm/score', 10)
        self._stamped = node.create_publisher(PointStamped, '/arm/late_score', 10)

    def begin(self) -> None:
        """Look at an attempt from now on, if at none yet."""
        if self._since is None:
            self._since = self._arm.time

    def end(self) -> None:
        """Look away: the attempt is over."""
        if self._since is not None and self._arm.time - self._since >= SHORTEST:
            self._score()
        self._since, self._near = None, []

    def look(self) -> None:
        """Look at the arm, and publish the scores whose time has come."""
        now = self._arm.time
        if self._since is not None:
            self._near.append(float(nearness(self._arm.joints)))
            if now - self._since >= SCORED:
                self._score()
        for due, message in [each for each in self._waiting if each[0] <= now]:
            self._waiting.remove((due, message))
            self._stamped.publish(message)

    def _score(self) -> None:
        assert self._since is not None
        value, end = 20 * float(np.mean(self._near)), self._since + SCORED
        self._since, self._near = end, []
        self._at_once.publish(Float64(data=value))
        if self._luck.random() < self._missing:
            return
        message = PointStamped()
        message.header.stamp = (self._epoch + Duration(seconds=end)).to_msg()
        message.point.x = value
        self._waiting.append((self._arm.time + self._late * self._luck.random(), message))


def main() -> None:
    """Be the arm until somebody stops it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--log', type=Path, help='what went wrong, as lines of JSON')
    parser.add_argument('--sound', action='store_true', help='nothing goes wrong')
    parser.add_argument('--late', type=float, default=2.0, help='seconds, of scores, at the most')
    parser.add_argument('--missing', type=float, default=0.1, help='share of the late scores')
    given, others = parser.parse_known_args()
    faults = Faults.none() if given.sound else Faults()
    rclpy.init(args=[sys.argv[0], *others])
    node = StandIn(Arm(given.seed, faults), given.log, given.late, given.missing)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
