"""Watches a run from outside, for progress and summary: presence, task, episodes, metrics and
commits of a namespace.
"""

from collections.abc import Callable
from functools import partial
from types import TracebackType

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from codetr_ros.nodes.signing import is_signed
from codetr_ros.nodes.traffic import arrived
from codetr_ros.records import (
    TOPICS,
    Commit,
    EpisodeResult,
    Metrics,
    Presence,
    Record,
    RecordError,
    RunSpec,
    TaskSpec,
)
from codetr_ros.ros import messages, qos
from codetr_ros.ros.link import UNDECODABLE

WATCHED = (RunSpec, Presence, TaskSpec, Commit, EpisodeResult, Metrics)
"""Records that show how a run is going; the data themselves are left alone."""
DEPTH = 10_000
"""A fixed depth: the settings, which decide how much may be under way, are not known yet."""


class Watcher:
    """Hands every record that shows how a run is going to a function. A context manager.

    It has a ROS context of its own, handles no signals, and no node counts it as a peer.

    Args:
        on_record: called by `poll`, in the thread that polls.
        namespace: namespace of the run, such as '/run_1'.
        name: node name.
        key: that of the run, with which all that is handed over must be signed; None: it need not.
    """

    def __init__(
        self,
        on_record: Callable[[Record], None],
        namespace: str,
        name: str = 'watch',
        key: bytes | None = None,
    ) -> None:
        self._key = key
        self._topics: dict[type, str] = {}
        self._on_record = on_record
        self._namespace = namespace
        self._name = name
        self._inbox: list[tuple[type, bytes]] = []
        self._events = 0
        self.refused = 0

    def __enter__(self) -> 'Watcher':
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node(
            self._name,
            context=self._context,
            namespace=self._namespace,
            use_global_arguments=False,
        )
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        for kind in WATCHED:
            self._topics[kind] = self._node.resolve_topic_name(TOPICS[kind])
            durable = qos.QUALITIES[TOPICS[kind]].transient_local
            self._node.create_subscription(
                messages.message_type(kind),
                TOPICS[kind],
                partial(self._store, kind),
                QoSProfile(
                    depth=DEPTH,
                    reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL
                    if durable
                    else DurabilityPolicy.VOLATILE,
                ),
                raw=True,
            )
        return self

    def _store(self, kind: type, data: bytes) -> None:
        self._events += 1
        self._inbox.append((kind, data))

    def poll(self, timeout: float) -> int:
        """Wait at most `timeout` seconds until something arrives, and hand over all that has.

        Returns:
            How many messages arrived.
        """
        try:
            self._executor.spin_once(timeout_sec=timeout)
            while True:
                seen = self._events
                self._executor.spin_once(timeout_sec=0)
                if self._events == seen:
                    break
        except ExternalShutdownException:
            return 0
        except UNDECODABLE:
            self.refused += 1
        came, self._inbox = self._inbox, []
        for kind, data in came:
            try:
                if self._key and not is_signed(self._key, self._topics[kind], data):
                    raise RecordError('not signed with the key of the run')
                record, _ = arrived(kind, data)
            except RecordError:
                self.refused += 1
                continue
            self._on_record(record)
        return len(came)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        self._executor.shutdown()
        self._context.try_shutdown()
