"""A robot that knows nothing of this project: an arm as a ROS 2 node, in real time.

    .venv/bin/python examples/robot_arm/stand_in.py --seed 0 --log /tmp/arm_faults.jsonl

It publishes /joint_states (sensor_msgs/JointState) fifty times a second and takes velocities on
/arm/velocity_commands (std_msgs/Float64MultiArray). Without a command for 0.3 s it stops. The
service /arm/reset (std_srvs/Trigger) brings it to the start of another attempt. Messages are
noisy, late and get lost, and joints stick now and then: what went wrong is in the log, and in no
message.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import rclpy
from arm import TICK, Arm, Faults, nearness, taken
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

PERIOD = 0.02  # [s] between two measurements
PATIENCE = 0.3  # [s] without a command, after which the motors stop
RESETTING = 0.25  # [s] that a reset takes


class StandIn(Node):
    """The arm as a node.

    Args:
        arm: the arm.
        log: where faults, and what the arm really did, are written.
    """

    def __init__(self, arm: Arm, log: Path | None) -> None:
        super().__init__('arm')
        self._arm = arm
        self._log = log.open('w') if log else None
        self._began = time.monotonic()
        self._commanded = 0.0  # when the last command came, by the arm's time
        self._resetting = 0.0  # until when
        self._next = PERIOD
        self._near: list[float] = []
        self._joints = self.create_publisher(JointState, '/joint_states', 10)
        self.create_subscription(Float64MultiArray, '/arm/velocity_commands', self._command, 10)
        self.create_service(Trigger, '/arm/reset', self._reset)
        self.create_timer(PERIOD / 4, self._catch_up)
        arm.reset()

    def _command(self, message: Float64MultiArray) -> None:
        self._commanded = self._arm.time
        if self._arm.time >= self._resetting:
            self._arm.command(message.data)

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._write({'time': round(self._arm.time, 3), 'attempt': self._near})
        self._near = []
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


def main() -> None:
    """Be the arm until somebody stops it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--log', type=Path, help='what went wrong, as lines of JSON')
    parser.add_argument('--sound', action='store_true', help='nothing goes wrong')
    given = parser.parse_args()
    faults = Faults(0, 0, 0, 0, 0, 0) if given.sound else Faults()
    rclpy.init()
    node = StandIn(Arm(given.seed, faults), given.log)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
