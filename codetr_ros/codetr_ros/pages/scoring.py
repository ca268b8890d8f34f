"""The page on which a person scores segments.

What a browser sends is checked here like a message, and again by the desk: types, sizes, names.
Nothing of it is executed, and the page shows it as text only.
"""

import asyncio
import math
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from codetr_ros.cores.camera import Pictures
from codetr_ros.cores.scoring import Desk, ScoringError
from codetr_ros.cores.seen import Segment
from codetr_ros.pages.address import HERE, PageError
from codetr_ros.pages.feed import Feed, plain
from codetr_ros.pages.server import Server, page
from codetr_ros.system.parsing import ParseError, parse_json

LARGEST = 2**32 - 1
"""Of episodes and steps."""
LONGEST_NAME = 256
MOST_CURVES = 8
"""Numbers of an observation or an action that are shown."""
MOST_POINTS = 400
"""Steps of a curve that are shown; of longer segments every so many."""

Frames = Callable[[Segment], Pictures]
"""Shows a segment in pictures, or states why not."""


@dataclass(frozen=True)
class Points:
    """The scale of a person: points from the lowest to the highest, or any number."""

    lowest: int
    highest: int  # below `lowest`: any number

    @classmethod
    def of(cls, text: str) -> 'Points':
        """The scale that a text names: `1:5`, or `number`.

        Raises:
            PageError: it names none; states what is allowed.
        """
        if text == 'number':
            return cls(0, -1)
        match = re.fullmatch(r'(-?\d{1,3}):(-?\d{1,3})', text)
        scale = cls(int(match[1]), int(match[2])) if match else None
        if scale is None or not 3 <= scale.highest - scale.lowest + 1 <= 9:
            raise PageError(
                f'--scale {text!r} is no scale: give the lowest and the highest of 3 to 9 points, '
                'such as 1:5, or number for any number'
            )
        return scale

    def admits(self, value: float) -> bool:
        """Whether a score is on the scale."""
        if self.highest < self.lowest:
            return math.isfinite(value)
        return value in range(self.lowest, self.highest + 1)


class ScoringPage:
    """Serves the page of a desk, and tells it what the person states.

    Args:
        desk: what is judged.
        points: the person's scale.
        frames: has pictures of segments; None: only their curves are shown.
    """

    def __init__(self, desk: Desk, points: Points, frames: Frames | None = None) -> None:
        self._desk = desk
        self._points = points
        self._frames = frames
        self._drawing = asyncio.Lock()
        self._seen = -1
        self.feed = Feed()
        self.feed.publish('scale', [points.lowest, points.highest])
        self.tick()

    def tick(self) -> None:
        """Publish what has changed."""
        if self._desk.changes != self._seen:
            self._seen = self._desk.changes
            self.feed.publish('desk', self._desk.document())

    def serve(self, host: str = HERE, port: int = 0, names: Collection[str] = ()) -> Server:
        """What serves the page; arguments as those of a `Server`."""
        routes = [
            page('/', 'score.html'),
            Route('/judge', self._judge, methods=['POST']),
            Route('/segment', self._segment, methods=['POST']),
        ]
        return Server(routes, self.feed, host, port, names)

    async def _judge(self, request: Request) -> Response:
        """Take a judgement; the answer confirms it, with its number."""
        try:
            sent = _object(await request.body(), {'segment', 'other', 'value', 'outcome'})
            first = _segment(sent.get('segment'), 'segment')
            if 'other' in sent:
                second = _segment(sent['other'], 'other')
                given = self._desk.compare(first, second, _number(sent, 'outcome'))
            else:
                value = _number(sent, 'value')
                if not (math.isnan(value) or self._points.admits(value)):
                    raise ScoringError(f'value {value:g} is not on your scale')
                given = self._desk.score(first, value)
        except ScoringError as error:
            return PlainTextResponse(str(error), 422)
        self.tick()
        return JSONResponse(plain(given.document()))

    async def _segment(self, request: Request) -> Response:
        """The curves of a segment, and its pictures where it can be drawn."""
        try:
            sent = _object(await request.body(), {'segment', 'frames'})
            segment = _segment(sent.get('segment'), 'segment')
        except ScoringError as error:
            return PlainTextResponse(str(error), 422)
        if sent.get('frames') is True:
            drawn = await self._drawn(request, segment)
            return JSONResponse({'frames': drawn.frames, 'note': drawn.note})
        curves = self._desk.seen.curves(segment)
        if curves is None:
            return PlainTextResponse('the steps of this segment are not held any more', 404)
        every = -(-segment[3] // MOST_POINTS)
        return JSONResponse(
            {
                'first': segment[2],
                'every': every,
                'observations': _curves(curves[0], every),
                'actions': _curves(curves[1], every),
                'left_out': max(0, curves[0].shape[1] - MOST_CURVES),
                'drawn': self._frames is not None,
            }
        )

    async def _drawn(self, request: Request, segment: Segment) -> Pictures:
        """Pictures of a segment, one segment at a time; none if whoever asked for them has gone on
        to another one before it was their turn.
        """
        async with self._drawing:
            gone = await request.is_disconnected()
            if gone or self._frames is None or self._desk.seen.curves(segment) is None:
                return Pictures()
            return await run_in_threadpool(self._frames, segment)


def _curves(values: Any, every: int) -> list[list[float]]:
    """Some of the columns of (m, D), every so many steps."""
    shown = np.asarray(values[::every, :MOST_CURVES], np.float64).round(5)
    columns: list[list[float]] = shown.T.tolist()
    return columns


def _object(body: bytes, names: Collection[str]) -> dict[str, Any]:
    """The object that a request holds.

    Raises:
        ScoringError: it holds none, or one with other names.
    """
    try:
        sent = parse_json(body.decode())
    except (ParseError, UnicodeDecodeError) as error:
        raise ScoringError(f'what was sent is no JSON: {error}') from None
    if not isinstance(sent, dict):
        raise ScoringError('what was sent is no object')
    if unknown := sorted(set(sent) - set(names)):
        known = ', '.join(sorted(names))
        raise ScoringError(f'unknown: {", ".join(unknown)[:100]}; known: {known}')
    return sent


def _segment(sent: Any, name: str) -> Segment:
    """A segment: [source, episode, first step, length].

    Raises:
        ScoringError: it is none.
    """
    whole = isinstance(sent, list) and len(sent) == 4 and isinstance(sent[0], str)
    if not whole or not 1 <= len(sent[0]) <= LONGEST_NAME:
        raise ScoringError(f'{name} must be [source, episode, first step, length]')
    for number in sent[1:]:
        if type(number) is not int or not 0 <= number <= LARGEST:
            raise ScoringError(f'{name}: {str(number)[:40]} is no number of an episode or step')
    return sent[0], sent[1], sent[2], sent[3]


def _number(sent: dict[str, Any], name: str) -> float:
    """A number; null, which stands for 'cannot tell', is NaN.

    Raises:
        ScoringError: it is missing, or no number.
    """
    if name not in sent:
        raise ScoringError(f'{name} is missing')
    value = sent[name]
    if value is None:
        return math.nan
    if type(value) not in (int, float) or not abs(value) <= 1e100:
        raise ScoringError(f'{name} is no number: {str(value)[:40]}')
    return float(value)
