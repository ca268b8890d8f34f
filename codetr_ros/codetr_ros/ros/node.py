"""The one main loop of all nodes: join the run, wait for all peers, then receive, work and publish
in slices.

    drain what arrived -> core.receive -> one slice of core.work -> publish -> again

Nothing is learnt in a callback, and no thread spins beside the learner. A node answers (signals,
parameters, its presence) between two slices, so within the length of one: `sac.burst` updates in
the learner, one gradient step or the labels of some hundred segments in the reward node, one chunk
of each environment in a simulator, one episode in the evaluator. A waiting node answers within
50 ms.
"""

import logging
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from codetr_ros.nodes import errors
from codetr_ros.nodes.attention import Attention
from codetr_ros.nodes.waiting import Waiting
from codetr_ros.processes.launcher import ROBOT_NODE
from codetr_ros.records import TOPICS
from codetr_ros.ros import joining
from codetr_ros.ros.gathering import IDLE, wait_for
from codetr_ros.ros.joining import Joined, LoadCore
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.process import SHUTDOWN_DEADLINE, ToRos, in_ros
from codetr_ros.ros.reporting import Reporting
from codetr_ros.ros.signals import Stop, Stopped
from codetr_ros.ros.wiring import Wire, Wiring
from codetr_ros.runs import reports

ACK_DEADLINE = 5.0  # [s] at the end for readers that still lack something
STOPPED_DEADLINE = 0.5
"""The same [s] if the process was asked to stop. Who misses its leave takes it for dead."""
LAST_PRESENCES = 5  # enough for the middleware to request acknowledgements


