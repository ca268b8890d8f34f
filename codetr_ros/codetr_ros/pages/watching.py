"""What there is to see of a run, from its folder: while it lasts, later, or of a copy of it.

Nothing in the folder is changed. What is shown comes from `status.json`, `metrics.csv` and the
bag, or `newest_episode.json` where there is none. A run whose nodes were started by hand or by a
launch file has nothing but the bag until `codetr report` makes the rest.
"""

import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route

from codetr_ros import config
from codetr_ros.bags.following import Follower
from codetr_ros.config import Settings
from codetr_ros.pages.address import HERE
from codetr_ros.pages.feed import Feed
from codetr_ros.pages.server import Server, page
from codetr_ros.records import (
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Record,
    RunSpec,
    StepRewards,
    Transitions,
    TrueRewards,
)
from codetr_ros.runs import course
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.newest_episode import NewestEpisode
from codetr_ros.runs.summary import Summary
from codetr_ros.simulation.replay import Recorded
from codetr_ros.system.parsing import ParseError, read_json

TAIL = 64 << 20
"""Bytes of a bag's end in which the newest episode is looked for."""
OF_EPISODES = (Transitions, CompositeReward, TrueRewards, StepRewards)
OF_TABLES = (RunSpec, EpisodeResult, Metrics, Commit)
SILENT = 5.0
"""Seconds after which a page states how old the status of a run is."""


