"""Try out what a run will need, before anything of it is made.

A task that is no task, an environment that is at fault and a GPU that is not there are refused
before any node starts. Tasks with a name are known to work if their library is installed. Any
other environment is made, reset, given one step of action 0, and closed.

Run as a program, it reads settings from its standard input and writes why they are refused.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping

import numpy as np

from codetr_ros.config import Settings, from_canonical
from codetr_ros.simulation import tasks
from codetr_ros.simulation.chunks import steps_of_chunks
from codetr_ros.simulation.composite import CompositeError
from codetr_ros.simulation.episode import EpisodeRunner
from codetr_ros.simulation.tasks import TASKS, TaskError
from codetr_ros.system import compilation

LIBRARIES = {'gymnasium': ('gymnasium', 'mujoco'), 'dm_control': ('dm_control', 'mujoco')}
"""The packages that the named tasks of a library need."""
DEADLINE = 120.0
"""Seconds for trying out an environment: twice what nodes wait for each other."""
PROGRAM = (
    'import sys; sys.path[:] = filter(None, sys.path)\n'  # nodes do not look in the current folder
    'from codetr_ros.cli.tryout import main; sys.exit(main())'
)


class TryoutError(ValueError):
    """A run that would fail: the message names the reason and the remedy."""


def here(settings: Settings) -> None:
    """Try out a run in this process.

    Raises:
        TryoutError: its nodes would fail.
        SettingsError: the delay exceeds the task's horizon.
    """
    _compiler(settings)
    try:
        _devices(settings)
        if settings.task in TASKS:
            _libraries(settings.task)
        else:
            _environment(settings)
    except (TaskError, CompositeError) as error:
        raise TryoutError(str(error)) from error


def _compiler(settings: Settings) -> None:
    if settings.sac.compile and settings.labels_steps:
        try:
            compilation.check('sac.compile=false')
        except compilation.CompilationError as error:
            raise TryoutError(str(error)) from error


def _devices(settings: Settings) -> None:
    if settings.device == settings.reward_device == 'cpu':
        return  # torch takes seconds to import
    from codetr_ros.rewards import registry
    from codetr_ros.system.devices import DeviceError, usable

    try:
        usable(settings.device)
        if settings.labels_steps:
            registry.check_device(settings)
    except DeviceError as error:
        raise TryoutError(str(error)) from error


def _libraries(task: str) -> None:
    """What a task with a name needs; nothing is imported."""
    lacking = [
        name for name in LIBRARIES[TASKS[task].library] if not importlib.util.find_spec(name)
    ]
    if lacking:
        names = ' and '.join(lacking)
        raise TryoutError(f'task {task!r} needs {names}: install {names}')


def _environment(settings: Settings) -> None:
    environment = tasks.make(settings.task)
    try:
        steps_of_chunks(environment)
        episode = EpisodeRunner(environment, settings, 'tryout')
        episode.reset(0, 0)
        episode.step(np.zeros(environment.action_size, np.float32))
    finally:
        environment.close()


def apart(settings: Settings, environ: Mapping[str, str]) -> None:
    """Try out a run in a process of its own, which knows no more than the nodes will.

    What the environment opens or starts there (a robot, a node of its own) ends with it.

    Args:
        settings: the settings of the run.
        environ: the environment of its nodes.

    Raises:
        TryoutError: its nodes would fail.
    """
    _compiler(settings)
    if settings.task in TASKS and settings.device == settings.reward_device == 'cpu':
        _libraries(settings.task)
        return
    # files, not pipes, which end with the last program that an environment has started
    with tempfile.TemporaryFile('w+') as answer, tempfile.TemporaryFile('w+') as printed:
        try:
            code = subprocess.run(
                [sys.executable, '-c', PROGRAM],
                input=settings.canonical(),
                stdout=answer,
                stderr=printed,
                text=True,
                env=dict(environ),
                timeout=DEADLINE,
                start_new_session=True,  # Ctrl-C reaches us only, and we end it
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            raise TryoutError(
                f'task {settings.task!r} was not made, reset, stepped once and closed within '
                f'{DEADLINE:g} s: mend what hangs in the environment'
            ) from None
        answer.seek(0)
        if why := answer.read().strip():
            raise TryoutError(why)
        if code:
            printed.seek(0)
            last = '\n'.join(printed.read().rstrip().splitlines()[-5:])
            raise TryoutError(
                f'task {settings.task!r} ended the process that tried it out, with exit code '
                f'{code}: mend the environment. The end of what it printed:\n{last}'
            )


def main() -> int:
    """Try out the settings of the standard input."""
    # an environment may print what it likes, but not into the answer
    answer = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)
    settings = from_canonical(sys.stdin.read(), 'standard input')
    try:
        here(settings)
    except ValueError as error:
        print(error, file=answer, flush=True)
        return 1
    return 0
