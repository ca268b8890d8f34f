"""A node's connection to ROS: one rclpy node, its executor, its topics. Callbacks only store
messages; the main loop handles them.

The events executor's `spin_once` runs exactly one callback. So messages are drained until the
count of callbacks stands still. Blocking in it costs nothing (0.3 % of a core at 50 ms), and a
message wakes it.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher

from codetr_ros.bags.definitions import decode_sent, encode, stamp_of
from codetr_ros.config import Settings
from codetr_ros.nodes.signing import is_signed, key_of, signed
from codetr_ros.records import TOPICS, Record
from codetr_ros.records.shown import shown
from codetr_ros.ros import messages, qos
from codetr_ros.ros.plots import Plots
from codetr_ros.ros.signing import new_instance

UNDECODABLE = (rclpy_implementation.RCLError, rclpy_implementation.RMWError, UnicodeDecodeError)
"""What the executor raises for a request, or an answer, that is none. Callbacks of ours only store
what arrived, and raise nothing.
"""

SERVICES = 'services'
"""The name under which requests and answers that cannot be decoded are counted: the middleware
does not name their service.
"""

RECORDS_OF_TOPIC = {topic: record_type for record_type, topic in TOPICS.items()}


class Link:
    """Publishes records and holds the messages that arrived.

    Attributes:
        instance: id of this start of the node, the sender of all its messages.
        key: with which they are signed; None: not at all.
        refuse: counts and logs what is refused of services, by the name of the service.

    Args:
        name: the node's name unless it is remapped.
    """

    def __init__(self, name: str) -> None:
        self.node = Node(name)
        self.instance = new_instance()
        self.key = key_of()
        self._stamp = 0  # of the newest message [ns]
        self._executor = EventsExecutor()
        self._executor.add_node(self.node)
        self._publishers: dict[str, Publisher] = {}
        self._topics: dict[type, str] = {}
        self._diagnostics = self.node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._plots = Plots(self.node)
        self._events = 0
        self.inbox: deque[Callable[[], None]] = deque()
        self.published: Counter[str] = Counter()
        self.refuse: Callable[[str, Exception], None] = self._log_refusal

    @property
    def full_name(self) -> str:
        """Fully qualified name, such as /run/sim."""
        return str(self.node.get_fully_qualified_name())

    @property
    def name(self) -> str:
        """Name within the namespace of the run."""
        return str(self.node.get_name())

    def host(self, node: Node) -> None:
        """Let another node of this process have its turns with this one."""
        self._executor.add_node(node)

    def release(self, node: Node) -> None:
        """Take such a node off the graph."""
        self._executor.remove_node(node)
        node.destroy_node()

    def store(self, handle: Callable[..., None], *arguments: Any) -> None:
        """For callbacks: let the main loop call `handle` at its next turn."""
        self._events += 1
        self.inbox.append(lambda: handle(*arguments))

    def subscribe(
        self,
        record_type: type,
        handle: Callable[[type, bytes], None],
        settings: Settings | None = None,
    ) -> None:
        """Let the main loop call `handle(record_type, data)` for each message on the topic of a
        kind of record.

        The middleware decodes nothing: in its callbacks, bytes that are no message would end the
        node.

        Args:
            record_type: the kind of record.
            handle: gets the bytes of each message as they came.
            settings: the settings of the run, for the depth of the queue.
        """
        topic = TOPICS[record_type]
        self.node.create_subscription(
            messages.message_type(record_type),
            topic,
            # no message info: the events executor of this version fails on callbacks that take it
            lambda data: self.store(handle, record_type, data),
            qos.profile(topic, settings),
            raw=True,
        )

    def advertise(self, topics: Iterable[str], settings: Settings | None = None) -> None:
        """Create the publishers of these topics that do not exist yet."""
        for topic in topics:
            if topic not in self._publishers:
                message_type = messages.message_type(RECORDS_OF_TOPIC[topic])
                self._publishers[topic] = self.node.create_publisher(
                    message_type, topic, qos.profile(topic, settings)
                )

    def publish(self, record: Record) -> int:
        """Publish a record on its topic and count it; returns its stamp [ns]."""
        self.send(TOPICS[type(record)], self.message(record))
        self._plots.publish(record)
        return self._stamp

    def message(self, record: Record, stamp: int | None = None) -> bytes:
        """The bytes of a record's message, signed if the run has a key.

        Args:
            record: the record.
            stamp: when it was published [ns], if it is sent again. None: now. No two stamps are
                the same, and none is before another, even if the clock is set back: receivers
                refuse what is older than what they have, and count each message once.
        """
        if stamp is None:
            stamp = self._stamp = max(self.node.get_clock().now().nanoseconds, self._stamp + 1)
        data = encode(record, stamp, sender=self.instance)
        if self.key is None:
            return data
        return signed(self.key, self.topic(type(record)), data)

    def is_signed(self, kind: type, data: bytes) -> bool:
        """Whether a message has the signature that the nodes of this run ask for."""
        return self.key is None or is_signed(self.key, self.topic(kind), data)

    def signed_again(self, kind: type, data: bytes) -> bytes:
        """A message of this node's own bag, with the signature that the nodes of this run ask for:
        a run that goes on has another key than before.
        """
        if self.key is None or self.is_signed(kind, data):
            return data
        record, sender = decode_sent(kind, data)
        unsigned = encode(record, stamp_of(data), sender=sender)
        return signed(self.key, self.topic(kind), unsigned)

    def topic(self, record_type: type) -> str:
        """The full name of the topic of a kind of record."""
        if record_type not in self._topics:
            self._topics[record_type] = self.node.resolve_topic_name(TOPICS[record_type])
        return self._topics[record_type]

    def send(self, topic: str, data: bytes) -> None:
        """Publish the bytes of a message, and count it."""
        self._publishers[topic].publish(data)
        self.published[topic] += 1

    def diagnose(self, level: bytes, message: str, counters: dict[str, dict[str, int]]) -> None:
        """Publish the counts of messages on /diagnostics."""
        values = [
            KeyValue(key=f'{kind} {topic}', value=str(n))
            for kind, by_topic in counters.items()
            for topic, n in sorted(by_topic.items())
        ]
        status = DiagnosticStatus(
            level=level,
            name=f'{self.full_name}: messages',
            message=message,
            hardware_id=self.name,
            values=values,
        )
        stamp = self.node.get_clock().now().to_msg()
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp
        self._diagnostics.publish(array)

    def drain(self, wait: float = 0.0) -> None:
        """Run the callbacks of everything that has arrived.

        Args:
            wait: seconds to block for something to arrive, if nothing has.
        """
        try:
            if wait:
                self._executor.spin_once(timeout_sec=wait)
            while True:
                seen = self._events
                self._executor.spin_once(timeout_sec=0)
                if self._events == seen:
                    return
        except UNDECODABLE as error:
            self.refuse(SERVICES, RuntimeError(f'undecodable message: {shown(str(error))}'))

    def _log_refusal(self, what: str, error: Exception) -> None:
        self.node.get_logger().error(f'refused on {what!r}: {error}')

    def handle(self, wait: float = 0.0) -> None:
        """Handle everything that has arrived, in the main loop.

        Args:
            wait: seconds to block for something to arrive, if nothing has.
        """
        self.drain(wait)
        while self.inbox:
            self.inbox.popleft()()

    def unmatched(
        self, topics: Iterable[str], names: Callable[[str], set[str]], readers: bool
    ) -> list[str]:
        """Nodes that should read (or write) our topics and that the middleware has not matched
        yet, in words.

        Args:
            topics: relative names.
            names: returns the fully qualified names of the nodes that must be there, by topic.
            readers: whether they should read these topics; else they should write them.
        """
        unmatched = []
        for topic in topics:
            wanted = names(topic)
            full = self.node.resolve_topic_name(topic)
            ask = (
                self.node.get_subscriptions_info_by_topic
                if readers
                else self.node.get_publishers_info_by_topic
            )
            there = (
                {f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in ask(full)}
                if wanted
                else set()
            )
            verb = 'reads' if readers else 'publishes'
            unmatched += [
                f'{name} (not seen yet that it {verb} {full!r})' for name in sorted(wanted - there)
            ]
        return unmatched

    def unacknowledged(self) -> list[str]:
        """Topics on which a reader has not yet confirmed that it has everything."""
        return [
            topic
            for topic, publisher in self._publishers.items()
            if not publisher.wait_for_all_acked(Duration())
        ]

    def close(self) -> None:
        """Take the node off the graph."""
        # the executor holds what it waited for last; let go of after the node, it may crash
        self._executor.shutdown()
        self.node.destroy_node()


OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
