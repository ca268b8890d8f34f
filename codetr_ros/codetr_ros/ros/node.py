"""The one main loop of all nodes: join the run, wait for everybody, then receive, work and publish
in slices.

    drain what arrived -> core.receive -> one slice of core.work -> publish -> again

Nothing is learnt in a callback and no thread spins beside the learner. A node answers (signals,
parameters, its presence) between two slices, so within the length of one: `sac.burst` updates in
the learner, one gradient step or `codetr.label_batch` segments in the reward node, one chunk in a
simulator, one episode in the evaluator. While it waits it answers within 50 ms.
"""

import gc
import hashlib
import logging
import resource
import secrets
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions

from codetr_ros import run_folder
from codetr_ros.bags.writer import BagError
from codetr_ros.config import Settings, SettingsError, from_canonical
from codetr_ros.records import (
    PROTOCOL_VERSION,
    TOPICS,
    Presence,
    Record,
    RecordError,
    RunSpec,
    describe,
)
from codetr_ros.ros import link, messages, parameters, signals
from codetr_ros.ros.fetch import Fetcher
from codetr_ros.ros.link import Link
from codetr_ros.ros.peers import READERS, WRITERS, Ledger, Peers, needed, published_by
from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.in_process import Core

MakeCore = Callable[[RunSpec, Settings, str, Path | None], 'Core']
"""Makes the core of a node: (run, settings, name within the run, folder of checkpoints or
None)."""

IDLE = 0.05  # [s] blocked in the executor while there is nothing to do: the longest a signal waits
TELL_EVERY = 1.0  # [s] between two words of presence and diagnostics
NAME_EVERY = 5.0  # [s] between two complaints about the same peers
GRACE = 10.0  # [s] for what a peer published before it finished
ACK_DEADLINE = 5.0  # [s] at the end for readers that have not everything yet
STOPPED_DEADLINE = 0.1  # [s] the same when the process was asked to stop
LAST_WORDS = 5  # times that the last presence is said: so many make the middleware ask for answers

CANNOT_FINISH_BEFORE: dict[str, tuple[str, ...]] = {
    'sim': ('learner',),
    'evaluate': ('learner',),
    'reward': ('record',),
    'learner': ('reward', 'record'),
    'record': ('sim', 'learner'),
}
"""Roles that have finished only if they were stopped, as long as a node of this role still waits
for something."""


class NodeError(RuntimeError):
    """The node cannot go on: the message names who or what is in the way and the remedy."""


