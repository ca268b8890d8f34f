"""How a run was begun, and on what machine: `run.json`, which is there from its first moment on.

Whoever goes on with a run, or derives its weights again, needs to know.
"""

import fcntl
import json
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from pydantic import Field

from codetr_ros.config import Settings
from codetr_ros.runs import facts
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.facts import Facts
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system import processors
from codetr_ros.system.files import atomic_write
from codetr_ros.system.versions import versions

NOT_BITS = ('system', 'rclpy', 'codetr_ros')
"""Versions that do not decide the last bits of weights."""


class Origin(Facts):
    """How a run was begun."""

    run_id: str = Field(description='its name')
    in_process: bool = Field(description='whether it ran without topics')
    recorded: bool = Field(description='whether it has a bag')
    namespace: str = Field(description='of its topics, in the bag too')
    began: str = Field(description='when')
    command: str | None = Field(description='the command that began it')
    host: str = Field(description='name of the machine')
    processor: str = Field(description='its processor')
    threads: int = Field(description='torch threads of each process')
    versions: dict[str, str | None] = Field(description='of the software')
    resumed: list[str] = Field([], description='when it was gone on with')

    def where(self) -> str:
        """Machine, versions and threads, for people."""
        known = ', '.join(
            f'{name} {version}' for name, version in self.versions.items() if version
        )
        return f'{self.host} ({self.processor}), {self.threads} threads, {known}'


def origin(
    settings: Settings,
    run_id: str,
    namespace: str,
    in_process: bool,
    recorded: bool,
    command: str | None,
) -> Origin:
    """The origin of a run that begins now, here."""
    return Origin(
        run_id=run_id,
        in_process=in_process,
        recorded=recorded,
        namespace=namespace,
        began=_now(),
        command=command,
        host=platform.node(),
        processor=processors.model(),
        threads=settings.thread_count,
        versions=versions(),
    )


def write(folder: Path, made: Origin) -> None:
    """Write `run.json` into a run's folder."""
    text = json.dumps(made.model_dump(mode='json'), indent=1)
    atomic_write(folder / run_folder.ORIGIN, f'{text}\n')


def read(folder: Path) -> Origin:
    """Read a run's `run.json`.

    Raises:
        RunFolderError: there is none, or it is damaged.
    """
    path = folder / run_folder.ORIGIN
    if not path.is_file():
        raise RunFolderError(
            f'{folder} has no {run_folder.ORIGIN}: it is not the folder of a run, or a version of '
            'codetr made it that could not go on with runs. Start the run again'
        )
    return facts.read(Origin, path, 'origin', 'restore it from a copy, or start the run again')


def gone_on_with(folder: Path, made: Origin) -> Origin:
    """Note in `run.json` that the run is gone on with now."""
    again = made.model_copy(update={'resumed': [*made.resumed, _now()]})
    write(folder, again)
    return again


def differences(made: Origin, settings: Settings) -> list[str]:
    """What is other here than where the run was begun and may decide the last bits, in words."""
    here = versions()
    found = [
        f'{name} {there} (here {here.get(name)})'
        for name, there in made.versions.items()
        if name not in NOT_BITS and here.get(name) != there
    ]
    if made.processor != processors.model():
        found.append(f'processor {made.processor} (here {processors.model()})')
    if made.threads != settings.thread_count:
        found.append(f'{made.threads} threads (here {settings.thread_count})')
    return found


@contextmanager
def held(folder: Path, patience: float = 0.0) -> Iterator[int]:
    """Hold a run's folder: no other process of this machine can go on with the run meanwhile.

    Args:
        folder: of the run.
        patience: seconds to wait for another process to end.

    Yields:
        A descriptor; a process to which it is handed on holds the folder too.

    Raises:
        RunFolderError: another process holds it.
    """
    # the folder itself: files in it are replaced
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    end = time.monotonic() + patience
    try:
        while not _locked(descriptor):
            if time.monotonic() > end:
                raise RunFolderError(
                    f'the run in {folder} is under way in another process: end that one first'
                )
            time.sleep(0.1)
        yield descriptor
    finally:
        os.close(descriptor)


def _locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec='seconds')
