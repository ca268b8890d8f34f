"""`codetr watch`: a page in the browser that shows a run, live or later."""

import dataclasses
import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from codetr_ros.cli import browser, refuse
from codetr_ros.cli.terminal import parse_arguments

POLL = 0.25
"""Seconds between two looks at the folder."""
NICENESS = 10
"""Whoever watches a run must not slow it down."""
Host = Annotated[
    str,
    tyro.conf.arg(
        metavar='ADDRESS',
        help='address to answer at: this machine only by default; 0.0.0.0 for all that reach it, '
        'who then need the token of the printed address',
    ),
]
Port = Annotated[int, tyro.conf.arg(metavar='N', help='port to answer at; 0: one that is free')]
AllowedNames = Annotated[
    tuple[str, ...],
    tyro.conf.arg(metavar='NAME', help='further names of this machine by which browsers may ask'),
]
Open = Annotated[bool, tyro.conf.arg(help='open the page in the browser, if there is one here')]
"""Where a page is served, and whether it is opened: of every command that serves one."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Show a run in the browser, while it lasts or later: returns and scores, losses, the newest
    episode with its inferred rewards, who takes part, and the settings that differ from a preset.
    Nothing in the folder is changed, and nothing is loaded from the network. Ctrl-C ends it.
    """

    run_dir: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar='RUN', help="the run's folder")
    ]
    host: Host = '127.0.0.1'
    port: Port = 0
    allow_name: AllowedNames = ()
    open: Open = False
    video: Annotated[
        bool | None,
        tyro.conf.arg(
            help='draw the newest episode as a video while somebody looks; by default once the '
            'run is over, since drawing takes processor time'
        ),
    ] = None


def main(arguments: Sequence[str]) -> int:
    """Serve the page until Ctrl-C; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr watch', arguments=arguments)
    from codetr_ros.cli.replayed import EpisodeVideos
    from codetr_ros.config import SettingsError
    from codetr_ros.pages.address import PageError
    from codetr_ros.pages.feed import Feed
    from codetr_ros.pages.watching import RunSource, serve
    from codetr_ros.processes.supervise import Interrupts
    from codetr_ros.runs import folder as run_folder
    from codetr_ros.runs.folder import RunFolderError

    folder = Path(given.run_dir)
    with Interrupts() as interrupts:
        try:
            feed, settings = Feed(), run_folder.read_settings(folder)
            os.nice(NICENESS)
            source = RunSource(folder, settings, feed)
            with (
                EpisodeVideos(folder, settings, partial(feed.publish, 'video')) as videos,
                serve(
                    source, feed, given.host, given.port, given.allow_name, videos.place
                ) as server,
            ):
                text = f'watch {folder} at {server.url} (Ctrl-C ends it)'
                browser.show(text, server.url, given.open)
                while not interrupts.count:
                    source.poll()
                    wanted = not source.running if given.video is None else given.video
                    if wanted and feed.streams:
                        videos.look(source.recorded)
                    time.sleep(POLL)
                source.poll()  # how the run ended
        except (RunFolderError, SettingsError, PageError) as error:
            return refuse(str(error))
    return 0
