"""A video of a recorded episode: its actions are taken again, and the robot is drawn.

It is drawn in a process of its own (see `rendering`): `python -m codetr_ros.cli.replayed FOLDER
EPISODE.npz FILE`.
"""

import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codetr_ros.cli import rendering, video
from codetr_ros.config import Settings
from codetr_ros.processes import launcher
from codetr_ros.simulation.replay import Recorded, replay
from codetr_ros.system.files import atomic_write

PROGRAM = (sys.executable, '-m', 'codetr_ros.cli.replayed')
DEADLINE = 120.0
PAUSE = 30.0
"""Seconds between two videos of a run that lasts."""


def main(arguments: Sequence[str]) -> int:
    """Draw an episode of the run in this folder; returns the exit code."""
    folder, episode, file = (Path(argument) for argument in arguments)

    def made() -> str:
        from codetr_ros.cli import evaluate
        from codetr_ros.simulation.open_episode import DiffersError
        from codetr_ros.simulation.tasks import TaskError

        try:
            return film(evaluate.settings_to_read(folder), read(episode), file)
        except DiffersError as error:
            raise TaskError(f'the episode cannot be shown again: {error}') from None

    return rendering.run(made, video.WIDTH, video.HEIGHT)


def film(settings: Settings, recorded: Recorded, file: Path) -> str:
    """Draw an episode into a file.

    Returns:
        The seconds that a step is shown.

    Raises:
        TaskError: the task cannot be made or drawn.
        DiffersError: the environment does something else than recorded.
    """
    from codetr_ros.seeding import seed_global
    from codetr_ros.simulation import tasks
    from codetr_ros.simulation.drawing import Drawing

    seed_global(settings.seed, 'environment')
    environment = tasks.make(settings.task)
    pace = video.Pace.of(environment.control_period)
    with Drawing(environment, video.WIDTH, video.HEIGHT) as drawing, pace.writing(file) as put:
        for step in replay(environment, settings.seed, recorded):
            if step % pace.every == 0:
                put(drawing.frame())
    return f'{pace.step:.6g}'


def write(recorded: Recorded, path: Path) -> None:
    """Write an episode for `read`."""
    from io import BytesIO

    data = BytesIO()
    np.savez(
        data,
        source=recorded.source,
        episode=recorded.episode,
        observations=recorded.observations,
        actions=recorded.actions,
    )
    atomic_write(path, data.getvalue(), wait=False)


def read(path: Path) -> Recorded:
    """Read what `write` has written."""
    with np.load(path, allow_pickle=False) as content:
        return Recorded(
            source=str(content['source']),
            episode=int(content['episode']),
            observations=content['observations'],
            actions=content['actions'],
        )


class EpisodeVideos:
    """Draws the newest episode of a run beside the page that shows it, one at a time. A context
    manager, which leaves nothing behind.

    Args:
        folder: of the run.
        settings: of the run.
        publish: gets what the page is to know of a new video.
    """

    def __init__(
        self, folder: Path, settings: Settings, publish: Callable[[dict[str, Any]], None]
    ) -> None:
        self._folder = folder
        self._publish = publish
        self._environment = {**os.environ, **launcher.module_environment(settings)}
        self._thread: threading.Thread | None = None
        self._began = float('-inf')
        self._drawn: tuple[str, int] | None = None  # the last episode that was asked for
        self._count = 0
        self._place = tempfile.TemporaryDirectory(prefix='codetr-watch-')
        self.place = Path(self._place.name)

    def __enter__(self) -> 'EpisodeVideos':
        return self

    def __exit__(self, *error: object) -> None:
        self._place.cleanup()

    def look(self, recorded: Recorded | None) -> None:
        """Begin to draw an episode, if it is another one and it is time. Call it now and then."""
        if recorded is None or (recorded.source, recorded.episode) == self._drawn:
            return
        busy = self._thread is not None and self._thread.is_alive()
        if busy or time.monotonic() - self._began < PAUSE:
            return
        self._began = time.monotonic()
        self._drawn = recorded.source, recorded.episode
        self._thread = threading.Thread(target=self._draw, args=(recorded,), daemon=True)
        self._thread.start()

    def _draw(self, recorded: Recorded) -> None:
        self._count += 1
        episode, file = self.place / 'episode.npz', self.place / f'{self._count}.mp4'
        known: dict[str, Any] = {'source': recorded.source, 'episode': recorded.episode}
        try:
            write(recorded, episode)
            program = (*PROGRAM, str(self._folder), str(episode), str(file))
            drawn = rendering.draw(program, file, DEADLINE, self._environment)
        except OSError as error:
            self._publish(known | {'file': None, 'why': str(error)})
            return
        if drawn.driver is None:
            self._publish(known | {'file': None, 'why': drawn.text})
            return
        (self.place / f'{self._count - 1}.mp4').unlink(missing_ok=True)
        self._publish(known | {'file': file.name, 'step_seconds': float(drawn.text)})


if __name__ == '__main__':
    rendering.end(main(sys.argv[1:]))
