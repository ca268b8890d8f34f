"""The nodes of a run, started one by one with what `ros2 run` gives them, and a witness in their
namespace that hears everything and can say anything.
"""

import json
import os
import re
import signal
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from domain_coordinator import domain_id
from rclpy.parameter_client import AsyncParameterClient
from rclpy.signals import SignalHandlerOptions

from codetr_ros.bags.definitions import decode_sent
from codetr_ros.config import Settings
from codetr_ros.nodes.signing import VARIABLE, is_signed, key_of
from codetr_ros.processes import launcher
from codetr_ros.records import TOPICS, Commit, CompositeReward, Presence, Record, RecordError
from codetr_ros.records.roles import published_by, read_by
from codetr_ros.ros import messages, qos
from codetr_ros.ros.link import Link
from codetr_ros.runs import folder as run_folder
from helpers import forked

PATIENCE = 240.0  # [s] a busy machine starts five nodes in 40, and may stand still for 20
PEER_DEADLINE = 2 * PATIENCE  # [s] a test gives up before others do on a node that it holds
RUN_ID = 'run'
NAMESPACE = f'/run_{RUN_ID}'


@contextmanager
def domain() -> Iterator[None]:
    """A ROS domain for processes that several tests share."""
    before = os.environ.get('ROS_DOMAIN_ID')
    with domain_id() as number:
        os.environ['ROS_DOMAIN_ID'] = str(number)
        try:
            yield
        finally:
            del os.environ['ROS_DOMAIN_ID']
            if before is not None:
                os.environ['ROS_DOMAIN_ID'] = before


class Nodes:
    """The processes of a run. A context manager: on leaving it, none is left.

    Args:
        settings: of the run.
        folder: of the run.
        start: starts them: forked, or `launcher.start_program`.
        key: that of the run, as its environment variable has it; None: there is none.
    """

    def __init__(
        self,
        settings: Settings,
        folder: Path,
        start: launcher.Start = forked.start_program,
        key: str | None = None,
    ) -> None:
        self.settings = settings
        self.key = key
        self.folder = run_folder.create(folder)
        run_folder.write_settings(folder, settings)
        made = launcher.commands(settings, RUN_ID, folder, peer_deadline=PEER_DEADLINE)
        self.names = tuple(command.name for command in made)
        first = next(command for command in made if command.role == 'sim')
        made += [
            launcher.Command(name, 'sim', (*first.arguments, '-r', f'__node:={name}'))
            for name in settings.joiners
        ]
        self._commands = {command.name: command for command in made}
        self._environment = launcher.environment(settings) | ({VARIABLE: key} if key else {})
        self._processes = launcher.Processes(print, start_program=start)

    def role(self, name: str) -> str:
        """The role of a node."""
        return self._commands[name].role

    def start(self, name: str, *parameters: str, file: Path | None = None) -> None:
        """Start a node, with parameters such as `delay:=9` beside those of `codetr train`, or with
        a parameter file.
        """
        made = self._commands[name]
        more = [word for parameter in parameters for word in ('-p', parameter)]
        more += ['--params-file', str(file)] if file else []
        command = launcher.Command(name, made.role, (*made.arguments, *more))
        self._processes.start([command], self.folder / run_folder.LOGS, self._environment)

    def start_before(self, witness: 'Witness') -> None:
        """Start all nodes, the evaluator once the witness misses nothing that the others publish:
        nobody begins without it, and a short run is over before a visitor has found everybody.
        """
        first = [name for name in self.names if name != 'evaluate']
        for name in first:
            self.start(name)
        witness.until(lambda: witness.follows(first))
        self.start('evaluate')

    def send(self, number: signal.Signals, *names: str) -> None:
        """Send a signal to nodes; to all of them if none is named."""
        for node in self._processes.running():
            if not names or node.name in names:
                os.kill(node.process.pid, number)

    def codes(self) -> dict[str, int | None]:
        """Exit codes by name, None for those that run."""
        return {node.name: node.code for node in self._processes.nodes}

    def is_stopped(self, name: str) -> bool:
        """Whether the process of a node stands still because of a signal."""
        (node,) = [node for node in self._processes.running() if node.name == name]
        stat = Path(f'/proc/{node.process.pid}/stat').read_text()
        return stat.rsplit(')', 1)[1].split()[0] == 'T'

    def memory(self) -> dict[str, int]:
        """Resident memory [bytes] of the nodes that run, by name."""
        found = {}
        for node in self._processes.running():
            text = Path(f'/proc/{node.process.pid}/status').read_text()
            if resident := re.findall(r'VmRSS:\s+(\d+) kB', text):  # else it has just ended
                found[node.name] = 1024 * int(resident[0])
        return found

    def readers(self, kind: type) -> set[str]:
        """Names of the nodes that run and read what is published of a kind of record."""
        labelled = self.settings.labels_steps
        return {
            name
            for name, code in self.codes().items()
            if code is None
            and name in self.names
            and (kind is Presence or kind in read_by(self.role(name), labelled))
        }

    def wait(self, *names: str) -> dict[str, int | None]:
        """Wait until nodes have ended, all of them if none is named; their exit codes."""
        end = time.monotonic() + PATIENCE
        for node in self._processes.nodes:
            if not names or node.name in names:
                node.process.wait(max(0.1, end - time.monotonic()))
        return self.codes()

    def log(self, name: str) -> str:
        """What a node has said."""
        return (self.folder / run_folder.LOGS / f'{name}.log').read_text()

    def report(self, name: str) -> dict[str, Any]:
        """The report that a node has left."""
        role = self._commands[name].role
        return json.loads(run_folder.report_path(self.folder, role, name).read_text())

    def __enter__(self) -> 'Nodes':
        return self

    def __exit__(self, *_: object) -> None:
        self._processes.kill(self._processes.running())


