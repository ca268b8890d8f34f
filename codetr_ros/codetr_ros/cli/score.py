"""`codetr score`: a page in the browser on which a person scores the segments of a run."""

import dataclasses
import logging
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import tyro

from codetr_ros.cli import FAILED, browser, refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.cli.watch import AllowedNames, Host, Open, Port
from codetr_ros.processes import middleware

if TYPE_CHECKING:
    from codetr_ros.config import Settings
    from codetr_ros.cores.camera import Pictures
    from codetr_ros.cores.core import Core
    from codetr_ros.cores.scoring import Desk
    from codetr_ros.cores.seen import Segment
    from codetr_ros.pages.scoring import Points
    from codetr_ros.records import Record, RunSpec
    from codetr_ros.ros.joining import Joined, MakeCore
    from codetr_ros.ros.membership import Membership
    from codetr_ros.ros.wiring import Wiring

_log = logging.getLogger(__name__)
DRAWING_DEADLINE = 60.0
"""Seconds in which a segment must be drawn."""
SERVICE_NODE = 'score_service'


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Score the segments of a run in the browser, over its topics, on this or another computer.
    The run goes on without waiting. It must have been started with --scorer person, topic or
    simulated. Ctrl-C ends it; who comes back under the same name goes on. --service serves
    programs that score, in place of a page.
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
    service: Annotated[
        bool,
        tyro.conf.arg(
            help='serve no page but the services score_segment and wanted_segments, to all who '
            'know the token that is printed; each names himself'
        ),
    ] = False
    camera: Annotated[
        str,
        tyro.conf.arg(
            metavar='TOPIC',
            help='show what a camera publishes there (sensor_msgs Image or CompressedImage), in '
            'place of drawing what is simulated',
        ),
    ] = ''
    host: Host = '127.0.0.1'
    port: Port = 0
    allow_name: AllowedNames = ()
    open: Open = False
    peer_deadline: Annotated[
        float, tyro.conf.arg(metavar='S', help='seconds to wait for the run; 0: for ever')
    ] = 60.0


def main(arguments: Sequence[str]) -> int:
    """Serve the page until the run has ended, or Ctrl-C; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr score', arguments=arguments)
    from codetr_ros.cores.desks import misnamed
    from codetr_ros.pages.address import PageError
    from codetr_ros.pages.scoring import Points

    reason = (
        ((wrong := misnamed(given.name)) and f'--name {wrong}')
        or middleware.wrong_namespace(given.namespace)
        or middleware.wrong_seconds('--peer-deadline', given.peer_deadline)
    )
    if reason:
        return refuse(reason)
    try:
        points = Points.of(given.scale)
    except PageError as error:
        return refuse(str(error))
    if given.camera and given.service:
        return refuse('--camera with --service: services show no pictures; leave out one of them')
    try:
        from codetr_ros.ros import camera, score
        from codetr_ros.ros.node import run_node
    except ImportError as error:
        return refuse(
            f'ROS cannot be imported ({error}): a run is scored over its topics. `codetr doctor` '
            'names what is missing'
        )
    if given.camera and (wrong := camera.wrong_topic(given.camera)):
        return refuse(f'--camera {wrong}')
    ros = ['--ros-args', '-r', f'__ns:={given.namespace}', '-p']
    argv = [*ros, f'peer_deadline:={given.peer_deadline}']
    if given.service:
        return run_node('desk', SERVICE_NODE, score.load_services, argv, wire=score.wire)
    page = Page(given, points)
    node = 'score_' + given.name.replace('-', '_')
    code = run_node('desk', node, page.load, argv, wire=page.wire, looks_on=True)
    return code or (FAILED if page.problem else 0)


class Page:
    """The page of a scorer: what makes the core of its node, and its wiring.

    Args:
        given: the command line.
        points: the person's scale.

    Attributes:
        problem: why the run takes nothing of this scorer; None: it does.
    """

    def __init__(self, given: Arguments, points: 'Points') -> None:
        self._given = given
        self._points = points
        self.problem: str | None = None
        from codetr_ros.cores.camera import Camera

        self._camera = Camera(given.camera) if given.camera else None

    def show(self, url: str) -> None:
        """Print the address of the page, and open it if that is wanted."""
        text = f'score as {self._given.name} at {url} (Ctrl-C ends it)'
        browser.show(text, url, self._given.open)

    def refuse(self, desk: 'Desk', problem: str) -> None:
        """Show, here and on the page, that the run takes nothing of this scorer."""
        self.problem = problem
        desk.refuse(problem)
        console(stderr=True).print(
            f'codetr: nothing that {desk.scorer!r} states is taken: {problem}', style='bold red'
        )

    def wire(self, member: 'Membership', joined: 'Joined') -> 'Wiring':
        """The wiring of the node."""
        from codetr_ros.ros.wiring import Wiring

        if member.outside:
            self.refuse(cast('Desk', joined.core), member.outside)
        if self._camera is not None:
            from codetr_ros.ros.camera import CameraWiring

            return CameraWiring(member, joined, self._camera)
        return Wiring(member, joined)

    def load(self) -> 'MakeCore':
        """Import what is needed, and return what makes the core."""
        from codetr_ros.cores.desks import unadmitted
        from codetr_ros.cores.scoring import Desk
        from codetr_ros.pages.scoring import ScoringPage

        given, points, show, camera = self._given, self._points, self.show, self._camera

        class Served(Desk):
            """A desk with a page."""

            def __init__(self, run: 'RunSpec', settings: 'Settings') -> None:
                super().__init__(run, settings, given.name)
                self._page = ScoringPage(self, points, camera or Drawing(self, settings))
                where = given.host, given.port, given.allow_name
                self._server = self._page.serve(*where).__enter__()
                self._open = True
                show(self._server.url)

            def receive(self, record: 'Record') -> None:
                super().receive(record)
                if camera is not None:
                    camera.note(record)

            def work(self) -> Any:
                for records in super().work():
                    self._page.tick()
                    yield records

            def close(self) -> None:
                if self._open:
                    self._open = False
                    self._page.tick()
                    self._server.__exit__(None, None, None)

        def make(run: 'RunSpec', settings: 'Settings', *_: Any) -> 'Core[Any]':
            desk = Served(run, settings)
            if reason := unadmitted(given.name, settings):
                self.refuse(desk, f'{reason}. --name gives the scorer another name')
            return desk

        return make


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

    def __call__(self, segment: 'Segment') -> 'Pictures':
        """Pictures of a segment; none where it cannot be drawn, which is logged once."""
        from codetr_ros.cli import rendering
        from codetr_ros.cores.camera import Pictures
        from codetr_ros.simulation.frames import write_request
        from codetr_ros.system.parsing import read_json

        curves, actions = self._desk.seen.curves(segment), self._desk.seen.actions_before(segment)
        if curves is None or actions is None:
            return Pictures()
        with self._lock, tempfile.TemporaryDirectory() as folder:
            if not self._possible:
                return Pictures()
            sent, made = Path(folder) / 'segment.npz', Path(folder) / 'frames.json'
            source, episode, first, _ = segment
            write_request(sent, self._settings, source, episode, actions, first, curves[0])
            program = (sys.executable, '-m', 'codetr_ros.simulation.frames', str(sent), str(made))
            drawn = rendering.draw(program, made, DRAWING_DEADLINE)
            if drawn.driver is None:
                self._possible = False
                _log.warning('segments are shown by their curves only: %s', drawn.text)
                return Pictures()
            return Pictures(read_json(made))