class CoreNode:
    """A core, wired to ROS.

    Args:
        role: one of `records.ROLES`.
        name: node name unless remapped.
        load_core: imports what is slow to import (seconds) and returns what makes the core. Called
            once the run is known, so that a learner announces its run before, and all import at
            the same time.
        stop: true once the process is asked to stop.
    """

    def __init__(
        self, role: str, name: str, load_core: Callable[[], MakeCore], stop: Stop
    ) -> None:
        self.role = role
        self.stop = stop
        self._load_core = load_core
        self._instance = secrets.token_hex(8)
        self.link = Link(name)
        self.log = self.link.node.get_logger()
        self.peers = Peers(role)
        self.run_spec: RunSpec | None = None
        self.settings: Settings | None = None
        self.core: Core | None = None
        self.values: dict[str, Any] = {}
        self.folder: Path | None = None
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._ledger = Ledger()
        self._fetcher: Fetcher | None = None
        self._begun = False
        self._doing = 'starting'
        self._said: dict[str, float] = {}
        self._told_at = 0.0
        self._started = time.monotonic()

    # ---- the life of a node

    def run(self) -> int:
        """Everything, from the parameters to the last word; returns the exit code of the
        process.
        """
        error: str | None = None
        crashed = False
        try:
            if self._join() and self._gather():
                self._work()
        except (
            NodeError,
            parameters.ParameterError,
            SettingsError,
            BagError,
            run_folder.RunFolderError,
        ) as problem:
            error = str(problem)
            self.log.fatal(error)
        except Exception as problem:  # noqa: BLE001 - the report and the last word must go out
            crashed = True
            error = f'{type(problem).__name__}: {problem}'
            self.log.fatal(traceback.format_exc())
        return self._end(error, crashed)

    def _join(self) -> bool:
        """Know the run: make it (the learner) or wait for it. False if asked to stop meanwhile."""
        parameters.check_names(self.link.node, self.role)
        self.values = parameters.declare_own(self.link.node, self.role)
        self.folder = Path(self.values['folder']) if self.values['folder'] else None
        self.link.advertise(['presence'])
        self.link.subscribe(Presence, self._take)
        self.link.subscribe(RunSpec, self._take)
        if self.role == 'learner':
            self.settings = parameters.own_settings(self.link.node, self.values['config'])
            run_id = (
                self.values['run_id'] or f'{time.strftime("%Y%m%d-%H%M%S")}-{secrets.token_hex(2)}'
            )
            self.run_spec = self.settings.run_spec(run_id)
        self._tell()
        wanted = f'run {self.values["run_id"]!r}' if self.values['run_id'] else 'a run'
        topic = self.link.node.resolve_topic_name('run')
        remedy = 'start `ros2 run learner_node learner` in this namespace'

        def lacks() -> list[str]:
            return (
                []
                if self.run_spec
                else [f'the learner, which announces {wanted} on {topic!r} ({remedy})']
            )

        if not self._wait_for(lacks):
            return False
        self._enter()
        return True

    def _enter(self) -> None:
        """Take the run's settings, make the core, open the topics."""
        assert self.run_spec is not None
        node = self.link.node
        if self.settings is None:
            owners = [
                f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                for info in node.get_publishers_info_by_topic(node.resolve_topic_name('run'))
            ]
            owner = f'learner {" or ".join(owners) or "of the run"}'
            self.settings = from_canonical(
                self.run_spec.settings, f'run {self.run_spec.run_id!r} of {owner}'
            )
            parameters.check_against_run(node, self.settings, owner)
        parameters.declare_settings(node, self.settings)
        self._tell()
        if self.role == 'learner':
            self.link.advertise(['run'], self.settings)
            self.link.publish(self.run_spec)
        make_core = self._load_core()
        if 'torch' in sys.modules:  # the recorder has no torch and needs none
            sys.modules['torch'].set_num_threads(self.settings.threads)
        if (
            self.role == 'learner'
            and self.folder
            and not (self.folder / run_folder.CONFIG).exists()
        ):
            self.folder.mkdir(parents=True, exist_ok=True)
            run_folder.write_settings(self.folder, self.settings)
        checkpoints = self.folder / run_folder.CHECKPOINTS if self.folder else None
        self.core = make_core(self.run_spec, self.settings, self.link.name, checkpoints)
        self.link.advertise(published_by(self.role), self.settings)
        self.open_topics(self.settings)
        if hasattr(self.core, 'missing'):
            self._fetcher = Fetcher(self.link, self.run_spec.run_id, self._receive)
        self.log.info(
            f'run {self.run_spec.run_id}: task {self.settings.task}, method {self.settings.method}'
        )
        self._tell()

    def open_topics(self, settings: Settings) -> None:
        """Subscribe to what the core wants."""
        assert self.core is not None
        for record_type in self.core.subscribes:
            self.link.subscribe(record_type, self._take, settings)

    def _gather(self) -> bool:
        """Wait until everybody is there and matched. False if asked to stop meanwhile."""
        if not self._wait_for(self._lacking):
            return False
        self._begun = True
        self.log.info('everybody is there')
        return True

    def _lacking(self) -> list[str]:
        assert self.settings is not None
        assert self.run_spec is not None
        absent = self.peers.absent(self.settings, self.run_spec.settings_hash)
        if absent:
            return absent
        reads = [topic for topic, roles in READERS.items() if self.role in roles]
        return self.link.unmatched(
            published_by(self.role), self._names(READERS), readers=True
        ) + self.link.unmatched(reads, self._names(WRITERS), readers=False)

    def _names(self, table: dict[str, tuple[str, ...]]) -> Callable[[str], set[str]]:
        assert self.settings is not None
        roles = set(needed(self.settings))

        def names(topic: str) -> set[str]:
            wanted = [role for role in table[topic] if role in roles]
            return {peer.said.node for role in wanted for peer in self.peers.alive(role)}

        return names

    def _wait_for(self, lacks: Callable[[], list[str]]) -> bool:
        """Wait until nothing is lacking, naming what is; False if asked to stop meanwhile."""
        began = named = time.monotonic()
        deadline = self.values['peer_deadline']
        while not self.stop:
            self._turn(IDLE)
            missing = lacks()
            if not missing:
                return True
            now = time.monotonic()
            doing = f'waits for {"; ".join(missing)}'
            if doing != self._doing:  # somebody has come: the others have their time anew
                self._doing = doing
                began = named = now
            if deadline and now - began > deadline:
                raise NodeError(
                    f'{self.link.full_name} gave up after {deadline:g} s: it {self._doing}. '
                    f'Parameter peer_deadline makes it wait longer'
                )
            if now - named >= NAME_EVERY:
                named = now
                self.log.warning(f'{now - began:.0f} s: {self._doing}')
        return False

    def _work(self) -> None:
        assert self.core is not None
        work = self.core.work()
        waiting: float | None = None  # since when
        while not self.stop:
            self._turn()
            records = next(work)
            if records is not None:
                waiting = None
                self._doing = 'works'
                for record in records:
                    self.deliver(record)
                continue
            now = time.monotonic()
            waiting = now if waiting is None else waiting
            if self.core.finished:
                self._doing = 'has finished'
                if self.settled(now - waiting):
                    return
            else:
                self._doing = self._waits()
                self._check_peers(now, now - waiting)
            self._turn(IDLE)

    def _waits(self) -> str:
        say = getattr(self.core, 'waiting_for', None)
        return f'waits for {say()}' if say else 'waits for messages'

    def deliver(self, record: Record) -> None:
        """Pass on a record that the core yielded."""
        self.link.publish(record)

    def settled(self, seconds: float) -> bool:
        """Whether a node whose core has finished `seconds` ago may end."""
        return True

    # ---- what arrives

    def _turn(self, wait: float = 0.0) -> None:
        """Let ROS have its turn: take what arrived, say that we are there."""
        self.link.drain(wait)
        while self.link.inbox:
            self.link.inbox.popleft()()
        if time.monotonic() - self._told_at >= TELL_EVERY:
            self._tell()
        if self._fetcher is not None and self._begun:
            self._fetcher.check(getattr(self.core, 'missing', None))

    def _take(self, record_type: type, message: Any) -> None:
        try:
            record = messages.from_message(message)
            if isinstance(record, Presence):
                self._hear(record)
            elif isinstance(record, RunSpec):
                self._hear_run(record)
            else:
                self.received[TOPICS[record_type]] += 1
                self._receive(record)
        except RecordError as error:
            self.refuse(record_type, error)

    def _receive(self, record: Record) -> None:
        assert self.core is not None
        try:
            self.core.receive(record)
        except RecordError as error:
            self.refuse(type(record), error)

    def refuse(self, record_type: type, error: RecordError) -> None:
        """Count and say that a record was refused; of many, a few are said."""
        topic = TOPICS[record_type]
        self.refused[topic] += 1
        n = self.refused[topic]
        if n <= 10 or n % 1000 == 0:
            self.log.error(f'refused on {topic!r} (number {n}): {error}')

    def _hear_run(self, spec: RunSpec) -> None:
        own = self.run_spec
        if own is not None and spec.run_id == own.run_id:
            return
        if spec.protocol_version != PROTOCOL_VERSION:
            raise RecordError(
                f'{describe(spec)}: run {spec.run_id!r} speaks protocol_version '
                f'{spec.protocol_version}, '
                f'{self.link.full_name} speaks {PROTOCOL_VERSION}: install the same version of '
                f'codetr_ros everywhere'
            )
        if hashlib.sha256(spec.settings.encode()).hexdigest() != spec.settings_hash:
            raise RecordError(
                f'run {spec.run_id!r}: settings_hash {spec.settings_hash!r} is not that of its '
                f'settings: '
                f'install the same version of codetr_ros everywhere'
            )
        if own is not None:
            problem = (
                f'a second run in the namespace of {self.link.full_name}: {spec.run_id!r} '
                f'beside {own.run_id!r}. '
                f'Stop one of them, or give each run a namespace of its own (--ros-args -r '
                f'__ns:=/other)'
            )
            if self.role == 'learner' and not self._begun:
                raise NodeError(problem)
            raise RecordError(problem)
        if self.values['run_id'] not in ('', spec.run_id):
            raise RecordError(
                f'run {spec.run_id!r} is not the one that {self.link.full_name} was started for '
                f'(parameter run_id = {self.values["run_id"]!r}): leave run_id out, or start '
                f'that learner'
            )
        self.received['run'] += 1
        self.run_spec = spec

    def _hear(self, said: Presence) -> None:
        if said.instance_id == self._instance:
            return
        own = self.run_spec.run_id if self.run_spec else ''
        if own and said.run_id not in ('', own):
            self._say_once(
                f'{said.role} {said.node} is part of another run, {said.run_id!r}; this is {own!r}'
            )
            return
        if said.node == self.link.full_name and not said.finished:
            problem = (
                f'two nodes are called {said.node}: start one of them with another name '
                '(--ros-args -r __node:=other)'
            )
            if not self._begun:
                raise NodeError(problem)
            self._say_once(problem)
            return
        now = time.monotonic()
        news = self.peers.hear(said, now)
        if news:
            self.log.info(news)
        self._ledger.tell(self.peers.told(), now)

    def _say_once(self, text: str) -> None:
        if text not in self._said:
            self._said[text] = time.monotonic()
            self.log.error(text)

    # ---- what is said

    def lost(self) -> dict[str, int]:
        """Records that peers said they published a while ago and that have not come, by topic."""
        wanted = {TOPICS[t] for t in self.core.subscribes} if self.core else set()
        lost = self._ledger.lost(self.received, time.monotonic())
        return {topic: n for topic, n in lost.items() if topic in wanted}

    def _tell(self, finished: bool = False) -> None:
        self._told_at = time.monotonic()
        topics = tuple(t for t in published_by(self.role) if t in self.link.published)
        spec = self.run_spec
        lost = self.lost()
        self.link.publish(
            Presence(
                spec.run_id if spec else '',
                self.role,
                self.link.full_name,
                self._instance,
                spec.settings_hash if spec and self.core else '',
                finished,
                topics,
                np.array([self.link.published[t] for t in topics], np.uint64),
                sum(lost.values()),
            )
        )
        counters = {
            'published': dict(self.link.published),
            'received': dict(self.received),
            'lost': lost,
            'duplicated': dict(getattr(self.core, 'duplicated', {})),
            'refused': dict(self.refused),
        }
        wrong = bool(lost or self.refused)
        self.link.diagnose(
            link.WARN if wrong else link.OK, 'has finished' if finished else self._doing, counters
        )

    def _check_peers(self, now: float, waiting: float) -> None:
        """While we wait: name peers that fell silent, and give up on those that will not speak
        again.

        Raises:
            NodeError: a peer that we wait for is gone.
        """
        deadline = self.values['peer_deadline']
        topics = [TOPICS[t] for t in self.core.subscribes] if self.core else []
        for peer in self.peers.awaited(topics):
            silent = now - peer.heard
            if peer.said.finished or silent < 2 * NAME_EVERY:
                continue
            who = f'{peer.said.role} {peer.said.node}'
            if deadline and silent > deadline and waiting > deadline:
                raise NodeError(
                    f'{self.link.full_name} gave up: it {self._doing}, and {who} has been '
                    f'silent for {silent:.0f} s '
                    f'(parameter peer_deadline = {deadline:g}). Look at its log, and start the '
                    f'run again'
                )
            if now - self._said.get(who, 0.0) > NAME_EVERY:
                self._said[who] = now
                self.log.warning(f'{who} has been silent for {silent:.0f} s; {self._doing}')
        for role in CANNOT_FINISH_BEFORE[self.role]:
            gone = [peer for peer in self.peers.alive(role) if peer.said.finished]
            all_gone = gone and len(gone) == len(self.peers.alive(role))
            patience = GRACE if all_gone else max(GRACE, deadline)
            if gone and waiting > patience and all(now - peer.heard > GRACE for peer in gone):
                names = ', '.join(peer.said.node for peer in gone)
                raise NodeError(
                    f'{self.link.full_name} gave up: it {self._doing}, but {role} {names} '
                    f'stopped before the run was '
                    f'over. Look at its log, and start the run again'
                )

    # ---- the end

    def closing(self) -> None:
        """Finish what the node itself holds open, once nothing more will arrive."""

    def own_report(self) -> dict[str, Any]:
        """What the node adds to the core's report."""
        return {}

    def _end(self, error: str | None, crashed: bool) -> int:
        """Save, report, say goodbye; returns the exit code."""
        finished = bool(self.core and self.core.finished and error is None)
        steps: list[Callable[[], None]] = [
            self.closing,
            lambda: self._report(finished, error),
            self._goodbye,
        ]
        if self.core is not None and not crashed:  # after a crash its state is not fit to be saved
            steps.insert(0, self.core.close)
        for step in steps:
            try:
                step()
            except Exception as problem:  # noqa: BLE001 - one failure must not stop the rest
                error = error or f'{type(problem).__name__}: {problem}'
                self.log.fatal(f'at the end: {traceback.format_exc()}')
        if self.stop.signal and not error and not finished:
            self.log.info(f'stopped by {self.stop.signal.name}')
        self.link.close()
        return 1 if error else 0

    def _report(self, finished: bool, error: str | None) -> None:
        if self.folder is None:
            return
        used = resource.getrusage(resource.RUSAGE_SELF)
        report: dict[str, Any] = {
            'role': self.role,
            'name': self.link.name,
            'published': {t: n for t, n in self.link.published.items() if t != 'presence'},
            'received': dict(self.received),
            'refused': dict(self.refused),
            'lost': self.lost(),
            'peak_rss_mb': used.ru_maxrss / 1024,
            'cpu_s': used.ru_utime + used.ru_stime,
            'wall_s': time.monotonic() - self._started,
            'finished': finished,
            'error': error,
        }
        for said in (self.core.report() if self.core else {}, self.own_report()):
            for key, value in said.items():
                both = (
                    isinstance(value, dict)
                    and isinstance(report.get(key), dict)
                    and key != 'counters'
                )
                report[key] = dict(Counter(report[key]) + Counter(value)) if both else value
        run_folder.write_report(self.folder, self.role, self.link.name, report)

    def _goodbye(self) -> None:
        """Say the last word, and stay until the readers have everything or have finished too.

        A reader that lacks something is served again by this process only. The middleware asks
        whether it does with every few messages, else only every 3 s: waiting for its answer alone
        would make every run 3 s longer, and every stop.
        """
        if not self.values:
            return
        for _ in range(LAST_WORDS):
            self._tell(finished=True)
        end = time.monotonic() + (STOPPED_DEADLINE if self.stop else ACK_DEADLINE)
        while time.monotonic() < end and self.peers.anybody_left():
            if not self.link.unacknowledged():
                return
            self.link.drain(IDLE)
            while self.link.inbox:
                self.link.inbox.popleft()()
        late = self.link.unacknowledged()
        if late and self.peers.anybody_left() and not self.stop:
            self.log.warning(f'not everybody has received everything on {", ".join(late)}')


