"""The node that faces the robot: its topics, its command, and the services for people.

It is a lifecycle node beside that of the run or of the policy, in the same process and thread:
unconfigured, inactive once the robot's topics are there, active while it sends commands. Callbacks
store what arrived; only a stop acts at once.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from codetr_ros.nodes.errors import NodeError
from codetr_ros.records import F64
from codetr_ros.robots.driving import Driving
from codetr_ros.ros.commands import CommandMessages, message_class
from codetr_ros.ros.link import Link

DONE = TransitionCallbackReturn.SUCCESS
SENSOR_DEPTH = 10
SENSOR = QoSProfile(depth=SENSOR_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches reliable and best-effort publishers; what is older than ten messages is of no use."""
LAST_COMMAND = 0.5  # [s] to wait at the end for the robot to have received the safe command
SCORES_DEPTH = 1000
"""Scores are few, and each counts."""


class Driver(LifecycleNode):  # type: ignore[misc]
    """The topics and services of a robot.

    Attributes:
        types: the type of each topic that is subscribed to, once they are open.
        expected: the types that topics must have, by name; the others may have any.
        refusal: why the robot may not be driven yet; empty if it may.

    Args:
        link: the connection of the node beside it, which gives this one its turns.
        robot: what drives it.
    """

    def __init__(self, link: Link, robot: Driving) -> None:
        simulated = link.node.get_parameter('use_sim_time').value
        super().__init__(
            f'{link.name}_driver',
            namespace=link.node.get_namespace(),
            use_global_arguments=False,
            parameter_overrides=[Parameter('use_sim_time', value=simulated)],
        )
        self._link = link
        self._robot = robot
        self.types: dict[str, str] = {}
        self.expected: Mapping[str, str] = {}
        self.refusal = ''
        self._configured = False
        self._messages: CommandMessages | None = None
        self._publisher: Any = None
        self._reset: Any = None
        for name, kind, answer in (
            ('stop', Trigger, self._stop),
            ('resume', Trigger, self._resume),
            ('ready', Trigger, self._ready),
            ('pause', SetBool, self._pause),
        ):
            self.create_service(kind, f'~/{name}', answer)
        link.host(self)

    # ---- topics

    def topics(self) -> set[str]:
        """Full names of the topics whose types must be known."""
        live = self._robot.rules.live
        assert live is not None
        wanted = {*self._robot.senses.topics, self._robot.rules.episode.topic}
        wanted.add(live.watchdog.heartbeat)
        if self._robot.rules.score is not None:
            wanted.add(self._robot.rules.score.topic)
        return {topic for topic in wanted if topic is not None}

    def lacking(self) -> list[str]:
        """The topics that nobody publishes yet, in words; a simulated clock among them."""
        there = dict(self.get_topic_names_and_types())
        clock = self.get_clock()
        lacks_time = clock.ros_time_is_active and not clock.now().nanoseconds
        waits = ['the time on /clock, which use_sim_time asks for'] if lacks_time else []
        return waits + [
            f'a node that publishes {topic}, which the mapping names'
            for topic in sorted(self.topics())
            if not there.get(topic)
        ]

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the robot's topics.

        Raises:
            NodeError: a type is not installed, or a command cannot be made of it.
        """
        if lacking := self.lacking():
            self.get_logger().error(f'cannot be configured: waits for {"; ".join(lacking)}')
            return TransitionCallbackReturn.FAILURE
        if not self._configured:
            self._open()
        self._configured = True
        return DONE

    def _open(self) -> None:
        rules, live = self._robot.rules, self._robot.rules.live
        assert live is not None
        types = dict(self.get_topic_names_and_types())
        _check_command(types, rules.action.topic, live.command.type)
        size = self._robot.control.limiter.size
        self._messages = CommandMessages(rules.action, live.command, size, live.period)
        self._publisher = self.create_publisher(self._messages.type, rules.action.topic, 1)
        self._robot.send = self.send
        self.types = {t: self.expected.get(t, types[t][0]) for t in self.topics()}
        for topic in sorted(self._robot.senses.topics):
            self._subscribe(topic, self._sensed)
        if rules.episode.topic:
            self._subscribe(rules.episode.topic, self._ended)
        if rules.score is not None:
            topic = rules.score.topic
            self._subscribe(topic, self._scored, self._lossless(topic))
        heartbeat = live.watchdog.heartbeat
        if heartbeat:
            self._subscribe(heartbeat, self._beat)
        if live.stop.topic:
            self.create_subscription(Bool, live.stop.topic, self._stop_message, SENSOR)
        if live.reset.service:
            self._reset = self.create_client(message_class(live.reset.type), live.reset.service)
            self._robot.ask_for_reset = self._ask_for_reset

    def _subscribe(
        self, topic: str, handle: Callable[..., None], quality: QoSProfile = SENSOR
    ) -> None:
        def store(message: Any) -> None:
            self._link.store(handle, topic, message, self._robot.clock())

        self.create_subscription(message_class(self.types[topic]), topic, store, quality)

    def _lossless(self, topic: str) -> QoSProfile:
        """A quality under which nothing is lost, if all who publish on a topic offer it."""
        offered = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
        reliable = all(q.reliability == ReliabilityPolicy.RELIABLE for q in offered)
        kind = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        return QoSProfile(depth=SCORES_DEPTH, reliability=kind)

    def _sensed(self, topic: str, message: Any, now: float) -> None:
        self._robot.senses.take(topic, message, now)

    def _ended(self, topic: str, message: Any, now: float) -> None:
        self._robot.episode_message(message)

    def _scored(self, topic: str, message: Any, now: float) -> None:
        self._robot.score_message(topic, message, now)

    def _beat(self, topic: str, message: Any, now: float) -> None:
        self._robot.guard.heartbeat(now)

    def send(self, command: F64) -> None:
        """Send a command (A,) to the robot."""
        assert self._messages is not None
        stamp = self.get_clock().now().to_msg()
        self._publisher.publish(self._messages.make(command, stamp))

    # ---- stop, pause, reset

    def _stop_message(self, message: Any) -> None:
        self._robot.stop_message(bool(message.data))

    def _stop(self, request: Any, response: Any) -> Any:
        self._robot.stop('the service `stop` was called')
        response.success, response.message = True, 'stopped; `resume` lets it go on'
        return response

    def _resume(self, request: Any, response: Any) -> Any:
        refused = self._robot.guard.resume()
        response.success, response.message = refused is None, refused or 'it may go on'
        return response

    def _pause(self, request: Any, response: Any) -> Any:
        self._robot.guard.paused = bool(request.data)
        response.success, response.message = True, 'paused' if request.data else 'it may go on'
        return response

    def _ready(self, request: Any, response: Any) -> Any:
        response.success = self._robot.control.reset.person_is_ready()
        response.message = (
            'the next episode begins' if response.success else 'no reset by a person is due'
        )
        return response

    def _ask_for_reset(self) -> None:
        reset = self._robot.control.reset
        if not self._reset.service_is_ready():
            reset.answered(False, f'nobody offers {self._reset.srv_name}')
            return
        future = self._reset.call_async(self._reset.srv_type.Request())
        future.add_done_callback(lambda done: self._link.store(self._answered, done))

    def _answered(self, done: Any) -> None:
        answer = done.result()
        success = getattr(answer, 'success', True)  # std_srvs/Empty states nothing
        self._robot.control.reset.answered(success, getattr(answer, 'message', ''))

    # ---- lifecycle

    # rclpy raises where a transition is not possible now, and whoever asked gets no answer
    def _LifecycleNodeMixin__change_state(self, transition: int) -> TransitionCallbackReturn:  # noqa: N802
        try:
            return super()._LifecycleNodeMixin__change_state(transition)
        except rclpy_implementation.RCLError as error:
            self.get_logger().error(f'refused transition {transition}: {error}')
            return TransitionCallbackReturn.FAILURE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drive the robot."""
        if self.refusal:
            self.get_logger().error(f'cannot be activated: {self.refusal}')
            return TransitionCallbackReturn.FAILURE
        self._robot.activate()
        self.get_logger().info('the robot is driven from now on')
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send the safe command once more, then none."""
        self._robot.leave_active()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Keep the topics: the run knows the robot by them until it ends."""
        return DONE

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Leave the robot with the safe command."""
        self._robot.close()
        return DONE

    def close(self) -> None:
        """Take the node off the graph, once the robot has the last command."""
        if self._publisher is not None:
            # with the publisher, what has not arrived yet would be gone
            self._publisher.wait_for_all_acked(Duration(seconds=LAST_COMMAND))
        self._link.release(self)


def _check_command(types: Mapping[str, list[str]], topic: str, wanted: str) -> None:
    """Refuse to command a robot that takes commands of another type: none would arrive.

    Raises:
        NodeError: names the topic, both types and the remedy.
    """
    there = types.get(topic, [])
    if there and wanted not in there:
        raise NodeError(
            f'{topic} is of type {", ".join(there)} here, and the mapping commands it with '
            f'live.command.type = {wanted}: correct the mapping, or start the driver of that robot'
        )


def shown(topics: Iterable[str]) -> str:
    """Topics, for the log."""
    return ', '.join(sorted(topics))
