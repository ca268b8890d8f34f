"""The film strip of a run's report: an episode of the random policy, and one of the last policy.

It is drawn in a process of its own, because a graphics driver at fault may end the process that
uses it. `python -m codetr_ros.cli.film FOLDER` is that process.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codetr_ros.runs import folder as run_folder
from codetr_ros.system.files import atomic_write

if TYPE_CHECKING:
    from codetr_ros.config import Settings
    from codetr_ros.records import F32
    from codetr_ros.simulation.drawing import Frame
    from codetr_ros.simulation.episode import EpisodeRunner

DRIVERS = ('egl', 'osmesa')
"""Values of MUJOCO_GL that need no display, in the order in which they are tried."""
DEADLINE = 30.0
"""Seconds after which a film is given up; one of a task with a name takes a few."""
FRAMES = 5
WIDTH, HEIGHT = 240, 180

HELP = 'draw the robot under the random and the last policy for the report; takes seconds'
"""Of the flag that asks for a film."""
PROGRAM = (sys.executable, '-m', 'codetr_ros.cli.film')

Act = Callable[['EpisodeRunner'], 'F32']


def make(
    folder: Path,
    deadline: float = DEADLINE,
    program: Sequence[str] = PROGRAM,
    environment: Mapping[str, str] = os.environ,
) -> str:
    """Draw the film strip of a run into its folder, if it can be drawn.

    Args:
        folder: the run's folder.
        deadline: seconds that all attempts may take together.
        program: draws the film of the folder that is its last argument, and prints what to know
            about it.
        environment: variables of the program; MUJOCO_GL in it is the only driver that is tried.

    Returns:
        What to know about the film, or why there is none.
    """
    began = time.monotonic()
    given = environment.get('MUJOCO_GL')
    faults = []
    for driver in (given,) if given else DRIVERS:
        left = deadline - (time.monotonic() - began)
        try:
            done = subprocess.run(
                [*program, str(folder)],
                env={**environment, 'MUJOCO_GL': driver},
                capture_output=True,
                text=True,
                errors='replace',
                timeout=max(left, 0.001),
                check=False,
            )
        except subprocess.TimeoutExpired:
            faults.append(f'{driver}: not done within {deadline:g} s')
            break
        except OSError as error:
            faults.append(f'{driver}: {error.strerror}')
            continue
        spent = time.monotonic() - began
        if done.returncode == 0 and (folder / run_folder.FILM).is_file():
            return f'{done.stdout.strip()} Drawing it took {spent:.1f} s.'
        if done.returncode == NOT_TO_BE_DRAWN:
            return f'{_without(folder)}{done.stdout.strip()}.'
        faults.append(f'{driver}: {_why(done)}')
    return (
        f'{_without(folder)}MuJoCo cannot draw here ({"; ".join(faults)}). Nothing else depends '
        'on it.'
    )


def _without(folder: Path) -> str:
    earlier = (folder / run_folder.FILM).is_file()
    return 'No new frames of the robot: ' if earlier else 'No frames of the robot: '


def _why(done: subprocess.CompletedProcess[str]) -> str:
    if done.returncode < 0:
        return f'ended by signal {-done.returncode}'
    lines = done.stdout.strip().splitlines() or done.stderr.strip().splitlines()
    return lines[-1][:200] if lines else f'exit code {done.returncode}'


NOT_TO_BE_DRAWN = 3
"""Exit code if no driver would help: the program has printed why."""


def main(arguments: Sequence[str]) -> int:
    """Draw the film strip of the run in this folder; returns the exit code."""
    folder = Path(arguments[0])
    try:
        import mujoco

        # before anything slow is imported
        mujoco.GLContext(WIDTH, HEIGHT).make_current()
    except Exception as error:  # noqa: BLE001  (each driver has errors of its own)
        print(f'{type(error).__name__}: {error}'.splitlines()[0])
        return 1
    from codetr_ros.cli import evaluate
    from codetr_ros.processes.openmp import waiting_environment

    os.environ.update(waiting_environment())
    from codetr_ros.config import SettingsError
    from codetr_ros.learners.base import LearnerError
    from codetr_ros.runs.checkpoints import CheckpointError
    from codetr_ros.runs.folder import RunFolderError
    from codetr_ros.simulation.tasks import TaskError

    try:
        settings = evaluate.settings_to_read(folder)
        policy = evaluate.newest_policy(folder, settings)
        text = draw(folder, settings, policy)
    except (RunFolderError, CheckpointError, LearnerError, SettingsError, TaskError) as error:
        print(error)
        return NOT_TO_BE_DRAWN
    print(text)
    return 0


def draw(folder: Path, settings: 'Settings', policy: Any) -> str:
    """Draw the random policy and a learnt one; returns what to know about the film.

    Both begin in the start state of the first episode of the run's evaluations.

    Raises:
        TaskError: the task cannot be made or drawn.
    """
    import torch

    from codetr_ros.policy.acting import uniform_actions
    from codetr_ros.seeding import generator, seed_global
    from codetr_ros.simulation import tasks
    from codetr_ros.simulation.drawing import Drawing
    from codetr_ros.simulation.episode import EpisodeRunner
    from codetr_ros.simulation.permission import acting_policy

    torch.set_num_threads(settings.thread_count)
    seed_global(settings.seed, 'environment')
    environment = tasks.make(settings.task)
    acting = acting_policy(policy, environment, settings)
    assert acting is not None, 'newest_policy gives none that is random'
    drawn = generator(settings.seed, 'evaluate', 'random', 0)
    actions = uniform_actions(drawn, environment.horizon, environment.action_size)
    start = int(generator(settings.seed, 'evaluate', 0).integers(2**31))
    runner = EpisodeRunner(environment, settings, 'evaluate')

    def begin() -> None:
        seed_global(settings.seed, 'environment', 'evaluate', 0)
        runner.reset(start, 0)

    acts: dict[str, Act] = {
        'random policy': lambda episode: actions[episode.length],
        f'after {settings.steps_after(policy.version)} steps': lambda episode: acting.act(
            episode.observation, step=episode.place
        ),
    }
    with Drawing(environment, WIDTH, HEIGHT) as drawing:
        rows = {name: _moments(runner, begin, act, drawing.frame) for name, act in acts.items()}
    atomic_write(folder / run_folder.FILM, strip(rows))
    lengths = ', '.join(f'{name} {moments[-1][0]} steps' for name, moments in rows.items())
    return (
        'An episode of each policy from the same start, that of the first episode of every '
        f'evaluation, evenly cut into {FRAMES} moments. It lasted: {lengths}.'
    )


Moments = list[tuple[int, 'Frame']]


def _moments(
    runner: 'EpisodeRunner', begin: Callable[[], None], act: Act, frame: Callable[[], 'Frame']
) -> Moments:
    """Frames of an episode with their steps: the first, the last, and those between, evenly.

    The episode is run twice, because its length is not known before.
    """
    begin()
    while not runner.over:
        runner.step(act(runner))
    last = runner.length
    due = [round(i * last / (FRAMES - 1)) for i in range(FRAMES)]
    begin()
    moments: Moments = []
    for step in due:
        while runner.length < step and not runner.over:  # over: it draws from what has no seed
            runner.step(act(runner))
        moments.append((step, frame().copy()))
    return moments


def strip(rows: Mapping[str, Moments]) -> bytes:
    """Rows of frames under their names, each with its step, as a PNG."""
    from codetr_ros.runs import pictures

    def draw_all(figure: Any) -> None:
        parts = figure.subfigures(len(rows), 1)
        for part, (name, moments) in zip(parts, rows.items(), strict=True):
            part.suptitle(name, fontsize=9)
            for axes, (step, image) in zip(part.subplots(1, len(moments)), moments, strict=True):
                axes.imshow(image)
                axes.set(xticks=[], yticks=[])
                axes.set_xlabel(f'step {step}', fontsize=8)

    return pictures.png((pictures.WIDE, 1.45 * len(rows)), draw_all)


if __name__ == '__main__':
    code = main(sys.argv[1:])
    sys.stdout.flush()
    # without the finalisers of the driver, which fail at exit where it has closed before
    os._exit(code)