class Node:
    """The main loop of a node.

    Args:
        member: its membership.
        join: makes it part of a run; None if asked to stop meanwhile.
        wire: wires the core, once it has joined.
    """

    def __init__(
        self, member: Membership, join: Callable[[Membership], Joined | None], wire: Wire
    ) -> None:
        self.member = member
        self._join = join
        self._wire = wire
        self._log = member.log
        self._sound = True  # the core is between two slices and can be saved
        self._reporting = Reporting(member)

    def run(self) -> int:
        """Do everything from the parameters to the last message; returns the exit code."""
        error: str | None = None
        wiring: Wiring | None = None
        try:
            joined = self._join(self.member)
            if joined is not None:
                wiring = self._wire(self.member, joined)
                wiring.enter()
                if self._gather(wiring) and wiring.go_on():
                    self._work(wiring)
        except Exception as problem:  # noqa: BLE001 - report and last presence must go out
            self._sound = self._sound and errors.explains_itself(problem)
            error = errors.in_words(problem)
            self.member.give_up(problem)
            self._log_fatal(problem)
        return self._end(wiring, error)

    def _log_fatal(self, problem: Exception, when: str = '') -> None:
        """Log an error by its message, or by its traceback if it does not explain itself."""
        own = errors.explains_itself(problem)
        self._log.fatal(f'{when}{problem if own else traceback.format_exc()}')

    def _gather(self, wiring: Wiring) -> bool:
        """Wait until all peers are present and matched. False if asked to stop meanwhile."""
        if not (
            wiring.complete() and wait_for(self.member, wiring.lacking, self.member.peers.cause)
        ):
            return False
        self.member.begun = True
        self._log.info('everybody is there')
        return True

    def _work(self, wiring: Wiring) -> None:
        member, core = self.member, wiring.joined.core
        work = core.work()
        patience = member.patience([TOPICS[kind] for kind in core.subscribes])
        attention = Attention()
        waiting = Waiting()
        worked = False  # the core has yielded something
        while not member.stop:
            member.turn()
            self._sound = False  # until the slice has ended well
            try:
                idle = member.runs_away or wiring.over()
                given = None if idle else self._slice(work, worked)
            except Stopped:
                return
            for each in given or ():
                wiring.deliver(each)
            self._sound = True
            wiring.show(given or (), member.doing)
            if given is not None:
                attention.was_away(time.monotonic())  # a slice may take long
                worked = True
                waiting.over()
                member.doing, member.waits_since = 'works', None
                continue
            now = time.monotonic()
            if (away := attention.was_away(now)) and waiting.since is not None:
                self._log.warning(f'was held for {away:.0f} s, in which it read nothing')
                wiring.held()
                waiting.over()
            member.doing = 'has finished' if core.finished else wiring.waits()
            seconds = waiting.seconds(member.doing, now)
            member.waits_since = waiting.since
            if not core.finished:
                lost, asked_for = member.traffic.lost(), wiring.asked_for()
                patience.check(now, seconds, member.doing, lost, asked_for)
            elif wiring.settled(seconds):
                return
            member.turn(wiring.pause())

    def _slice(self, work: Iterator[Any], worked: bool) -> Any:
        """One slice of a core. Before the core has yielded anything, a signal cuts it short: it
        may compile for half a minute, and there is nothing to be saved yet.

        Raises:
            Stopped: a signal did.
        """
        if worked:
            return next(work)
        with self.member.stop.cutting_short():
            return next(work)

    def _end(self, wiring: Wiring | None, error: str | None) -> int:
        """Save, report, take leave; returns the exit code."""
        stop = self.member.stop
        finished = wiring is not None and wiring.joined.core.finished and error is None
        if stop.signal and not finished:
            error = error or self._deserted(stop.signal)
        if error:
            self.member.give_up(error)
        steps: list[Callable[[], None]] = [
            lambda: self._reporting.write(wiring, finished, error),
            lambda: self._linger(finished),
            self._reporting.add_late_refusals,
            self._take_leave,
        ]
        if wiring is not None:
            steps.insert(0, wiring.close)
            if self._sound:  # half a slice is not fit to be saved
                steps.insert(0, wiring.joined.core.close)
        for step in steps:
            try:
                step()
            except Exception as problem:  # noqa: BLE001 - one failure must not stop the rest
                error = error or errors.in_words(problem)
                self._log_fatal(problem, 'at the end: ')
                self.member.give_up(problem)
        if stop.signal and not error and not finished:
            self._log.info(f'stopped by {stop.signal.name}')
        code = 1 if error else 0
        try:
            stop.end_within(SHUTDOWN_DEADLINE, code)
        except OSError as problem:
            self._log.warning(f'nothing will end this process if its middleware hangs: {problem}')
        self.member.close()
        return code

    def _deserted(self, number: signal.Signals) -> str | None:
        """Why the run had failed before a signal ended this node; None if it had not. Else a run
        whose simulator was killed would seem to have ended as its user wished.
        """
        member = self.member
        if not member.begun:
            return None
        member.hear_out()
        failed = member.peers.failed()
        if not failed:
            return None
        error = f'stopped by {number.name} before the run was over: {"; ".join(failed)}'
        self._log.error(f'{error}. Look at the log of that node')
        return error

    def _linger(self, finished: bool) -> None:
        """Stay until the recorder has finished: it, or a node that is started again, may lack what
        only this one can send.
        """
        member = self.member
        if not finished or member.role == 'record':
            return
        for each in (member, *member.company):
            each.over = True
        member.publish_presence()
        while not (member.stop or self._recorder_is_over()):
            member.turn(IDLE)

    def _recorder_is_over(self) -> bool:
        """Whether the recorder has finished, by presence or report, or is gone for good."""
        member = self.member
        if member.peers.waits_for_nobody('record', time.monotonic(), member.deadline):
            return True
        return member.folder is not None and reports.has_finished(member.folder, 'record')

    def _take_leave(self) -> None:
        """Publish the last presence, and stay until the readers have everything or have finished
        too.

        Only this process can send a reader again what it lacks. The middleware requests
        acknowledgements with every few messages, otherwise only every 3 s: waiting for that alone
        would make every run and every stop 3 s longer.
        """
        member, link = self.member, self.member.link
        for each in (member, *member.company):
            each.over = True
        for other in member.company:
            other.publish_presence()
        if not member.values:
            return
        for _ in range(LAST_PRESENCES):
            member.publish_presence()
        end = time.monotonic() + (STOPPED_DEADLINE if member.stop else ACK_DEADLINE)
        # everybody waits for the end of the recorder, though all have finished
        awaited = member.role == 'record' and not member.stop
        while time.monotonic() < end and (awaited or member.peers.anybody_left()):
            if not link.unacknowledged():
                return
            link.handle(IDLE)
        late = link.unacknowledged()
        if late and member.peers.anybody_left() and not member.stop:
            self._log.warning(f'not everybody has received everything on {", ".join(late)}')


def run_node(
    role: str,
    name: str,
    load_core: LoadCore,
    argv: Iterable[str] | None = None,
    stop: Stop | None = None,
    wire: Wire = Wiring,
    kind: str | None = None,
    looks_on: bool = False,
) -> int:
    """The main function of a node.

    Args:
        role: one of `records.ROLES`.
        name: node name unless remapped.
        load_core: does the slow imports and returns what makes the core.
        argv: command line without the program; None: that of the process.
        stop: handlers of signals that are installed already; None: install them here.
        wire: another wiring (the recorder's, a robot's).
        kind: the name under which its own parameters are listed; None: that of its role.
        looks_on: whether it may join a run that would take nothing of it (`Membership.outside`).

    Returns:
        Exit code: 0, also after SIGINT or SIGTERM unless other nodes had failed before; 1 after an
        error; 2 for arguments that ROS cannot read.
    """
    announce = joining.own_run if role == 'learner' else None

    def be_it(arguments: Sequence[str], stop: Stop) -> int:
        member = Membership(role, name, stop, arguments, kind)
        logging.getLogger('codetr_ros').addHandler(ToRos(member.log))
        join = partial(joining.join, load_core=load_core, announce=announce, looks_on=looks_on)
        return Node(member, join, wire).run()

    return in_ros(name, argv, stop, be_it, punctual=kind == ROBOT_NODE)
