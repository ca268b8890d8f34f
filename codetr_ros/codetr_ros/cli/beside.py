"""Pages and services beside `codetr train`: each of a process of its own, so that the run goes on
as it does without.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from codetr_ros.config import Settings
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import end_with_parent
from codetr_ros.runs import folder as run_folder

PROGRAM = (sys.executable, '-m', 'codetr_ros.cli')
LOG, SCORE_LOG, SERVICE_LOG = 'watch.log', 'score_page.log', 'score_service.log'
STATED = ('at http', 'scores by service')
"""One of these stands in the line with which a program states what it serves."""
STOP_DEADLINE = 10.0
"""Seconds in which the page ends when asked to; then it is killed."""


class Beside:
    """Serves something of a run while it lasts. A context manager.

    Args:
        folder: of the run.
        log: prints a line for people, such as the address of the page.
        name: of the file, among the run's logs, that takes its errors.
        program: what serves the page.
        environment: variables of the program; None: those of this process.
    """

    def __init__(
        self,
        folder: Path,
        log: Callable[[str], None],
        name: str,
        program: Sequence[str],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._log = log
        self._program = program
        self._environment = environment
        self._place = folder / run_folder.LOGS / name
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
        lines = self._told[: self._told.rfind(b'\n') + 1].decode(errors='replace').splitlines()
        # the middleware may print lines of its own
        if found := [line for line in lines if any(word in line for word in STATED)]:
            self._known = True
            self._log(found[0])
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


@dataclass(frozen=True)
class Offered:
    """What is served beside a run.

    Attributes:
        watch: a page that shows it.
        score: the name of a person for whom there is a page to score on, though the run asks for
            none; empty: nobody.
        service: the services for programs that score.
        camera: the topic of the pictures on a page to score on; empty: none.
        open: whether the pages are opened in a browser.
    """

    watch: bool = False
    score: str = ''
    service: bool = False
    camera: str = ''
    open: bool = False


def pages(
    folder: Path,
    settings: Settings,
    log: Callable[[str], None],
    offered: Offered,
    namespace: str | None,
    key: Mapping[str, str],
) -> list[Beside]:
    """What is served beside a run.

    Args:
        folder: of the run.
        settings: of the run; where a person scores, there is a page for it.
        log: prints a line for people.
        offered: what somebody wants.
        namespace: of the nodes; None: there are none.
        key: the variable with the key of the run, without which no score is taken.
    """
    opened = ('--open',) if offered.open else ()
    beside = []
    if offered.watch:
        beside.append(Beside(folder, log, LOG, (*PROGRAM, 'watch', str(folder), *opened)))
    if namespace is None:
        return beside
    environment = launcher.environment(settings) | dict(key)
    program = (*PROGRAM, 'score', namespace)
    if offered.score or settings.scorer == 'person':
        name = offered.score or (settings.scorers[0] if settings.scorers else 'person')
        camera = ('--camera', offered.camera) if offered.camera else ()
        page = (*program, '--name', name, *camera, *opened)
        beside.append(Beside(folder, log, SCORE_LOG, page, environment))
    if offered.service:
        beside.append(Beside(folder, log, SERVICE_LOG, (*program, '--service'), environment))
    return beside