class _ToRos(logging.Handler):
    """Hands what the library logs to the node's logger."""

    def __init__(self, log: Any) -> None:
        super().__init__()
        self._log = log

    def emit(self, record: logging.LogRecord) -> None:
        # rclpy insists that one line of code logs with one severity
        if record.levelno >= logging.ERROR:
            self._log.error(self.format(record))
        elif record.levelno >= logging.WARNING:
            self._log.warning(self.format(record))
        else:
            self._log.info(self.format(record))


def run_node(
    role: str,
    name: str,
    load_core: Callable[[], MakeCore],
    argv: Iterable[str] | None = None,
    stop: Stop | None = None,
    node_class: type[CoreNode] = CoreNode,
) -> int:
    """The main function of a node.

    Args:
        role: one of `records.ROLES`.
        name: node name unless remapped.
        load_core: imports what is slow to import and returns what makes the core.
        argv: command line without the program; that of the process where None.
        stop: signals taken earlier; taken here where None.
        node_class: another wiring (the recorder's).

    Returns:
        Exit code: 0 also when stopped by SIGINT or SIGTERM, 1 after an error.
    """
    stop = stop or Stop().install()
    arguments = None if argv is None else [name, *argv]
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = node_class(role, name, load_core, stop)
        logging.getLogger('codetr_ros').addHandler(_ToRos(node.log))
        return node.run()
    finally:
        rclpy.try_shutdown()
        signals.ignore()
        gc.freeze()  # or the interpreter's last collection goes through all of torch: 2 to 7 s
