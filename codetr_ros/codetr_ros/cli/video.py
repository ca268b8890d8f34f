"""A video of a run's policy: `codetr evaluate RUN --video out.mp4`.

It is drawn in a process of its own (see `rendering`):
`python -m codetr_ros.cli.video FOLDER FILE EPISODES SEED`.
"""

import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from codetr_ros.cli import rendering
from codetr_ros.processes import launcher
from codetr_ros.system.files import FileError, check_writable, sync_folder

if TYPE_CHECKING:
    from codetr_ros.config import Settings
    from codetr_ros.records import F32
    from codetr_ros.simulation.drawing import Frame
    from codetr_ros.simulation.episode import EpisodeRunner

PROGRAM = (sys.executable, '-m', 'codetr_ros.cli.video')
DEADLINE = 600.0
"""Seconds after which a video is given up. Without a GPU, one takes about a minute."""
WIDTH, HEIGHT = 640, 480
SECONDS = 30.0
"""No further episode begins once a video is so long."""
MOST_FRAMES = 50.0
"""A second. What is simulated in smaller steps shows some of them, in the same time."""
UNKNOWN_PERIOD = 0.04
"""Seconds that a step is shown, where the task has no time."""
SUFFIX = '.mp4'


@dataclass(frozen=True)
class Pace:
    """How a video goes on, so that the robot moves as fast as it does.

    Attributes:
        step: seconds that a step is shown.
        every: of so many steps one is drawn.
    """

    step: float
    every: int

    @classmethod
    def of(cls, control_period: float) -> 'Pace':
        """The pace for steps of so many seconds; 0: unknown."""
        step = control_period or UNKNOWN_PERIOD
        return cls(step, max(1, math.ceil(1 / (step * MOST_FRAMES) - 1e-9)))

    @property
    def rate(self) -> float:
        """Frames a second."""
        return 1 / (self.step * self.every)

    @contextmanager
    def writing(
        self, file: Path, size: tuple[int, int] = (WIDTH, HEIGHT)
    ) -> 'Iterator[Callable[[Frame], None]]':
        """What writes frames of a size, width and height, to a file."""
        from imageio_ffmpeg import write_frames

        writer = write_frames(
            str(file),
            size,
            fps=self.rate,
            macro_block_size=2,
            output_params=['-v', 'error'],
        )
        writer.send(None)
        try:
            yield lambda frame: writer.send(frame.tobytes())
        finally:
            writer.close()


class VideoError(RuntimeError):
    """A video that cannot be made: the message names the file, the reason and the remedy."""


def check(file: Path) -> None:
    """Check that a video may be written there.

    Raises:
        VideoError: it is no `.mp4`, or its folder cannot be written.
    """
    if file.suffix != SUFFIX:
        raise VideoError(f'--video {file} must end with {SUFFIX}')
    try:
        check_writable(file.absolute().parent)
    except FileError as error:
        raise VideoError(f'--video {error}') from None


def make(
    folder: Path,
    file: Path,
    settings: 'Settings',
    program: Sequence[str] = PROGRAM,
    environment: Mapping[str, str] = os.environ,
) -> str:
    """Draw a video of a run's newest policy.

    Args:
        folder: the run's folder.
        file: the video; an existing one is replaced.
        settings: of the evaluation: the episodes, and the seed of their start states.
        program: draws the video; the last arguments are given here.
        environment: variables of the program; MUJOCO_GL in it is the only driver that is tried.

    Returns:
        What to know about the video.

    Raises:
        VideoError: it cannot be drawn.
    """
    arguments = (str(folder), str(file), str(settings.evaluate_episodes), str(settings.seed))
    given = {**environment, **launcher.module_environment(settings, environment)}
    with replacing(file) as partial:
        drawn = rendering.draw([*program, *arguments], partial, DEADLINE, given)
        if not drawn.possible:
            raise VideoError(f'no video {file}: {drawn.text}')
        if drawn.driver is None:
            raise VideoError(
                f'no video {file}: MuJoCo cannot draw here ({drawn.text}). `codetr doctor` says '
                'what it needs'
            )
    return f'{file}: {drawn.text} (drawn by {drawn.driver})'


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Where a video is written first: it takes the place of the file if all goes well."""
    partial = partial_of(file)
    try:
        yield partial
        os.replace(partial, file)
        sync_folder(file.absolute().parent)
    finally:
        partial.unlink(missing_ok=True)


def partial_of(file: Path) -> Path:
    """Where a video is written first; ffmpeg knows its format by the end of its name."""
    return file.with_name(f'.{file.stem}.partial{SUFFIX}')


def main(arguments: Sequence[str]) -> int:
    """Draw a video of the run in this folder; returns the exit code."""
    folder, file, episodes, seed = arguments

    def made() -> str:
        from codetr_ros.cli import evaluate

        changes = {'evaluate_episodes': int(episodes), 'seed': int(seed)}
        settings = evaluate.settings_to_read(Path(folder)).changed(changes, 'video')
        return film(Path(folder), partial_of(Path(file)), settings)

    return rendering.run(made, WIDTH, HEIGHT)


def film(folder: Path, file: Path, settings: 'Settings') -> str:
    """Draw the episodes of an evaluation into a file; returns what to know about them.

    Raises:
        TaskError: the task cannot be made or drawn.
    """
    import torch

    from codetr_ros.cli import evaluate
    from codetr_ros.seeding import seed_global
    from codetr_ros.simulation import tasks
    from codetr_ros.simulation.drawing import Drawing
    from codetr_ros.simulation.episode import EpisodeRunner
    from codetr_ros.simulation.permission import acting_policy

    torch.set_num_threads(settings.thread_count)
    policy = evaluate.newest_policy(folder, settings)
    seed_global(settings.seed, 'environment')
    environment = tasks.make(settings.task)
    acting = acting_policy(policy, environment, settings)
    assert acting is not None, 'newest_policy gives none that is random'
    runner = EpisodeRunner(environment, settings, 'evaluate')
    pace = Pace.of(environment.control_period)
    returns: list[float] = []
    shown = 0
    with Drawing(environment, WIDTH, HEIGHT) as drawing, pace.writing(file) as put:
        for number in range(settings.evaluate_episodes):
            if shown >= SECONDS * pace.rate:
                break
            total = 0.0
            for step, reward in enumerate(_episode(runner, settings.seed, number, acting.act)):
                total += reward
                if step % pace.every == 0 or runner.over:
                    put(drawing.frame())
                    shown += 1
            returns.append(total)
    many = f'{len(returns)} episode' + 's' * (len(returns) != 1)
    listed = ', '.join(f'{value:.6g}' for value in returns)
    after = f'after {settings.steps_after(policy.version)} steps'
    frames = f'{shown} frames at {pace.rate:.4g} a second'
    return f'{many} {after}, {frames}, true returns {listed}'


def _episode(
    runner: 'EpisodeRunner', seed: int, number: int, act: Callable[..., 'F32']
) -> Iterator[float]:
    """Run an episode of the evaluation step by step; yields the rewards."""
    from codetr_ros.cores.evaluator import begin

    begin(runner, seed, number)
    while not runner.over:
        reward, _ = runner.step(act(runner.observation, step=runner.place))
        yield reward


if __name__ == '__main__':
    rendering.end(main(sys.argv[1:]))
