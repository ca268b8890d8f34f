"""What a person may ask of a robot node, where there is no command `ros2`.

    .venv/bin/python examples/robot_arm/person.py activate /arm_run
    .venv/bin/python examples/robot_arm/person.py activate / --node act

With the command `ros2`, the same is `ros2 lifecycle set /arm_run/robot_driver activate` and
`ros2 service call /arm_run/robot_driver/stop std_srvs/srv/Trigger`.
"""

import argparse
import sys
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from std_srvs.srv import SetBool, Trigger

CHANGES = {
    'activate': Transition.TRANSITION_ACTIVATE,
    'deactivate': Transition.TRANSITION_DEACTIVATE,
}
TRIGGERS = ('stop', 'resume', 'ready')
PAUSES = {'pause': True, 'go': False}


def question(asked: str) -> tuple[Any, str, Any]:
    """The type, the name and the request of the service that is asked for."""
    if asked in CHANGES:
        request = ChangeState.Request()
        request.transition.id = CHANGES[asked]
        return ChangeState, 'change_state', request
    if asked in PAUSES:
        return SetBool, 'pause', SetBool.Request(data=PAUSES[asked])
    return Trigger, asked, Trigger.Request()


def main() -> int:
    """Ask, and print the answer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('asked', choices=[*CHANGES, *PAUSES, *TRIGGERS])
    parser.add_argument('namespace', help='of the run, such as /arm_run, or of the node')
    parser.add_argument('--node', default='robot', help='that drives the robot: robot, or act')
    given = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node('person')
    kind, name, request = question(given.asked)
    client = node.create_client(kind, f'{given.namespace.rstrip("/")}/{given.node}_driver/{name}')
    try:
        if not client.wait_for_service(10.0):
            print(f'nobody offers {client.srv_name}: is that node there?', file=sys.stderr)
            return 1
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=10.0)
        answer = future.result()
        print(getattr(answer, 'message', '') or ('done' if answer.success else 'refused'))
        return 0 if answer.success else 1
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    sys.exit(main())