class Witness:
    """A node in the namespace of the run that is no part of it.

    Attributes:
        followed: kinds of records of which `follows` asks that none is missed.

    Args:
        nodes: whose death ends the waiting.
    """

    followed: tuple[type, ...] = (Presence, Commit, CompositeReward)

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        self.presence: dict[str, Presence] = {}
        self.commits: list[Commit] = []
        self.scores: list[CompositeReward] = []
        self.counters: dict[str, dict[str, str]] = {}

    def __enter__(self) -> 'Witness':
        rclpy.init(
            args=['witness', '--ros-args', '-r', f'__ns:={NAMESPACE}'],
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.link = Link('witness')
        self.link.subscribe(Presence, self._hear)
        self.link.subscribe(Commit, self._committed)
        self.link.subscribe(CompositeReward, self._scored)
        self.link.node.create_subscription(
            DiagnosticArray,
            '/diagnostics',
            lambda array: self.link.store(self._diagnosed, array),
            10,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()
        rclpy.try_shutdown()

    def sound(self, kind: type, data: bytes) -> list[Any]:
        """The record in the bytes of a message of a node of the run; nothing if they are none."""
        key = key_of({VARIABLE: self._nodes.key or ''})
        if key is not None and not is_signed(key, self.link.topic(kind), data):
            return []
        try:
            record, sender = decode_sent(kind, data)
        except RecordError:
            return []
        return [] if sender == self.link.instance else [record]

    def _hear(self, kind: type, data: bytes) -> None:
        for said in self.sound(kind, data):
            self.presence[said.node.rsplit('/', 1)[1]] = said

    def _committed(self, kind: type, data: bytes) -> None:
        self.commits.extend(self.sound(kind, data))

    def _scored(self, kind: type, data: bytes) -> None:
        self.scores.extend(self.sound(kind, data))

    def _diagnosed(self, array: DiagnosticArray) -> None:
        for status in array.status:
            values = {value.key: value.value for value in status.values}
            self.counters[status.hardware_id] = values

    def until(self, found: Callable[[], Any]) -> Any:
        """Listen until `found()` is true; what it returns."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self.link.handle(0.05)
            if result := found():
                return result
        logs = '\n'.join(
            f'--- {path.name}\n{path.read_text()[-2000:]}'
            for path in sorted((self._nodes.folder / run_folder.LOGS).glob('*.log'))
        )
        raise AssertionError(f'not within {PATIENCE:g} s; codes {self._nodes.codes()}\n{logs}')

    def listen(self, seconds: float) -> None:
        """Listen for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.link.handle(min(left, 0.05))

    def follows(self, names: Collection[str]) -> bool:
        """Whether all that these nodes publish, of what is read here, arrives."""
        roles = {name: self._nodes.role(name) for name in names}
        topics = [TOPICS[kind] for kind in self.followed]

        def writers(topic: str) -> set[str]:
            return {
                f'{NAMESPACE}/{name}'
                for name, role in roles.items()
                if topic == TOPICS[Presence] or topic in published_by(role)
            }

        return not self.link.unmatched(topics, writers, readers=False)

    def committed(self, phase: int) -> bool:
        """Whether a phase is committed."""
        return any(commit.phase >= phase for commit in self.commits)

    def say(self, *records: Record) -> None:
        """Publish records as if this were a node of the run, once all readers are matched."""
        self.say_bytes(*((type(record), self.link.message(record)) for record in records))

    def say_bytes(self, *said: tuple[type, bytes]) -> None:
        """Publish bytes on the topics of kinds of records, once all readers are matched."""
        publishers = {}
        for kind in dict.fromkeys(kind for kind, _ in said):
            topic = TOPICS[kind]
            publishers[kind] = self.link.node.create_publisher(
                messages.message_type(kind), topic, qos.profile(topic)
            )

        def matched(kind: type) -> bool:
            readers = self.readers(TOPICS[kind])
            due = self._nodes.readers(kind) <= readers  # else one is not even discovered yet
            return due and publishers[kind].get_subscription_count() == len(readers) > 0

        self.until(lambda: all(map(matched, publishers)))
        for kind, data in said:
            publishers[kind].publish(data)

    def readers(self, topic: str) -> set[str]:
        """Names of the nodes that subscribe to a topic of the run."""
        full = self.link.node.resolve_topic_name(topic)
        return {info.node_name for info in self.link.node.get_subscriptions_info_by_topic(full)}

    def parameters(self, node: str) -> dict[str, tuple[Any, Any]]:
        """A node's parameters through the services that `ros2 param` uses: value and descriptor
        by name.
        """
        client = AsyncParameterClient(self.link.node, f'{NAMESPACE}/{node}')
        self.until(client.services_are_ready)

        def answer(future: Any) -> Any:
            self.until(future.done)
            return future.result()

        names = sorted(answer(client.list_parameters()).result.names)
        values = answer(client.get_parameters(names)).values
        descriptors = answer(client.describe_parameters(names)).descriptors
        return {
            name: (rclpy.parameter.parameter_value_to_python(value), descriptor)
            for name, value, descriptor in zip(names, values, descriptors, strict=True)
        }
