"""`codetr score`: a page in the browser on which a person scores the segments of a run."""

import dataclasses
import logging
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from codetr_ros.cli import refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.cli.watch import AllowedNames, Host, Port
from codetr_ros.processes import middleware

if TYPE_CHECKING:
    from codetr_ros.config import Settings
    from codetr_ros.cores.core import Core
    from codetr_ros.cores.scoring import Desk, Segment
    from codetr_ros.records import RunSpec
    from codetr_ros.ros.joining import MakeCore

_log = logging.getLogger(__name__)
DRAWING_DEADLINE = 60.0
"""Seconds in which a segment must be drawn."""
NAME = re.compile('[A-Za-z0-9_-]{1,64}')


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Score the segments of a run in the browser, over its topics, on this or another computer.
    The run goes on without waiting. It must have been started with --scorer person or topic.
    Ctrl-C ends it; who comes back under the same name goes on.
    """

    namespace: Annotated[
        str,
        tyro.conf.Positional,
        tyro.conf.arg(metavar='/NAMESPACE', help='of the run, as `codetr train` prints it'),
    ]
    name: Annotated[
        str, tyro.conf.arg(metavar='NAME', help='whose scores these are; each has a scale')
    ] = 'person'
    scale: Annotated[
        str,
        tyro.conf.arg(
            metavar='LOWEST:HIGHEST',
            help='3 to 9 points, the highest is best; or number, for any number',
        ),
    ] = '1:5'
    host: Host = '127.0.0.1'
    port: Port = 0
    allow_name: AllowedNames = ()
    peer_deadline: Annotated[
        float, tyro.conf.arg(metavar='S', help='seconds to wait for the run; 0: for ever')
    ] = 60.0


def main(arguments: Sequence[str]) -> int:
    """Serve the page until the run has ended, or Ctrl-C; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr score', arguments=arguments)
    from codetr_ros.pages.address import PageError
    from codetr_ros.pages.scoring import Points

    if not NAME.fullmatch(given.name):
        return refuse(
            f'--name {given.name!r}: a scorer is named by 1 to 64 letters, digits, underscores '
            'and hyphens'
        )
    reason = middleware.wrong_namespace(given.namespace) or middleware.wrong_seconds(
        '--peer-deadline', given.peer_deadline
    )
    if reason:
        return refuse(reason)
    try:
        points = Points.of(given.scale)
    except PageError as error:
        return refuse(str(error))
    try:
        from codetr_ros.ros.node import run_node
    except ImportError as error:
        return refuse(
            f'ROS cannot be imported ({error}): a run is scored over its topics. `codetr doctor` '
            'names what is missing'
        )
    node = 'score_' + given.name.replace('-', '_')
    ros = ['--ros-args', '-r', f'__ns:={given.namespace}', '-p']
    argv = [*ros, f'peer_deadline:={given.peer_deadline}']

    def show(url: str) -> None:
        console().print(f'score as {given.name} at {url} (Ctrl-C ends it)')

    return run_node('score', node, loading(given, points, show), argv)


def loading(
    given: Arguments, points: Any, show: Callable[[str], None]
) -> 'Callable[[], MakeCore]':
    """What imports and makes the core of the node: a desk, and the page that it is served on.

    Args:
        given: the command line.
        points: the person's scale.
        show: prints the address of the page.
    """

    def load() -> 'MakeCore':
        from codetr_ros.cores.scoring import Desk
        from codetr_ros.nodes.errors import NodeError
        from codetr_ros.pages.scoring import ScoringPage

        class Served(Desk):
            """A desk with a page."""

            def __init__(self, run: 'RunSpec', settings: 'Settings') -> None:
                super().__init__(run, settings, given.name)
                self._page = ScoringPage(self, points, Drawing(self, settings))
                where = given.host, given.port, given.allow_name
                self._server = self._page.serve(*where).__enter__()
                self._open = True
                show(self._server.url)

            def work(self) -> Any:
                for records in super().work():
                    self._page.tick()
                    yield records

            def close(self) -> None:
                if self._open:
                    self._open = False
                    self._page.tick()
                    self._server.__exit__(None, None, None)

        def make(run: 'RunSpec', settings: 'Settings', name: str, _: Any) -> 'Core[Any]':
            if settings.scorer not in ('person', 'topic'):
                raise NodeError(
                    f'{name}: the scores of this run come from scorer = {settings.scorer!r}: '
                    'start a run with --scorer person'
                )
            if settings.scorers and given.name not in settings.scorers:
                raise NodeError(
                    f'{name}: {given.name!r} is no scorer of this run, which takes the scores of '
                    f'{", ".join(settings.scorers)}: give one of these names with --name'
                )
            return Served(run, settings)

        return make

    return load


class Drawing:
    """Draws segments of a run, one at a time, each in a process of its own.

    Args:
        desk: holds their steps.
        settings: of the run.
    """

    def __init__(self, desk: 'Desk', settings: 'Settings') -> None:
        self._desk = desk
        self._settings = settings
        self._lock = threading.Lock()
        self._possible = True

    def __call__(self, segment: 'Segment') -> list[str] | None:
        """Pictures of a segment; None where it cannot be drawn, which is logged once."""
        from codetr_ros.cli import rendering
        from codetr_ros.simulation.frames import write_request
        from codetr_ros.system.parsing import read_json

        curves, actions = self._desk.curves(segment), self._desk.actions_before(segment)
        if curves is None or actions is None:
            return None
        with self._lock, tempfile.TemporaryDirectory() as folder:
            if not self._possible:
                return None
            sent, made = Path(folder) / 'segment.npz', Path(folder) / 'frames.json'
            source, episode, first, _ = segment
            write_request(sent, self._settings, source, episode, actions, first, curves[0])
            program = (sys.executable, '-m', 'codetr_ros.simulation.frames', str(sent), str(made))
            drawn = rendering.draw(program, made, DRAWING_DEADLINE)
            if drawn.driver is None:
                self._possible = False
                _log.warning('segments are shown by their curves only: %s', drawn.text)
                return None
            frames: list[str] = read_json(made)
            return frames
