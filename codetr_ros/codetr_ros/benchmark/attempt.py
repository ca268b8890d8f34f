"""One attempt at a cell: its own process, `codetr train --in-process`, and the output of that.

Local workers and Ray workers use it alike, so that a cell is the same wherever it ran.
"""

import errno
import json
import os
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codetr_ros.benchmark.folder import Folder, finished, provenance, read_json, read_summary
from codetr_ros.processes import launcher
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.system.files import atomic_write, sync_folder

ERROR_LINES = 15
"""Number of lines of its log in the report of a failed cell."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """The facts that a worker needs of a cell.

    Attributes:
        cell: its name.
        settings_hash: the hash of its settings.
        steps: environment steps of its run.
        phases: phases of its run.
        threads: number of threads that its run takes.
    """

    cell: str
    settings_hash: str
    steps: int
    phases: int
    threads: int


class Attempt:
    """A run of a cell that has been started.

    Its process is killed when the thread that made this object ends. So that thread must live as
    long as the attempt.

    Args:
        folder: the benchmark's folder.
        job: the cell.
    """

    def __init__(self, folder: Folder, job: Job) -> None:
        self.job = job
        self._folder = folder
        self._place = folder.attempts / f'{job.cell}.{secrets.token_hex(4)}'
        self._log = self._place.with_name(f'{self._place.name}.log')
        self._began = time.monotonic()
        command = [sys.executable, '-m', 'codetr_ros.cli', 'train', '--in-process', '--no-bag']
        command += ['--config', str(folder.settings(job.cell)), '--out', str(self._place)]
        with self._log.open('wb') as log:
            log.write(f'$ {shlex.join(command)}\n'.encode())
            log.flush()
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, 'PYTHONUNBUFFERED': '1'},
                start_new_session=True,  # Ctrl-C reaches the runner only
                # safe: one system call, looked up before the fork
                preexec_fn=launcher.end_with_parent(signal.SIGKILL),  # noqa: PLW1509
            )

    @property
    def over(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    @property
    def seconds(self) -> float:
        """Seconds since its start."""
        return time.monotonic() - self._began

    def finish(self) -> dict[str, Any]:
        """Move the output of an ended process into the cell's place.

        Returns:
            The ending, as kept in `cells/<cell>.json`: `error` is None for a finished cell.
        """
        code, job, folder = self._process.wait(), self.job, self._folder
        summary = read_summary(self._place)
        done = code == 0 and finished(summary, job.settings_hash)
        ending = {
            'cell': job.cell,
            'settings_hash': job.settings_hash,
            'error': None if done else self._why(code, summary),
            'exit_code': code,
            'log': None if done else launcher.end_of_log(self._log, ERROR_LINES),
            'wall_s': round(self.seconds, 3),
            **provenance(),
        }
        if not self._move_into_place():
            self._remove()  # another attempt finished first and stays
            return read_json(folder.ending(job.cell)) or ending
        os.replace(self._log, folder.log(job.cell))
        atomic_write(folder.ending(job.cell), json.dumps(ending, indent=1) + '\n')
        return ending

    def discard(self) -> None:
        """End the process at once and remove its output."""
        if not self.over:
            # not yet waited for, so no other process can have its number
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._remove()

    def _move_into_place(self) -> bool:
        """Move the run into the cell's place; returns False if a finished run is there already."""
        folder, cell = self._folder, self.job.cell
        if not self._place.is_dir():
            return folder.state(cell, self.job.settings_hash) != 'finished'
        try:
            self._place.rename(folder.run(cell))
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
            if folder.state(cell, self.job.settings_hash) == 'finished':
                return False
            folder.set_aside(cell)
            self._place.rename(folder.run(cell))
        sync_folder(folder.path)
        return True

    def _why(self, code: int, summary: RunSummary | None) -> str:
        if summary and summary.failure:
            return summary.failure
        if code < 0:
            try:
                return f'ended by {signal.Signals(-code).name}'
            except ValueError:
                return f'ended by signal {-code}'
        if code:
            return f'ended with exit code {code}'
        if summary is None:
            return f'ended with exit code 0 but left no {run_folder.SUMMARY}'
        return (
            f'ended with exit code 0 but its {run_folder.SUMMARY} is of an unfinished run or of '
            f'other settings (hash {summary.settings_hash}, not {self.job.settings_hash})'
        )

    def _remove(self) -> None:
        shutil.rmtree(self._place, ignore_errors=True)
        self._log.unlink(missing_ok=True)


def phases_in(run: Path) -> int:
    """Phases up to the newest checkpoint of a run's learner; 0 if there is none."""
    numbers = [
        path.name.removeprefix('learner-')
        for path in (run / run_folder.CHECKPOINTS).glob('learner-*')
    ]
    return max((int(number) + 1 for number in numbers if number.isdigit()), default=0)


def running(folder: Folder, cell: str) -> Path | None:
    """The folder of the newest attempt at a cell, if there is one."""
    folders = [p for p in folder.attempts.glob(f'{cell}.????????') if p.is_dir()]
    return max(folders, key=lambda path: path.stat().st_mtime, default=None)
