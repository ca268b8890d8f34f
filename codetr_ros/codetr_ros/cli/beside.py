"""Pages beside `codetr train`: served by processes of their own, so that the run goes on as it
does without.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType

from codetr_ros.config import Settings
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import end_with_parent
from codetr_ros.runs import folder as run_folder

PROGRAM = (sys.executable, '-m', 'codetr_ros.cli')
LOG, SCORE_LOG = 'watch.log', 'score.log'
STOP_DEADLINE = 10.0
"""Seconds in which the page ends when asked to; then it is killed."""


class Beside:
    """Serves a page of a run while it lasts. A context manager.

    Args:
        folder: of the run.
        log: prints a line for people, such as the address of the page.
        program: what serves the page; None: the page of `codetr watch`.
        environment: variables of the program; None: those of this process.
    """

    def __init__(
        self,
        folder: Path,
        log: Callable[[str], None],
        program: Sequence[str] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._log = log
        self._program = (*PROGRAM, 'watch', str(folder)) if program is None else program
        self._environment = environment
        self._place = folder / run_folder.LOGS / (LOG if program is None else SCORE_LOG)
        self._told = b''  # what it has printed so far
        self._known = False  # its address was printed, or why there is none

    def __enter__(self) -> 'Beside':
        with self._place.open('wb') as errors:
            self._process = subprocess.Popen(
                self._program,
                stdin=subprocess.DEVNULL,
                # not into the log: the address may hold a token
                stdout=subprocess.PIPE,
                stderr=errors,
                env=None if self._environment is None else dict(self._environment),
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
            code = self._process.returncode
            self._log(f'there is no page: its server ended with {code}, {self._place}')

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


def pages(
    folder: Path,
    settings: Settings,
    log: Callable[[str], None],
    watch: bool,
    namespace: str | None,
    key: Mapping[str, str],
) -> list[Beside]:
    """The pages that are served beside a run.

    Args:
        folder: of the run.
        settings: of the run; where a person scores, there is a page for it.
        log: prints a line for people.
        watch: whether somebody wants to watch the run.
        namespace: of the nodes; None: there are none.
        key: the variable with the key of the run, without which no score is taken.
    """
    beside = [Beside(folder, log)] if watch else []
    if settings.scorer == 'person' and namespace is not None:
        name = settings.scorers[0] if settings.scorers else 'person'
        program = (*PROGRAM, 'score', namespace, '--name', name)
        environment = launcher.environment(settings) | dict(key)
        beside.append(Beside(folder, log, program, environment))
    return beside
