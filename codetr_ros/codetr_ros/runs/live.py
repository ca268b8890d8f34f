"""What a run leaves while it lasts, for whoever looks: `status.json`, `metrics.csv` and, where no
bag is recorded, `newest_episode.json`.

Each file is written whole, at most once a second, and so rarely that all of it takes at most one
part in 200 of the run's time. Nothing reads them but people and pages.
"""

import json
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, Protocol

from codetr_ros.records import Commit, EpisodeResult, Metrics, Presence, Record
from codetr_ros.runs import course
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.newest_episode import NewestEpisode
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.summary import Summary
from codetr_ros.system.files import atomic_write

AT_LEAST = 1.0
"""Seconds between two writings."""
SHARE = 1 / 200
"""Of the run's time, the most that writing takes."""

State = Literal['running', 'ending', 'finished', 'interrupted', 'failed']


class Part(Protocol):
    """A part of a run in process."""

    @property
    def finished(self) -> bool:
        """Whether it has done everything that the run asks of it."""

    def waiting_for(self) -> str:
        """What its next slice waits for, for people."""


class Live:
    """Writes the files of a run that change while it lasts.

    A file that cannot be written ends the writing, not the run: the reason is logged once.

    Args:
        folder: the run's folder.
        summary: receives the same records.
        progress: receives the same records; logs why nothing is written.
        namespace: that of the nodes; None: the run is in process.
        clock: seconds, never going back.
        recorded: whether a bag has the episodes too.
    """

    def __init__(
        self,
        folder: Path,
        summary: Summary,
        progress: Progress,
        namespace: str | None = None,
        clock: Callable[[], float] = time.monotonic,
        recorded: bool = False,
    ) -> None:
        self._folder = folder
        self._summary = summary
        self._progress = progress
        self._namespace = namespace
        self._clock = clock
        self._due = clock()
        self._changed = False  # a number of metrics.csv
        self._nodes: dict[str, dict[str, Any]] = {}
        self._parts: Mapping[str, tuple[str, Part]] = {}
        self._episode = NewestEpisode() if summary.in_process and not recorded else None
        self._shown = 0  # changes of the episode that were written
        self._broken = False
        # of a run that goes on: its summary has what comes from now on
        table = folder / run_folder.METRICS
        self._before = table.read_text() if table.is_file() else ''
        self.seconds = 0.0
        """Spent on writing."""

    def attend(self, parts: Mapping[str, tuple[str, Part]]) -> None:
        """Take the parts of a run in process, each with its role, by name."""
        self._parts = parts

    def receive(self, record: Record) -> None:
        """Note a record of the run, of any kind."""
        if isinstance(record, Presence):
            self._nodes[record.node] = {
                'role': record.role,
                'name': record.node.rsplit('/', 1)[-1],
                'finished': record.finished,
                'doing': record.doing,
                'waiting': round(record.waiting, 1),
                'missed': int(record.missed),
                'seen': _now(),
            }
        elif isinstance(record, (Metrics, EpisodeResult, Commit)):
            self._changed = True
        elif self._episode is not None:
            self._episode.receive(record)

    def tick(self) -> None:
        """Write what has changed, if it is time. Call it now and then."""
        now = self._clock()
        if now < self._due or self._broken:
            return
        self._write('running', None)
        spent = self._clock() - now
        self.seconds += spent
        self._due = now + max(AT_LEAST, spent / SHARE)

    def end(self, state: State, failure: str | None = None) -> None:
        """Write how the run ended.

        Args:
            state: finished, interrupted, failed, or ending: the summary is being made.
            failure: why it failed.
        """
        if not self._broken:
            self._changed = False  # the summary writes metrics.csv for good
            self._write(state, failure)

    def _write(self, state: State, failure: str | None) -> None:
        try:
            self._put(run_folder.STATUS, json.dumps(self.status(state, failure), indent=1))
            if self._changed:
                table = self._summary.metrics_csv()
                if self._before:
                    table = course.joined(self._before, table)
                self._put(run_folder.METRICS, table)
                self._changed = False
            if self._episode is not None and self._episode.changes != self._shown:
                self._shown = self._episode.changes
                self._put(run_folder.EPISODE, json.dumps(self._episode.document()))
        except OSError as error:
            self._broken = True
            self._progress.log(f'what the run does is no longer shown in its folder: {error}')

    def _put(self, name: str, text: str) -> None:
        atomic_write(self._folder / name, text, wait=False)

    def status(self, state: State, failure: str | None) -> dict[str, Any]:
        """The content of `status.json`."""
        progress, summary = self._progress, self._summary
        left = progress.seconds_left if state == 'running' else None
        return {
            'run_id': summary.run_id,
            'state': state,
            'failure': failure,
            'began': summary.start.isoformat(timespec='seconds'),
            'written': _now(),
            'command': summary.command,
            'in_process': summary.in_process,
            'namespace': self._namespace,
            'phase': summary.phases,
            'phases': summary.settings.phases,
            'steps': summary.steps,
            'steps_planned': summary.settings.steps,
            'steps_per_s': round(progress.rate, 1),
            'seconds_left': None if left is None else round(left, 1),
            'lost': progress.lost,
            'left_out': dict(sorted(progress.leavers.since.items())),
            'nodes': self._who(),
        }

    def _who(self) -> list[dict[str, Any]]:
        if not self._parts:
            return [node for _, node in sorted(self._nodes.items())]
        return [
            {
                'role': role,
                'name': name,
                'finished': part.finished,
                'missed': 0,
                'seen': _now(),
                # in turn: which of them has work to do is not known between two slices
                'doing': 'has finished'
                if part.finished
                else f'works in turn; idle, it waits for {part.waiting_for()}',
                'waiting': 0.0,
            }
            for name, (role, part) in self._parts.items()
        ]


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec='milliseconds')
