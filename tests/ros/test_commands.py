"""Commands of any type are made from numbers; what a type cannot hold is refused by name."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time

from codetr_ros.nodes.errors import NodeError
from codetr_ros.robots.live import Command
from codetr_ros.robots.mapping import Action
from codetr_ros.ros.commands import CommandMessages, message_class

NOW = Time(sec=7)


def made(kind: str, fields: list[str], numbers: list[float], joints=None):
    action = Action(topic='/c', fields=tuple(fields), joints=joints)
    command = Command(type=kind, kind='velocity', safe=0.0)
    messages = CommandMessages(action, command, len(numbers), 0.05)
    return messages.make(np.array(numbers), NOW)


def test_a_list_of_numbers():
    message = made('std_msgs/msg/Float64MultiArray', ['data'], [1.0, -2.0])
    assert list(message.data) == [1.0, -2.0]
    message = made('std_msgs/msg/Float32MultiArray', ['data'], [0.5])
    assert list(message.data) == [0.5]


def test_single_numbers_in_nested_fields_with_the_time_in_the_header():
    message = made('geometry_msgs/msg/Twist', ['linear.x', 'angular.z'], [0.5, -1.0])
    assert (message.linear.x, message.angular.z, message.linear.y) == (0.5, -1.0, 0.0)
    stamped = made('geometry_msgs/msg/TwistStamped', ['twist.linear.x'], [0.5])
    assert (stamped.twist.linear.x, stamped.header.stamp.sec) == (0.5, 7)


def test_joints_by_name():
    message = made('sensor_msgs/msg/JointState', ['velocity'], [1.0, 2.0], ('a', 'b'))
    assert (message.name, list(message.velocity)) == (['a', 'b'], [1.0, 2.0])
    both = ['position', 'velocity']
    message = made('sensor_msgs/msg/JointState', both, [1.0, 2.0, 3.0, 4.0], ('a', 'b'))
    assert (list(message.position), list(message.velocity)) == ([1.0, 2.0], [3.0, 4.0])


def test_a_point_of_a_trajectory_with_the_time_that_a_step_has():
    kind = 'trajectory_msgs/msg/JointTrajectory'
    message = made(kind, ['points[0].positions'], [1.0, 2.0], ('a', 'b'))
    (point,) = message.points
    assert (message.joint_names, list(point.positions)) == (['a', 'b'], [1.0, 2.0])
    assert point.time_from_start.nanosec == 50_000_000


def test_an_element_of_a_list():
    message = made('std_msgs/msg/Float64MultiArray', ['data[2]', 'data[0]'], [1.0, 2.0])
    assert list(message.data) == [2.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ('kind', 'fields', 'numbers', 'said'),
    [
        ('no_msgs/msg/Thing', ['data'], [1.0], 'type no_msgs/msg/Thing cannot be imported'),
        ('std_msgs/msg/Thing', ['data'], [1.0], 'std_msgs/msg/Thing cannot be imported'),
        ('geometry_msgs/msg/Twist', ['linear.w'], [1.0], "there is no 'w' in x, y, z"),
        ('geometry_msgs/msg/Twist', ['linear'], [1.0], 'is a geometry_msgs/Vector3, no flo'),
        ('geometry_msgs/msg/Twist', ['linear.x'], [1.0, 2.0], 'cannot hold the 2 numbers'),
        ('geometry_msgs/msg/Twist', ['linear[0].x'], [1.0], 'is no list'),
        ('std_msgs/msg/String', ['data'], [1.0], 'is a string, no floating'),
        ('std_msgs/msg/Int32', ['data'], [1.0], 'is a int32, no floating-point number'),
        (
            'sensor_msgs/msg/JointState',
            ['position', 'velocity'],
            [1.0, 2.0, 3.0],
            'cannot hold the 3 numbers',
        ),
    ],
)
def test_what_a_type_cannot_hold_is_refused(kind, fields, numbers, said):
    with pytest.raises(NodeError, match=said.replace('[', r'\[')):
        made(kind, fields, numbers)


def test_services_have_classes_too():
    assert message_class('std_srvs/srv/Trigger').__name__ == 'Trigger'
