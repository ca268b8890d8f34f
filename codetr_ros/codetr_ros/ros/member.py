"""What a node of a run says and hears: presence, the run, records, and what never reached it."""

import hashlib
import secrets
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import (
    PROTOCOL_VERSION,
    TOPICS,
    Commit,
    Presence,
    Record,
    RecordError,
    RunSpec,
    describe,
)
from codetr_ros.records.roles import published_by
from codetr_ros.ros import link, messages
from codetr_ros.ros.errors import NodeError
from codetr_ros.ros.fetch import Fetcher
from codetr_ros.ros.link import Link
from codetr_ros.ros.peers import Ledger, Peers
from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.cores.core import Core

MakeCore = Callable[..., 'Core']
"""Makes the core of a node: (run, settings, name within the run, folder of checkpoints or None),
and by name those of the node's own parameters that `parameters.CORE_OF_ROLE` lists."""

TELL_EVERY = 1.0  # [s] between two words of presence and diagnostics


class Member:
    """A node among the others of a run.

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
        self.recovered: Counter[str] = Counter()  # lost, and come when asked for again
        self._ledger = Ledger()
        self._fetcher: Fetcher | None = None
        self._begun = False
        self._sound = True  # the core is between two slices, fit to be saved
        self._doing = 'starting'
        self._said: dict[str, float] = {}
        self._told_at = 0.0
        self._started = time.monotonic()

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
        if record_type not in (Presence, RunSpec):
            self.received[TOPICS[record_type]] += 1  # sound or not, it is not lost
        try:
            record = messages.from_message(message)
            if isinstance(record, Presence):
                self._hear(record)
            elif isinstance(record, RunSpec):
                self._hear_run(record)
            else:
                self._receive(record)
        except RecordError as error:
            self.refuse(record_type, error)

    def _receive(self, record: Record) -> bool:
        """Hand a record to the core; whether it was new and taken."""
        assert self.core is not None
        before = sum(self._duplicated().values())
        try:
            self.core.receive(record)
        except RecordError as error:
            self.refuse(type(record), error)
            return False
        return sum(self._duplicated().values()) == before

    def _receive_again(self, record: Record) -> None:
        """Hand over a record that came because it was asked for; what is new was lost before."""
        # who asks for what a commit names has the commit
        if self._receive(record) and not isinstance(record, Commit):
            self.recovered[TOPICS[type(record)]] += 1

    def _duplicated(self) -> 'Counter[str]':
        return getattr(self.core, 'duplicated', None) or Counter()

    def _refused(self) -> 'Counter[str]':
        """What was refused when it came, and what the core refused later."""
        return self.refused + Counter(getattr(self.core, 'refused', None) or {})

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

    def lost(self) -> dict[str, int]:
        """Records that peers said they published a while ago and that have not come, by topic;
        not those that came when they were asked for again.
        """
        wanted = {TOPICS[t] for t in self.core.subscribes} if self.core else set()
        lost = self._ledger.lost(self.received + self.recovered, time.monotonic())
        return {topic: n for topic, n in lost.items() if topic in wanted}

    def _tell(self, finished: bool = False) -> None:
        self._told_at = time.monotonic()
        topics = tuple(t for t in published_by(self.role) if t in self.link.published)
        spec = self.run_spec
        lost = self.lost()
        self.link.publish(
            Presence(
                run_id=spec.run_id if spec else '',
                role=self.role,
                node=self.link.full_name,
                instance_id=self._instance,
                settings_hash=spec.settings_hash if spec and self.core else '',
                finished=finished,
                topics=topics,
                published=np.array([self.link.published[t] for t in topics], np.uint64),
                missed=sum(lost.values()),
            )
        )
        counters = {
            'published': dict(self.link.published),
            'received': dict(self.received),
            'lost': lost,
            'duplicated': dict(self._duplicated()),
            'refused': dict(self._refused()),
        }
        wrong = bool(lost or counters['refused'])
        self.link.diagnose(
            link.WARN if wrong else link.OK, 'has finished' if finished else self._doing, counters
        )
