"""The one main loop of all nodes: join the run, wait for everybody, then receive, work and publish
in slices.

    drain what arrived -> core.receive -> one slice of core.work -> publish -> again

Nothing is learnt in a callback and no thread spins beside the learner. A node answers (signals,
parameters, its presence) between two slices, so within the length of one: `sac.burst` updates in
the learner, one gradient step or the labels of some hundred segments in the reward node, one chunk
of each environment in a simulator, one episode in the evaluator. While it waits it answers within
50 ms.
"""

import gc
import logging
import os
import resource
import time
import traceback
from collections.abc import Callable, Iterable
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from codetr_ros.processes import middleware
from codetr_ros.records import TOPICS, Record
from codetr_ros.ros import errors, signals
from codetr_ros.ros.joining import IDLE, Joining
from codetr_ros.ros.member import MakeCore
from codetr_ros.ros.patience import Patience
from codetr_ros.ros.signals import Stop
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports
from codetr_ros.runs.reports import BagReport, CoreReport

ACK_DEADLINE = 5.0  # [s] at the end for readers that have not everything yet
STOPPED_DEADLINE = 0.1  # [s] the same when the process was asked to stop
SHUTDOWN_DEADLINE = 8  # [s] for the middleware to let go, once everything is saved and said:
# well before `launcher.STOP_DEADLINE`, which counts from the signal on
LAST_WORDS = 5  # times that the last presence is said: so many make the middleware ask for answers


class CoreNode(Joining):
    """A core, wired to ROS."""

    def run(self) -> int:
        """Everything, from the parameters to the last word; returns the exit code of the
        process.
        """
        error: str | None = None
        try:
            if self._join() and self._gather():
                self._work()
        except Exception as problem:  # noqa: BLE001 - the report and the last word must go out
            self._sound = self._sound and errors.explains_itself(problem)
            error = errors.in_words(problem)
            self._say_fatal(problem)
        return self._end(error)

    def _say_fatal(self, problem: Exception, when: str = '') -> None:
        """Say an error: in its own words, or where it happened if it has none."""
        own = errors.explains_itself(problem)
        self.log.fatal(f'{when}{problem if own else traceback.format_exc()}')

    def _work(self) -> None:
        assert self.core is not None
        work = self.core.work()
        topics = [TOPICS[kind] for kind in self.core.subscribes]
        patience = Patience(
            self.link.full_name,
            self.role,
            topics,
            self.peers,
            self.values['peer_deadline'],
            self.log,
        )
        waiting: float | None = None  # since when
        while not self.stop:
            self._turn()
            self._sound = False  # until the slice has ended well
            records = next(work)
            for record in records or ():
                self.deliver(record)
            self._sound = True
            if records is not None:
                waiting = None
                self._doing = 'works'
                continue
            now = time.monotonic()
            waiting = now if waiting is None else waiting
            if self.core.finished:
                self._doing = 'has finished'
                if self.settled(now - waiting):
                    return
            else:
                self._doing = self._waits()
                patience.check(now, now - waiting, self._doing, self.lost())
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

    def closing(self) -> None:
        """Finish what the node itself holds open, once nothing more will arrive."""

    def own_report(self) -> BagReport | None:
        """What the node adds to the core's report."""
        return None

    def _end(self, error: str | None) -> int:
        """Save, report, say goodbye; returns the exit code."""
        finished = bool(self.core and self.core.finished and error is None)
        steps: list[Callable[[], None]] = [
            self.closing,
            lambda: self._report(finished, error),
            self._goodbye,
        ]
        if self.core is not None and self._sound:  # half a slice is not fit to be saved
            steps.insert(0, self.core.close)
        for step in steps:
            try:
                step()
            except Exception as problem:  # noqa: BLE001 - one failure must not stop the rest
                error = error or errors.in_words(problem)
                self._say_fatal(problem, 'at the end: ')
        if self.stop.signal and not error and not finished:
            self.log.info(f'stopped by {self.stop.signal.name}')
        code = 1 if error else 0
        try:
            self.stop.end_within(SHUTDOWN_DEADLINE, code)
        except OSError as problem:
            self.log.warning(f'nothing will end this process if its middleware hangs: {problem}')
        self.let_go()
        return code

    def let_go(self) -> None:
        """Take everything that is the node's off the graph: last of all."""
        self.link.close()

    def _report(self, finished: bool, error: str | None) -> None:
        if self.folder is None:
            return
        used = resource.getrusage(resource.RUSAGE_SELF)
        report = reports.node_report(
            self.core.report() if self.core else CoreReport(),
            role=self.role,
            name=self.link.name,
            published={t: n for t, n in self.link.published.items() if t != 'presence'},
            received=self.received,
            refused=self.refused,
            lost=self.lost(),
            fetched=self.recovered,
            cpu_s=used.ru_utime + used.ru_stime,
            wall_s=time.monotonic() - self._started,
            finished=finished,
            error=error,
            own=self.own_report(),
        )
        reports.write(run_folder.report_path(self.folder, self.role, self.link.name), report)

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
    for variable, value in middleware.DEFAULTS.items():
        os.environ.setdefault(variable, value)
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
