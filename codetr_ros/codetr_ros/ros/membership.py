"""A node's place in a run: its identity, its run and the other nodes."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codetr_ros.bags.definitions import stamp_of
from codetr_ros.config import Settings
from codetr_ros.cores.core import Core
from codetr_ros.nodes import leaving
from codetr_ros.nodes.admission import Admission
from codetr_ros.nodes.announced_run import SecondRunError, is_new
from codetr_ros.nodes.catching_up import Fetcher
from codetr_ros.nodes.errors import NodeError, first_cause
from codetr_ros.nodes.outbox import Outbox
from codetr_ros.nodes.patience import Limit, Patience
from codetr_ros.nodes.peers import GAVE_UP, Peers
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.records import Commit, Presence, Record, RecordError, RunSpec
from codetr_ros.records.bounds import LONGEST_DOING
from codetr_ros.records.roles import READ_BY_ITSELF, published_by
from codetr_ros.ros import given, link, parameters
from codetr_ros.ros.fetch import askers
from codetr_ros.ros.link import Link
from codetr_ros.ros.own_parameters import core_parameters
from codetr_ros.ros.resend import serve_outbox
from codetr_ros.ros.signals import Stop
from codetr_ros.system.files import FileError, check_makeable

PRESENCE_EVERY = 1.0  # [s] between two messages of presence and diagnostics
HEARS_FOR = 0.05
"""Seconds to block for the last presences of others."""
HEARS_OUT = 20
"""How often: a second, if nothing comes."""


class Membership:
    """A node among the others of its run: it publishes its presence, notes theirs, and takes the
    records that they publish.

    Attributes:
        role: one of `records.ROLES`.
        stop: true once the process is asked to stop.
        link: the node's connection to ROS.
        log: the node's logger.
        peers: the other nodes.
        traffic: hands records to the node's core and counts them.
        company: members in the same process, which take their turns with this one.
        values: the node's own parameters, once they are declared.
        run: the run, once it is known.
        announcement: the bytes that announced the run; none in the node that made it.
        begun: whether all peers have been present; from then on, a conflict with another node or
            run is logged and ends no node.
        over: whether it has done everything, and publishes nothing more but its presence.
        doing: what the node does now, for people.
        waits_since: monotonic time [s] since which it has waited for that; None while it works.
        outside: why nothing that the node publishes would be taken, so that it only looks on;
            empty: it takes part.
        deadline_is: what the user sets `deadline` with, for errors.
        again: what the user does once the obstacle is gone, for errors.

    Args:
        role: one of `records.ROLES`.
        name: node name unless remapped.
        stop: true once the process is asked to stop.
        arguments: the command line from which the node has its parameters.
        kind: the name under which its own parameters are listed; None: that of its role.
    """

    def __init__(
        self,
        role: str,
        name: str,
        stop: Stop,
        arguments: Sequence[str] = (),
        kind: str | None = None,
    ) -> None:
        self.role = role
        self._kind = kind or role
        self.stop = stop
        self._arguments = arguments
        self.link = Link(name)
        self.log = self.link.node.get_logger()
        self.peers = Peers(role)
        admission = Admission(self.link.topic, self.link.key, self._silence)
        self.traffic = Traffic(self.log, admission=admission)
        self.link.refuse = self.traffic.refuse
        self.company: list[Membership] = []
        self.values: dict[str, Any] = {}
        self.run: RunSpec | None = None
        self.announcement = b''
        self.begun = False
        self.over = False
        self.doing = 'starting'
        self.deadline_is, self.again = Limit.setting, Limit.again
        self.waits_since: float | None = None
        self.outside = ''
        self._serves = False  # the core is made from the run's settings
        self._fetcher: Fetcher | None = None
        self._outbox: Outbox | None = None
        self._logged: set[str] = set()  # errors that are logged once
        self._presence_at = 0.0
        self._cause = ''  # why it has given up

    @property
    def folder(self) -> Path | None:
        """The folder of the run; None if the node was given none."""
        return Path(self.values['folder']) if self.values.get('folder') else None

    @property
    def core_values(self) -> dict[str, Any]:
        """The node's own parameters with which its core is made."""
        return {name: self.values[name] for name in core_parameters(self._kind)}

    @property
    def deadline(self) -> float:
        """Seconds to wait for peers; 0: for ever."""
        return float(self.values['peer_deadline'])

    def _silence(self) -> float:
        """Seconds of silence after which the place of a peer is free; 0: never."""
        return float(self.values.get('peer_deadline', 0.0))

    @property
    def limit(self) -> Limit:
        """How long this node waits for others."""
        return Limit(self.deadline, self.deadline_is, self.again)

    def patience(self, topics: Sequence[str]) -> Patience:
        """What watches over this node while it waits for records on these topics."""
        settings = self.traffic.settings
        outside = settings is not None and settings.on_robot
        who, left_out = self.link.full_name, self.traffic.left_out
        return Patience(who, self.peers, topics, self.limit, self.log, outside, left_out)

    def introduce(self) -> None:
        """Declare the node's own parameters, and subscribe to presences and runs.

        Raises:
            ParameterError: one of them is unknown, of the wrong type or out of range.
            NodeError: nothing can be written where one of them points to.
        """
        given.check_names(self.link.node, self._kind, self._arguments)
        self.values = parameters.declare_own(self.link.node, self._kind)
        self.link.advertise(['presence'])
        self.link.subscribe(Presence, self.take)
        self.link.subscribe(RunSpec, self.take)
        self._check_folders()
        checkpoint = self.values.get('checkpoint')
        if checkpoint and not Path(checkpoint).is_dir():
            raise NodeError(
                f'{self.link.full_name}: parameter checkpoint = {checkpoint!r}: there is no such '
                'folder. Give that of a checkpoint, of a fit or of a run'
            )

    def _check_folders(self) -> None:
        """Refuse a folder in which nothing can be written, now rather than at the end of a phase.

        Raises:
            NodeError: names the parameter, its value, the reason and the remedy.
        """
        for name in ('folder', 'bag'):
            if not (value := self.values.get(name)):
                continue
            try:
                check_makeable(Path(value))
            except FileError as error:
                self.values[name] = ''  # there, the report of the node cannot be written either
                raise NodeError(
                    f'{self.link.full_name}: parameter {name} = {value!r}: {error}'
                ) from None

    def serve(self, core: Core[Any], settings: Settings | None = None) -> None:
        """Hand records to a core from now on, and fetch again those that it lacks.

        Args:
            core: the node's.
            settings: those of the run, which bound what is handed over.
        """
        self.traffic.core, self.traffic.settings = core, settings
        self.traffic.admission.settings = settings
        self.peers.know(settings, self.link.name)
        self._serves = True
        if self.run is not None:
            self.traffic.run_id = self.run.run_id
        if self.run is not None:
            make, take = askers(self.link, self.run.run_id), self.traffic.take_again
            phases = Commit in core.subscribes
            self._fetcher = Fetcher(make, self.peers, take, self.log, phases)

    def keep_published(self, settings: Settings) -> None:
        """Keep what the node publishes from now on for a while, and send it again on request."""
        assert self.run is not None
        self._outbox = Outbox.of(self.role, settings)
        serve_outbox(self.link, self.run.run_id, self._outbox)

    def publish(self, record: Record) -> None:
        """Publish a record of the node's core."""
        assert not self.outside
        stamp = self.link.publish(record)
        if self._outbox is not None:
            self._outbox.keep(record, stamp)

    def catch_up(self, newest: int) -> None:
        """Fetch all phases up to a committed one that the core has not taken in."""
        core: Any = self.traffic.core
        core.catch_up(newest)
        if self._fetcher is not None:
            self._fetcher.behind = newest

    def release(self) -> None:
        """Hand over what was held back while the node joined, and what comes from now on."""
        self.traffic.release(self._later)

    def begin_counting_anew(self) -> None:
        """Count as lost only what is published from now on and never arrives."""
        self.traffic.ledger.forgive()

    def note_own(self) -> None:
        """Note what this node has published that it receives itself."""
        own = {topic: self.link.published[topic] for topic in READ_BY_ITSELF.get(self.role, ())}
        if own:
            self.traffic.ledger.note_own(self.link.instance, own, time.monotonic())

    def turn(self, wait: float = 0.0) -> None:
        """Give ROS its turn: take what arrived, and publish the presence when it is due.

        Args:
            wait: seconds to block for something to arrive, if nothing has.
        """
        self.link.handle(wait)
        self.traffic.expire()
        if time.monotonic() - self._presence_at >= PRESENCE_EVERY:
            self.publish_presence()
        if self._fetcher is not None and self.begun and not self.runs_away:
            self._fetcher.check(self.traffic.core)
        for other in self.company:
            other.turn()

    # ---- records

    def take(self, kind: type, data: bytes) -> None:
        """Take the bytes of a message of any kind that arrived."""
        record = self.traffic.decode(kind, data, self.take)
        if record is None:
            return
        try:
            if isinstance(record, Presence):
                self._note_peer(record, stamp_of(data))
            elif isinstance(record, RunSpec):
                self._note_run(record, data)
            elif not self._later(record):
                self.traffic.receive(record)
        except RecordError as error:
            self.traffic.refuse(kind, error)

    def _later(self, record: Record) -> bool:
        later = self._fetcher is not None and self._fetcher.later(record, self.traffic.core)
        if later:
            self.traffic.ledger.set_aside(record)
        return later

    @property
    def runs_away(self) -> bool:
        """Whether this node learns phases again, faster than the learner does, and would soon let
        go of labels that the learner lacks.
        """
        if self._fetcher is None or self._outbox is None:
            return False
        return self._fetcher.runs_away(self.traffic.core, self._outbox)

    @property
    def asked_for(self) -> dict[str, float]:
        """Topics of what the core lacks and that is asked for, and since when that is in vain [s,
        monotonic].
        """
        return {} if self._fetcher is None else self._fetcher.asked_for

    # ---- runs and peers

    def _note_run(self, spec: RunSpec, data: bytes) -> None:
        try:
            new = is_new(spec, self.run, self.values['run_id'], self.link.full_name)
        except SecondRunError as error:
            if self.role == 'learner' and not self.begun:
                raise NodeError(str(error)) from None
            raise
        self.traffic.received['run'] += 1
        if new:
            self.run, self.announcement = spec, data

    def _note_peer(self, presence: Presence, stamp: int) -> None:
        if presence.instance_id == self.link.instance:
            return
        own = self.run.run_id if self.run else ''
        if own and presence.run_id not in ('', own):
            self._log_once(
                f'{presence.role} {presence.node} is part of another run, {presence.run_id!r}; '
                f'this is {own!r}'
            )
            return
        if presence.node == self.link.full_name and not presence.finished:
            problem = (
                f'two nodes are called {presence.node}: start one of them with another name '
                '(--ros-args -r __node:=other)'
            )
            if not self.begun:
                raise NodeError(problem)
            self._log_once(problem)
            return
        now = time.monotonic()
        news = self.peers.note(presence, now)
        if news:
            self.log.info(news)
        self.traffic.ledger.note(presence, stamp, now)
        self.note_own()

    def _log_once(self, text: str) -> None:
        if text not in self._logged:
            self._logged.add(text)
            self.log.error(text)

    def give_up(self, error: BaseException | str) -> None:
        """Let the other nodes know, by the presences to come, that this one has failed, and the
        first cause of it.
        """
        for each in (self, *self.company):
            each._serves = False  # noqa: SLF001 - members of the same process
            each._cause = each._cause or first_cause(  # noqa: SLF001
                error, f'{each.role} {each.link.full_name}'
            )

    def publish_presence(self) -> None:
        """Publish the node's presence, and the counts of its messages on /diagnostics."""
        finished = self.over
        last = f'{GAVE_UP}{self._cause}' if self._cause else 'has finished'
        self._presence_at = time.monotonic()
        if self.outside:
            return
        topics = tuple(t for t in published_by(self.role) if t in self.link.published)
        counters = self.traffic.counters()
        self.link.publish(
            Presence(
                run_id=self.run.run_id if self.run else '',
                role=self.role,
                node=self.link.full_name,
                instance_id=self.link.instance,
                settings_hash=self.run.settings_hash if self.run and self._serves else '',
                finished=finished,
                topics=topics,
                published=np.array([self.link.published[t] for t in topics], np.uint64),
                missed=sum(counters['lost'].values()),
                doing=(last if finished else self.doing)[:LONGEST_DOING],
                waiting=self._waiting(finished),
            )
        )
        wrong = bool(counters['lost'] or counters['refused'])
        self.link.diagnose(
            link.WARN if wrong else link.OK,
            last if finished else self.doing,
            {'published': dict(self.link.published)} | counters,
        )

    def _waiting(self, finished: bool) -> float:
        """Seconds for which the node has waited; 0 while it works."""
        if finished or self.waits_since is None:
            return 0.0
        return time.monotonic() - self.waits_since

    def hear_out(self) -> None:
        """Take the last presences of nodes whose processes have ended: they may still be on their
        way. Of one that was lost, its report takes the place.
        """
        self.link.handle()
        for _ in range(HEARS_OUT):  # so that it does not matter how long this process is held
            if not self.peers.gone():
                return
            self.link.handle(HEARS_FOR)
        if self.folder is not None:
            leaving.take_reports(self.peers, self.folder, time.monotonic())

    def close(self) -> None:
        """Take the node and its company off the graph."""
        for other in self.company:
            other.close()
        self.link.close()
