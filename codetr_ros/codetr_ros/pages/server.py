"""Serves pages from a thread of this process, to this machine unless another host is asked for.

with Server([page('/', 'watch.html')], feed) as server:
print(server.url)
...
"""

import asyncio
import socket
import threading
from collections.abc import Collection, Sequence
from pathlib import Path
from types import TracebackType

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from codetr_ros.pages.address import HERE, PageError, listen
from codetr_ros.pages.feed import Feed
from codetr_ros.pages.guard import MOST_BYTES, Guard

STATIC = Path(__file__).parent / 'static'
STREAM = '/events'
START_DEADLINE = 10.0
STOP_DEADLINE = 2
"""Seconds in which requests end after `stop`."""
MOST_REQUESTS = 200
"""Connections at once; more are refused with 503."""


def page(path: str, file: str) -> Route:
    """A route to a page of the package.

    Args:
        path: under which it is served.
        file: its name in `static/`.
    """

    async def answer(_: Request) -> Response:
        return FileResponse(STATIC / file, media_type='text/html; charset=utf-8')

    return Route(path, answer)


class Server:
    """Serves pages while it is entered. A context manager; handles no signals.

    Args:
        routes: the pages and what they ask for; `/static` and `/events` are added.
        feed: the live values of the pages.
        host: the address to answer at; any but this machine's own asks browsers for a token.
        port: 0: any that is free.
        names: further names of this machine, by which browsers may ask for the pages.
        most_bytes: of a request's body.

    Raises:
        PageError: on entering: the address cannot be served.
    """

    def __init__(
        self,
        routes: Sequence[BaseRoute],
        feed: Feed,
        host: str = HERE,
        port: int = 0,
        names: Collection[str] = (),
        most_bytes: int = MOST_BYTES,
    ) -> None:
        self._routes = [
            *routes,
            Route(STREAM, feed.answer),
            Mount('/static', StaticFiles(directory=STATIC)),
        ]
        self._feed = feed
        self._wanted = host, port, names
        self._most_bytes = most_bytes

    def __enter__(self) -> 'Server':
        opened, self.address = listen(*self._wanted)
        app = Guard(Starlette(routes=self._routes), self.address, self._most_bytes)
        self._server = _Uvicorn(
            uvicorn.Config(
                app,
                loop='asyncio',
                http='h11',
                ws='none',
                lifespan='off',
                log_config=None,
                access_log=False,  # an address may hold the token
                proxy_headers=False,
                server_header=False,
                limit_concurrency=MOST_REQUESTS,
                timeout_graceful_shutdown=STOP_DEADLINE,
            )
        )
        self._thread = threading.Thread(
            target=self._serve, args=(opened,), name='pages', daemon=True
        )
        self._thread.start()
        if not self._server.running.wait(START_DEADLINE):
            self._stop()
            raise PageError(f'{self.url} was not served within {START_DEADLINE:g} s')
        return self

    @property
    def url(self) -> str:
        """What opens the first page, with the token if it asks for one."""
        return self.address.url

    def _serve(self, opened: socket.socket) -> None:
        with opened:
            asyncio.run(self._server.serve(sockets=[opened]))

    def _stop(self) -> None:
        self._feed.close()
        self._server.should_exit = True
        self._thread.join(2 * STOP_DEADLINE + START_DEADLINE)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop()


class _Uvicorn(uvicorn.Server):
    """States when it answers."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.running = threading.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        self.running.set()
