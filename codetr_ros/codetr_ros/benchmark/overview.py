"""The progress of a benchmark: a display that changes in place on a terminal, else plain lines."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TextIO

from rich.console import RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from codetr_ros.benchmark.attempt import Job, phases_in, running
from codetr_ros.benchmark.folder import Folder
from codetr_ros.runs.display import Display
from codetr_ros.runs.progress import duration


class Overview(Display):
    """Shows which cells are done, running or failed, and how long the rest will take.

    Args:
        folder: the benchmark's folder.
        jobs: the cells to be run.
        done: number of cells that were finished before.
        stream: shows the display.
        live: change the display in place; by default if `stream` is a terminal.
        clock: monotonic seconds.
    """

    plain_every = 30.0
    live_every = 0.5

    def __init__(
        self,
        folder: Folder,
        jobs: Sequence[Job],
        done: int,
        stream: TextIO | None = None,
        live: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder = folder
        super().__init__(stream, live, clock)
        self._total = len(jobs) + done
        self._steps_total = sum(job.steps for job in jobs)
        self._steps_done = 0  # of cells that have ended since the start, failed ones included
        self._done = done
        self._running: dict[str, tuple[Job, float]] = {}  # by cell, with its start
        self.failed: dict[str, str] = {}
        """Errors of the failed cells, by cell."""

    def started(self, job: Job) -> None:
        """Show that a cell begins; one that begins again is counted once."""
        self._running[job.cell] = (job, self._clock())
        if self._live is None:
            self.log(f'begun: {job.cell}')

    def ended(self, job: Job, ending: Mapping[str, Any]) -> None:
        """Show that a cell has ended, by the ending that `Attempt.finish` returns."""
        _, began = self._running.pop(job.cell)
        self._steps_done += job.steps
        took = duration(self._clock() - began)
        if ending['error'] is None:
            self._done += 1
            self.log(f'done: {job.cell} in {took} ({self._counts()})')
            return
        self.failed[job.cell] = ending['error']
        self.log(f'FAILED: {job.cell} after {took}: {ending["error"]}', 'bold red')
        for line in (ending['log'] or '').splitlines():
            self.log(f'    {line}', 'dim')

    def _plain(self) -> None:
        shown = ', '.join(f'{cell} {share:.0%}' for cell, share, _ in self._progress())
        self.log(self._counts() + (f'; running: {shown}' if shown else ''))

    def _progress(self) -> list[tuple[str, float, float]]:
        """Each running cell with the share of its phases that are done and its seconds so far."""
        progress = []
        for cell, (job, began) in self._running.items():
            place = running(self._folder, cell)
            share = phases_in(place) / job.phases if place else 0.0
            progress.append((cell, min(share, 1.0), self._clock() - began))
        return progress

    def _steps(self) -> float:
        shares = {cell: share for cell, share, _ in self._progress()}
        return self._steps_done + sum(
            job.steps * shares[cell] for cell, (job, _) in self._running.items()
        )

    @property
    def seconds_left(self) -> float | None:
        """Estimate from the steps per second since the start; None while there are none."""
        steps, spent = self._steps(), self._clock() - self._began
        return (self._steps_total - steps) * spent / steps if steps and spent else None

    def _counts(self) -> str:
        left = self.seconds_left
        counts = [f'{self._done} of {self._total} done', f'{len(self._running)} running']
        counts.append(f'{len(self.failed)} failed')
        counts.append(f'{duration(self._clock() - self._began)} so far')
        if left:
            counts.append(f'about {duration(left)} left')
        return ', '.join(counts)

    def _render(self) -> RenderableType:
        whole = Table.grid()
        whole.add_row(ProgressBar(total=self._total, completed=self._done, width=60))
        whole.add_row(Text(self._counts()))
        cells = Table.grid(padding=(0, 2))
        for cell, share, seconds in self._progress():
            bar = ProgressBar(total=1.0, completed=share, width=20)
            cells.add_row(Text(cell), bar, Text(f'{share:.0%}'), Text(duration(seconds)))
        whole.add_row(cells)
        if self.failed:
            text = f'failed: {", ".join(self.failed)}'
            whole.add_row(Text(text, style='bold red'))
        return whole
