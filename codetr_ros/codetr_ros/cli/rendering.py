"""Whether and by what MuJoCo draws on this machine, and programs that draw.

A graphics driver at fault may end the process that uses it, so whatever draws does so in a process
of its own. Drivers that need no display are tried one after another.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from codetr_ros.processes.launcher import end_with_parent

DRIVERS = ('egl', 'osmesa')
"""Values of MUJOCO_GL that need no display, in the order in which they are tried."""
NOT_TO_BE_DRAWN = 3
"""Exit code if no driver would help: the program has printed why."""
PROBE = (
    'import mujoco, os\n'
    'mujoco.GLContext(8, 8).make_current()\n'
    'model = mujoco.MjModel.from_xml_string("<mujoco/>")\n'
    'with mujoco.Renderer(model, 8, 8) as renderer:\n'
    '    renderer.update_scene(mujoco.MjData(model))\n'
    '    renderer.render()\n'
    '    os._exit(0)\n'
)
"""Draws the smallest picture that there is."""
PROBE_DEADLINE = 20.0


class Drawn(NamedTuple):
    """How it went to draw something.

    Attributes:
        driver: that did it; None: nothing was drawn.
        text: what the program printed about it, or why nothing was drawn.
        possible: whether another machine could draw it.
    """

    driver: str | None
    text: str
    possible: bool = True


def draw(
    program: Sequence[str],
    made: Path | None,
    deadline: float,
    environment: Mapping[str, str] = os.environ,
) -> Drawn:
    """Let a program draw, by the first driver that can.

    Args:
        program: its path and arguments; it prints what to know about what it has drawn.
        made: the file that it makes; None: none.
        deadline: seconds that all attempts may take together.
        environment: variables of the program; MUJOCO_GL in it is the only driver that is tried.
    """
    began = time.monotonic()
    given = environment.get('MUJOCO_GL')
    faults = []
    for driver in (given,) if given else DRIVERS:
        left = deadline - (time.monotonic() - began)
        try:
            done = subprocess.run(
                program,
                env={**environment, 'MUJOCO_GL': driver},
                capture_output=True,
                text=True,
                errors='replace',
                timeout=max(left, 0.001),
                check=False,
                preexec_fn=end_with_parent(),
            )
        except subprocess.TimeoutExpired:
            faults.append(f'{driver}: not done within {deadline:g} s')
            break
        except OSError as error:
            faults.append(f'{driver}: {error.strerror}')
            continue
        if done.returncode == 0 and (made is None or made.is_file()):
            return Drawn(driver, done.stdout.strip())
        if done.returncode == NOT_TO_BE_DRAWN:
            return Drawn(None, done.stdout.strip(), possible=False)
        faults.append(f'{driver}: {_why(done)}')
    return Drawn(None, '; '.join(faults))


def _why(done: subprocess.CompletedProcess[str]) -> str:
    if done.returncode < 0:
        return f'ended by signal {-done.returncode}'
    lines = done.stdout.strip().splitlines() or done.stderr.strip().splitlines()
    return lines[-1][:200] if lines else f'exit code {done.returncode}'


def find(environment: Mapping[str, str] = os.environ) -> Drawn:
    """Which driver draws on this machine, or why none does."""
    return draw((sys.executable, '-c', PROBE), None, PROBE_DEADLINE, environment)


def run(make: Callable[[], str], width: int, height: int) -> int:
    """The main function of a program that draws.

    Args:
        make: draws, and returns what to know about it.
        width: of a picture [pixels].
        height: of a picture [pixels].

    Returns:
        The exit code.
    """
    try:
        import mujoco

        # before anything slow is imported
        mujoco.GLContext(width, height).make_current()
    except Exception as error:  # noqa: BLE001  (each driver has errors of its own)
        print(f'{type(error).__name__}: {error}'.splitlines()[0])
        return 1
    from codetr_ros.processes.openmp import waiting_environment

    os.environ.update(waiting_environment())
    from codetr_ros.config import SettingsError
    from codetr_ros.learners.base import LearnerError
    from codetr_ros.runs.checkpoints import CheckpointError
    from codetr_ros.runs.folder import RunFolderError
    from codetr_ros.simulation.tasks import TaskError

    try:
        text = make()
    except (RunFolderError, CheckpointError, LearnerError, SettingsError, TaskError) as error:
        print(error)
        return NOT_TO_BE_DRAWN
    print(text)
    return 0


def end(code: int) -> None:
    """End a program that has drawn: without the finalisers of the driver, which fail at exit where
    it has closed before.
    """
    sys.stdout.flush()
    os._exit(code)
