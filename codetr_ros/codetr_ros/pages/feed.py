"""Live values of a page: each by name, the newest to whoever looks, as server-sent events."""

import asyncio
import json
import math
import threading
from collections.abc import AsyncIterator
from typing import Any

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse

BEAT = 15.0
"""Seconds after which something is sent anyway, so that both sides notice that the other has gone.
"""
MOST_STREAMS = 100
"""Pages that may look at once."""


def plain(value: Any) -> Any:
    """A value as JSON has it: NaN and infinities, which JSON lacks, become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(name): plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return value


def to_json(value: Any) -> str:
    """A value as a line of JSON."""
    return json.dumps(plain(value), allow_nan=False, separators=(',', ':'))


class Feed:
    """The newest value of each name, sent to every page that looks. Any thread may publish.

    A value is a state, not an event: a page that is slow gets the newest, and no older one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._values: dict[str, tuple[int, str]] = {}  # name -> number of the change, JSON
        self._changes = 0
        self._closed = False
        self._woken: dict[asyncio.Event, asyncio.AbstractEventLoop] = {}

    def publish(self, name: str, value: Any) -> None:
        """Set a value, and send it if it has changed.

        Args:
            name: letters, digits and `_`.
            value: what JSON can hold; NaN becomes null.
        """
        text = to_json(value)
        with self._lock:
            if name in self._values and self._values[name][1] == text:
                return
            self._changes += 1
            self._values[name] = self._changes, text
        self._wake()

    def close(self) -> None:
        """End all streams."""
        self._closed = True
        self._wake()

    @property
    def streams(self) -> int:
        """Pages that look now."""
        return len(self._woken)

    def _wake(self) -> None:
        with self._lock:
            waiting = list(self._woken.items())
        for event, loop in waiting:
            if not loop.is_closed():
                loop.call_soon_threadsafe(event.set)

    def _newer(self, seen: int) -> tuple[int, str]:
        """What changed after a change, as events; and the number of the last change."""
        with self._lock:
            changes = sorted(
                (number, name, text)
                for name, (number, text) in self._values.items()
                if number > seen
            )
            last = self._changes
        return last, ''.join(
            f'id: {number}\nevent: {name}\ndata: {text}\n\n' for number, name, text in changes
        )

    async def stream(self) -> AsyncIterator[str]:
        """The events for one page: first all values, then each change."""
        event = asyncio.Event()
        with self._lock:
            self._woken[event] = asyncio.get_running_loop()
        try:
            yield 'retry: 1000\n\n'
            seen = 0
            while not self._closed:
                event.clear()
                seen, text = self._newer(seen)
                if text:
                    yield text
                try:
                    await asyncio.wait_for(event.wait(), BEAT)
                except asyncio.TimeoutError:
                    yield ': still here\n\n'
            yield self._newer(seen)[1]  # what was published just before the end
        finally:
            with self._lock:
                del self._woken[event]

    async def answer(self, request: Request) -> Response:
        """The endpoint of the stream."""
        if self.streams >= MOST_STREAMS:
            text = f'{MOST_STREAMS} pages look already: close some of them'
            return PlainTextResponse(text, 503, {'Retry-After': '5'})
        return StreamingResponse(self.stream(), media_type='text/event-stream')
