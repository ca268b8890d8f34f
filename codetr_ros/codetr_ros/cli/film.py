"""The film strip and the video of a run's report: an episode of the random policy, of the policy
half-way, and of the last one.

It is drawn in a process of its own (see `rendering`): `python -m codetr_ros.cli.film FOLDER`.
"""

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codetr_ros.cli import rendering, video
from codetr_ros.runs import folder as run_folder
from codetr_ros.system.files import atomic_write

if TYPE_CHECKING:
    from codetr_ros.config import Settings
    from codetr_ros.policy.acting import ActingPolicy
    from codetr_ros.records import F32, Policy
    from codetr_ros.simulation.drawing import Frame
    from codetr_ros.simulation.episode import EpisodeRunner

DEADLINE = 30.0
"""Seconds after which a film is given up; one of a task with a name takes a few."""
FRAMES = 5
WIDTH, HEIGHT = 240, 180
SECONDS = 3.0
"""Of each episode, from its beginning, in the video: drawing takes longer than the robot does."""

HELP = (
    'draw the robot under the random, the middle and the last policy for the report; takes seconds'
)
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
    film = folder / run_folder.FILM
    drawn = rendering.draw([*program, str(folder)], film, deadline, environment)
    if drawn.driver is not None:
        return f'{drawn.text} Drawing it took {time.monotonic() - began:.1f} s.'
    without = 'No new frames of the robot: ' if film.is_file() else 'No frames of the robot: '
    if not drawn.possible:
        return f'{without}{drawn.text}.'
    return f'{without}MuJoCo cannot draw here ({drawn.text}). Nothing else depends on it.'


def main(arguments: Sequence[str]) -> int:
    """Draw the film strip of the run in this folder; returns the exit code."""
    folder = Path(arguments[0])

    def made() -> str:
        from codetr_ros.cli import evaluate

        settings = evaluate.settings_to_read(folder)
        policies = [evaluate.newest_policy(folder, settings)]
        if (folder / run_folder.MIDDLE).is_dir():
            middle = evaluate.newest_policy(folder, settings, folder / run_folder.MIDDLE)
            if middle.version != policies[0].version:
                policies.insert(0, middle)
        return draw(folder, settings, policies)

    return rendering.run(made, WIDTH, HEIGHT)


def draw(folder: Path, settings: 'Settings', policies: 'Sequence[Policy]') -> str:
    """Draw the random policy and learnt ones; returns what to know about the film.

    All begin in the start state of the first episode of the run's evaluations.

    Raises:
        TaskError: the task cannot be made or drawn.
    """
    import torch

    from codetr_ros.cores.evaluator import begin
    from codetr_ros.policy.acting import uniform_actions
    from codetr_ros.seeding import generator, seed_global
    from codetr_ros.simulation import tasks
    from codetr_ros.simulation.drawing import Drawing
    from codetr_ros.simulation.episode import EpisodeRunner
    from codetr_ros.simulation.permission import acting_policy

    torch.set_num_threads(settings.thread_count)
    seed_global(settings.seed, 'environment')
    environment = tasks.make(settings.task)
    drawn = generator(settings.seed, 'evaluate', 'random', 0)
    actions = uniform_actions(drawn, environment.horizon, environment.action_size)
    runner = EpisodeRunner(environment, settings, 'evaluate')
    acts: dict[str, Act] = {'random policy': lambda episode: actions[episode.length]}
    for policy in policies:
        acting = acting_policy(policy, environment, settings)
        assert acting is not None, 'newest_policy gives none that is random'
        acts[f'after {settings.steps_after(policy.version)} steps'] = _by(acting)
    pace = video.Pace.of(environment.control_period)
    most = round(SECONDS * pace.rate)

    def first() -> None:
        begin(runner, settings.seed, 0)

    with Drawing(environment, WIDTH, HEIGHT) as drawing:
        rows = {n: _moments(runner, first, act, drawing.frame) for n, act in acts.items()}
        moving = [
            _moving(runner, first, act, drawing.frame, pace.every, most) for act in acts.values()
        ]
    atomic_write(folder / run_folder.FILM, strip(rows))
    _write_video(folder / run_folder.FILM_VIDEO, moving, pace)
    lengths = ', '.join(f'{name} {moments[-1][0]} steps' for name, moments in rows.items())
    return (
        'An episode of each policy from the same start, that of the first episode of every '
        f'evaluation, evenly cut into {FRAMES} moments. It lasted: {lengths}. The video has the '
        f'first {SECONDS:g} s of each, in the same order from left to right.'
    )


def _by(acting: 'ActingPolicy') -> Act:
    return lambda episode: acting.act(episode.observation, step=episode.place)


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


def _moving(
    runner: 'EpisodeRunner',
    begin: Callable[[], None],
    act: Act,
    frame: Callable[[], 'Frame'],
    every: int,
    most: int,
) -> 'list[Frame]':
    """Frames of the beginning of an episode, of every so many steps, at the most so many."""
    begin()
    frames = [frame().copy()]
    while not runner.over and len(frames) < most:
        runner.step(act(runner))
        if runner.length % every == 0 or runner.over:
            frames.append(frame().copy())
    return frames


def _write_video(file: Path, episodes: 'Sequence[Sequence[Frame]]', pace: video.Pace) -> None:
    """Episodes side by side; of one that has ended, the last frame stays."""
    import numpy as np

    size = WIDTH * len(episodes), HEIGHT
    with video.replacing(file) as partial, pace.writing(partial, size) as put:
        for i in range(max(map(len, episodes))):
            put(np.hstack([frames[min(i, len(frames) - 1)] for frames in episodes]))


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
    rendering.end(main(sys.argv[1:]))
