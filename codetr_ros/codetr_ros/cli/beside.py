"""The page of `codetr train --watch`: served by a process of its own, so that the run goes on as
it does without.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from codetr_ros.processes.launcher import end_with_parent
from codetr_ros.runs import folder as run_folder

PROGRAM = (sys.executable, '-m', 'codetr_ros.cli', 'watch')
LOG = 'watch.log'
STOP_DEADLINE = 10.0
"""Seconds in which the page ends when asked to; then it is killed."""


class Beside:
    """Serves the page of a run while it lasts. A context manager.

    Args:
        folder: of the run.
        log: prints a line for people, such as the address of the page.
    """

    def __init__(self, folder: Path, log: Callable[[str], None]) -> None:
        self._folder = folder
        self._log = log
        self._told = b''  # what it has printed so far
        self._known = False  # its address was printed, or why there is none

    def __enter__(self) -> 'Beside':
        with (self._folder / run_folder.LOGS / LOG).open('wb') as errors:
            self._process = subprocess.Popen(
                [*PROGRAM, str(self._folder)],
                stdin=subprocess.DEVNULL,
                # not into the log: the address may hold a token
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,
                preexec_fn=end_with_parent(),  # noqa: PLW1509 - as the nodes
            )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        return self

    def tick(self) -> None:
        """Print the address of the page once it is known. Call it now and then."""
        if self._known:
            return
        assert self._process.stdout is not None
        self._told += self._process.stdout.read() or b''
        if b'\n' in self._told:
            self._known = True
            self._log(self._told.decode(errors='replace').splitlines()[0])
        elif self._process.poll() is not None:
            self._known = True
            place = self._folder / run_folder.LOGS / LOG
            self._log(
                f'there is no page: its server ended with {self._process.returncode}, {place}'
            )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(STOP_DEADLINE)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
