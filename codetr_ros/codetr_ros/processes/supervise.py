"""Watches the processes of a run until it is over, however it ends."""

import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from codetr_ros.processes.launcher import Node, Processes
from codetr_ros.processes.restarts import Restarts
from codetr_ros.records import Presence, Record
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports

SILENCE_DEADLINE = 90.0
"""Seconds of silence after which the last nodes must have ended too."""
LEAVE_DEADLINE = 10.0
"""The same for nodes without which the run ends well: the others have waited for them before."""


class Interrupts:
    """Counts the user's requests to stop (SIGINT, SIGTERM), which then do not end the process.

    Attributes:
        count: how many there were.
        raising: raise KeyboardInterrupt from the second on, for code that rarely checks `count`.
    """

    def __init__(self) -> None:
        self.count = 0
        self.raising = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> 'Interrupts':
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def again(self) -> bool:
        """Whether the user has asked more than once."""
        return self.count > 1

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self.raising and self.again():
            raise KeyboardInterrupt


class Silence:
    """The time since the last record of a run. Presence does not count: hung nodes publish it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last = clock()

    def receive(self, record: Record) -> None:
        """Note a record."""
        if not isinstance(record, Presence):
            self.broken()

    def broken(self) -> None:
        """Begin anew: something has happened."""
        self._last = self._clock()

    @property
    def seconds(self) -> float:
        """Seconds since something last happened."""
        return self._clock() - self._last


def supervise(
    processes: Processes,
    poll: Callable[[], None],
    interrupts: Interrupts,
    silence: Silence,
    gave_up: Callable[[Node], str | None] = lambda node: None,
    deadline: float = SILENCE_DEADLINE,
    restarts: Restarts | None = None,
    over: Callable[[Node], bool] = lambda node: False,
    dispensable: Callable[[Node], bool] = lambda node: False,
    failed_at: Callable[[Node], float] = lambda node: 0.0,
) -> str | None:
    """Watch until every process has ended; start those again that were killed, and end all of them
    if one fails or the user asks.

    Args:
        processes: the processes of the run, started.
        poll: hands on what arrived, and waits a moment for more.
        interrupts: counts the user's requests to stop.
        silence: the time since the last record; `poll` feeds it.
        gave_up: for a node with exit code 0: returns why it ended before the run was over, or
            None.
        deadline: seconds of silence after which nodes that did not end with the others are
            ended.
        restarts: how often a node that was killed is started again; None: never.
        over: for a node that was killed: whether it had done all that the run needs of it.
        dispensable: whether the run goes on and ends well without a node that fails for good, or
            that does not end.
        failed_at: when a node has failed [s]: of several that have meanwhile, the first is named.

    Returns:
        Why the run failed; None if it finished or was interrupted.
    """
    restarts = restarts or Restarts(most=0)
    ended = 0
    while True:
        poll()
        if interrupts.count:
            processes.log('stopping: nodes end their slice and save (Ctrl-C again to hurry)')
            processes.stop()
            return _after_stop(processes)
        fallen = sorted((n for n in processes.nodes if n.unasked_failure), key=failed_at)
        failed = _start_again(processes, fallen, restarts, over, dispensable, silence)
        if failed is not None:
            died = failed.how_it_ended() + restarts.exhausted(failed.name, failed.code)
            return _stop_all(processes, died)
        running = processes.running()
        for node in processes.nodes:
            if node.code == 0 and not node.excused and (reason := gave_up(node)) is not None:
                if not dispensable(node):
                    return _stop_all(processes, reason)
                _excuse(processes, node, reason)
        if not running:
            return None
        if len(processes.nodes) - len(running) > ended:
            ended = len(processes.nodes) - len(running)
            silence.broken()
        if ended and all(dispensable(node) for node in running):
            if silence.seconds > min(deadline, LEAVE_DEADLINE):
                for node in running:
                    _excuse(processes, node, f'{node.name} did not end with the rest of the run')
                processes.kill(running)
        elif ended and silence.seconds > deadline:
            names = ', '.join(node.name for node in running)
            text = f'{names} did not end within {deadline:g} s after the rest of the run'
            return _stop_all(processes, text)


def _excuse(processes: Processes, node: Node, reason: str) -> None:
    node.excused = True
    processes.log(f'{reason}: the run goes on without it')


def _start_again(
    processes: Processes,
    fallen: Sequence[Node],
    restarts: Restarts,
    over: Callable[[Node], bool],
    dispensable: Callable[[Node], bool],
    silence: Silence,
) -> Node | None:
    """Start the nodes again that were killed and may be; the first that failed for good and is
    needed, if any.
    """
    for node in fallen:
        if over(node):
            node.excused = True
        elif restarts.permit(node.name, node.code):
            times = restarts.counts[node.name]
            processes.log(f'{node.how_it_ended()}: starting it again (number {times})')
            processes.start_again(node)
            silence.broken()
        elif dispensable(node):
            _excuse(
                processes, node, node.how_it_ended() + restarts.exhausted(node.name, node.code)
            )
        else:
            return node
    return None


def _stop_all(processes: Processes, reason: str) -> str:
    if left := processes.running():
        names = ', '.join(node.name for node in left)
        processes.log(f'{reason}: stopping {names}')
    processes.stop()
    return reason


def _after_stop(processes: Processes) -> str | None:
    """An interrupted run has failed only if a node ended in any other way than it should."""
    # SIGINT itself ends a process that does not handle it yet.
    clean = (0, -signal.SIGINT)
    odd = [node.how_it_ended() for node in processes.nodes if node.code not in clean]
    return '; '.join(odd) or None


def is_over(node: Node, folder: Path) -> bool:
    """Whether a node that was killed had done all that the run needs of it, by the reports: it had
    finished, and the recorder, which others may have needed it for, had too.
    """
    return reports.has_finished(folder, node.role, node.name) and reports.has_finished(
        folder, 'record'
    )


def failed_at(node: Node, folder: Path) -> float:
    """When a node has failed [s, since the epoch], by its report; 0 for one that was killed and
    has left none. Others give up because of the first, and some of them may have ended too when
    somebody looks.
    """
    path = run_folder.report_path(folder, node.role, node.name)
    return path.stat().st_mtime if path.is_file() else 0.0


def why_it_gave_up(node: Node, folder: Path) -> str | None:
    """Why a node ended before its run was over, from its report; None if it did not."""
    path = run_folder.report_path(folder, node.role, node.name)
    if not path.is_file():
        return f'{node.name} ended without a report'
    report = reports.read(path)
    if report.finished is False:
        why = f': {report.error}' if report.error else ''
        return f'{node.name} ended before the run had finished{why}'
    return None