class RunSource:
    """Publishes what a run's folder shows, whenever something has changed.

    Args:
        folder: of the run.
        settings: of the run.
        feed: gets `run` (once), `status`, `columns`, `episode`, `pictures` and `notes`.
        clock: seconds since 1970.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        feed: Feed,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._folder = folder
        self._settings = settings
        self._feed = feed
        self._clock = clock
        self._seen: dict[str, tuple[int, int]] = {}  # file -> when it changed, its size
        self._notes: dict[str, str] = {}  # what it is about -> what is to be known
        self._status: dict[str, Any] = {}
        self._ended: Any = None  # the content of summary.json
        self._bag: Follower | None = None
        self._episode = NewestEpisode()
        self._shown = 0  # changes of the episode that were published
        self.recorded: Recorded | None = None
        """The newest episode as a whole; None if it is not known, as without a bag."""
        self._summary: Summary | None = None  # made of the bag where there is no table
        feed.publish('run', about(folder, settings))

    def poll(self) -> None:
        """Publish what has changed."""
        self._read_status()
        if self._changed(self._folder / run_folder.SUMMARY):
            self._ended = self._read(run_folder.SUMMARY)
        table = self._folder / run_folder.METRICS
        if self._changed(table):
            self._read_table(table)
        episode = self._folder / run_folder.EPISODE
        if (self._folder / run_folder.BAG).is_dir():
            self._follow_bag(with_tables=not table.is_file())
        elif self._changed(episode):
            self._publish_episode(self._read(run_folder.EPISODE))
        self._feed.publish('status', self._status_now())
        self._feed.publish('pictures', self._pictures())
        self._feed.publish('notes', list(self._notes.values()))

    def _changed(self, path: Path) -> bool:
        """Whether a file is there and is not the one of the last call."""
        try:
            state = path.stat()
        except OSError:
            return False
        now = state.st_mtime_ns, state.st_size
        before, self._seen[path.name] = self._seen.get(path.name), now
        return now != before

    def _read(self, name: str) -> Any:
        """The content of a JSON file; None where it cannot be read."""
        self._notes.pop(name, None)
        try:
            return read_json(self._folder / name)
        except (ParseError, OSError) as error:
            self._notes[name] = f'{name} {error}'
            return None

    def _read_status(self) -> None:
        path = self._folder / run_folder.STATUS
        if self._changed(path):
            content = self._read(run_folder.STATUS)
            self._status = content if isinstance(content, dict) else {}

    def _status_now(self) -> dict[str, Any]:
        """The status, from the best source that there is."""
        if self._status:
            silent = None
            if self._status.get('state') == 'running':
                age = self._clock() - self._seen[run_folder.STATUS][0] / 1e9
                silent = 5 * round(age / 5) if age >= SILENT else None
            return self._status | {'silent': silent}
        if isinstance(self._ended, dict):
            return _of_summary(self._ended)
        summary, settings = self._summary, self._settings
        return {
            'run_id': summary and summary.run_id,
            'in_process': False,
            'phase': summary.phases if summary else 0,
            'phases': settings.phases,
            'steps': summary.steps if summary else 0,
            'steps_planned': settings.steps,
        }

    def _read_table(self, path: Path) -> None:
        self._notes.pop(path.name, None)
        try:
            self._publish_columns(course.read(path))
        except run_folder.RunFolderError as error:
            self._notes[path.name] = str(error)

    def _publish_columns(self, columns: dict[str, course.Points]) -> None:
        parted = {
            name: [[step for step, _ in points], [value for _, value in points]]
            for name, points in columns.items()
        }
        losses = course.losses(columns)
        names = {
            words: name
            for words, points in losses.items()
            for name, known in columns.items()
            if known is points
        }
        self._feed.publish('columns', {'points': parted, 'losses': names})

    def _publish_episode(self, shown: Any) -> None:
        if isinstance(shown, dict):
            self._feed.publish('episode', shown)

    def _follow_bag(self, with_tables: bool) -> None:
        if self._bag is None:
            tail = None if with_tables else TAIL
            self._bag = Follower(self._folder / run_folder.BAG, tail)
        before = self._summary.phases if self._summary else -1
        for record in self._bag.records((*OF_EPISODES, *OF_TABLES)):
            self._receive(record, with_tables)
        if self._bag.faults:
            self._notes['bag'] = f'{len(self._bag.faults)} faults: {self._bag.faults[0].text}'
        if self._bag.left_out:
            self._notes['tail'] = (
                f'The newest episode is looked for in the last {TAIL >> 20} MiB of the recording; '
                f'{self._bag.left_out >> 20} MiB before were not read.'
            )
        if self._episode.changes != self._shown:
            self._shown = self._episode.changes
            self._publish_episode(self._episode.document())
            arrays = self._episode.arrays()
            self.recorded = Recorded(*arrays) if arrays else None
        if with_tables and self._summary and self._summary.phases != before:
            self._publish_columns(course.parse(self._summary.metrics_csv().splitlines()))

    def _receive(self, record: Record, with_tables: bool) -> None:
        if isinstance(record, OF_EPISODES):
            self._episode.receive(record)
        elif with_tables:
            if self._summary is None:
                self._summary = Summary(self._settings, record.run_id, in_process=False)
            self._summary.receive(record)

    @property
    def running(self) -> bool:
        """Whether the run lasts, as far as is known."""
        return self._status_now().get('state') in ('running', None)

    def _pictures(self) -> dict[str, Any]:
        """Names of the pictures that are there, each with when it was made."""
        videos = sorted(path.name for path in self._folder.glob('*.mp4'))
        there = {}
        for name in (run_folder.FILM, *videos):
            try:
                there[name] = (self._folder / name).stat().st_mtime_ns // 10**6
            except FileNotFoundError:
                continue
        return there

    def picture(self, name: str) -> Path | None:
        """The file of a picture that `pictures` names; None of anything else."""
        return self._folder / name if name in self._pictures() else None


def about(folder: Path, settings: Settings) -> dict[str, Any]:
    """What a run is, and the settings that make it differ from the nearest preset."""
    values = settings.model_dump(mode='json')
    preset = config.nearest(values)
    return {
        'folder': str(folder.absolute()),
        'task': settings.task,
        'composite': settings.composite,
        'delay': config.delay_in_words(settings.delay),
        'method': settings.method,
        'seed': settings.seed,
        # else what was inferred can be drawn beside the true rewards, on one axis
        'own_unit': settings.scored_elsewhere or settings.score_levels > 0,
        'preset': preset,
        'differences': [
            [name, _shown(there), _shown(here)]
            for name, there, here in config.differences(values, preset)
        ],
    }


def _of_summary(summary: dict[str, Any]) -> dict[str, Any]:
    """The status of a run that has ended, from its summary."""
    names = ('run_id', 'failure', 'command', 'in_process', 'steps', 'steps_planned', 'lost')
    state = 'interrupted' if summary.get('interrupted') else 'finished'
    return {name: summary.get(name) for name in names} | {
        'state': 'failed' if summary.get('failure') else state,
        'phase': summary.get('phases'),
        'phases': summary.get('phases_planned'),
    }


def _shown(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def serve(
    source: RunSource,
    feed: Feed,
    host: str = HERE,
    port: int = 0,
    names: Collection[str] = (),
    videos: Path | None = None,
) -> Server:
    """What serves the page of a run.

    Args:
        source: publishes to `feed`, as often as it is asked to.
        feed: the live values of the page.
        host: as that of a `Server`.
        port: as that of a `Server`.
        names: as those of a `Server`.
        videos: folder of videos of episodes, `<number>.mp4`; None: there are none.
    """

    async def picture(request: Request) -> Response:
        path = source.picture(request.path_params['name'])
        if path is None:
            return PlainTextResponse('there is no such picture', 404)
        return FileResponse(path)

    async def video(request: Request) -> Response:
        path = videos and videos / f'{request.path_params["number"]}.mp4'
        if path is None or not path.is_file():
            return PlainTextResponse('there is no such video', 404)
        return FileResponse(path)

    routes = [
        page('/', 'watch.html'),
        Route('/picture/{name}', picture),
        Route('/video/{number:int}.mp4', video),
    ]
    return Server(routes, feed, host, port, names)
