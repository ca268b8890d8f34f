"""Pictures of a segment, by doing the episode again: same start, same actions.

An environment of MuJoCo is deterministic, and a run's starts follow from its seed. So whoever has
the actions of an episode can see it, on any machine that can draw. Where the episode comes out
otherwise (another version, another machine, a robot), nothing is shown: it would be another one.
"""

import base64
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from codetr_ros.config import Settings, from_canonical
from codetr_ros.records import F32
from codetr_ros.seeding import generator, seed_global
from codetr_ros.simulation.drawing import Drawing, Frame
from codetr_ros.simulation.tasks import make

WIDTH, HEIGHT = 320, 240
MOST_FRAMES = 24
"""Of a segment: of a longer one every so many steps."""
CLOSE = 1e-3
"""Difference of observations up to which it is the same episode."""


class NotTheSameError(RuntimeError):
    """The episode came out otherwise than it was recorded."""


def frames(
    settings: Settings, source: str, episode: int, actions: F32, first: int, observations: F32
) -> list[str]:
    """Pictures of the last steps of the actions, as data addresses.

    Args:
        settings: of the run.
        source: whose episode it is.
        episode: its number.
        actions: (n, A) from the episode's first step up to the segment's end.
        first: the segment's first step.
        observations: (m, O) before each step of the segment, which must come out again.

    Raises:
        TaskError: the task is unknown, or cannot be drawn.
        NotTheSameError: the episode came out otherwise.
    """
    seed_global(settings.seed, 'environment')
    environment = make(settings.task)
    try:
        seeds = generator(settings.seed, 'reset', source, episode)
        observation = environment.reset(int(seeds.integers(2**31)))
        every = -(-(len(actions) - first) // MOST_FRAMES)
        drawn = []
        with Drawing(environment, WIDTH, HEIGHT) as drawing:
            for t, action in enumerate(actions):
                if t >= first:
                    off = float(np.abs(observation - observations[t - first]).max())
                    if not off <= CLOSE:
                        raise NotTheSameError(f'step {t} is off by {off:g}')
                    if (t - first) % every == 0:
                        drawn.append(_address(drawing.frame()))
                observation = environment.step(action)[0]
            drawn.append(_address(drawing.frame()))
        return drawn
    finally:
        environment.close()


def _address(image: Frame) -> str:
    import imageio.v3 as iio

    file = io.BytesIO()
    iio.imwrite(file, image, extension='.jpg')
    return 'data:image/jpeg;base64,' + base64.b64encode(file.getvalue()).decode()


def write_request(
    path: Path,
    settings: Settings,
    source: str,
    episode: int,
    actions: F32,
    first: int,
    observations: F32,
) -> None:
    """Write what `main` draws; arguments as those of `frames`."""
    np.savez(
        path,
        settings=np.array(settings.canonical()),
        source=np.array(source),
        episode=np.array(episode),
        actions=actions,
        first=np.array(first),
        observations=observations,
    )


def main(arguments: Sequence[str]) -> int:
    """Draw in a process of its own, which a driver at fault may end: from one file into another.

    Args:
        arguments: the file of `write_request`, and the JSON file to be made.
    """
    with np.load(arguments[0], allow_pickle=False) as sent:
        drawn = frames(
            from_canonical(str(sent['settings']), 'the run'),
            str(sent['source']),
            int(sent['episode']),
            sent['actions'],
            int(sent['first']),
            sent['observations'],
        )
    Path(arguments[1]).write_text(json.dumps(drawn))
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
