"""The pictures of a camera that looks at the robot: held for a while, and found by time.

A picture comes from anywhere. It is looked at before it is decoded: nothing large, of another
kind or damaged is taken. What is let go of is counted, and shown beside the pictures.
"""

import base64
import io
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from codetr_ros.cores.seen import Segment
from codetr_ros.records import Record, TaskSpec, Transitions
from codetr_ros.records.shown import shown

Pixels = NDArray[np.uint8]
NS = 10**9
APART = 0.08
"""Seconds between two pictures that are taken, at least: some 10 a second."""
MOST_FRAMES = 3000
"""Pictures that are held: five minutes of ten a second. The oldest go first."""
MOST_BYTES = 64 << 20
"""Bytes of them that are held."""
LARGEST = 32 << 20
"""Bytes of a message with a picture, at most."""
MOST_PIXELS = 1 << 23
"""Of a picture that is decoded."""
WIDEST = 480
"""Pixels of the longer side that are shown; of a larger picture every so many."""
MOST_SHOWN = 24
"""Pictures of a segment that are shown; of more every so many."""
MOST_SPANS = 4096
"""Messages with steps whose times are held."""
RAW = {'rgb8': 3, 'bgr8': 3, 'mono8': 1}
"""Encodings of pictures that are not compressed, and their bytes a pixel."""
KINDS = (b'\xff\xd8\xff', b'\x89PNG\r\n\x1a\n')
"""How JPEG and PNG begin."""


class PictureError(ValueError):
    """A picture that is not taken: states why."""


@dataclass(frozen=True)
class Pictures:
    """What is shown of a segment.

    Attributes:
        frames: pictures as data addresses, in order.
        note: what people should know of them, or why there are none.
    """

    frames: list[str] = field(default_factory=list)
    note: str = ''


@dataclass(frozen=True)
class _Span:
    """When the steps of one message were made."""

    first: int
    steps: int
    begin: int  # [ns]
    end: int

    def at(self, step: int) -> int:
        """When a step began [ns], or, with the step after the last, when the last one ended."""
        return self.begin + (self.end - self.begin) * (step - self.first) // self.steps


class Camera:
    """Holds the newest pictures of a camera, and finds those of a segment.

    A message with steps is stamped when it is published: that is when its last step ended. The
    steps before took a control period each, and no step began before the message before was
    published. Pictures have stamps of the same clock.

    Args:
        topic: of the camera, for people.

    Attributes:
        problem: why no pictures come; empty: they do.
        counts: pictures by what became of them.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.problem = f'nobody publishes pictures on {topic} yet'
        self.counts: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._frames: deque[tuple[int, bytes]] = deque()
        self._bytes = 0
        self._arrived = -np.inf  # monotonic time of the newest that was taken [s]
        self._stamp: int | None = None  # of the message that is being taken
        self._periods: dict[str, float] = {}
        self._ends: dict[str, int] = {}
        self._spans: OrderedDict[tuple[str, int, int], _Span] = OrderedDict()

    # ---- steps

    @contextmanager
    def stamped(self, stamp: int) -> Iterator[None]:
        """Take what is noted meanwhile as published at this time [ns]."""
        self._stamp = stamp
        try:
            yield
        finally:
            self._stamp = None

    def note(self, record: Record) -> None:
        """Note when steps were made; where the time is not known, nothing."""
        if isinstance(record, TaskSpec):
            self._periods[record.source] = record.control_period
        if not isinstance(record, Transitions) or self._stamp is None:
            return
        source, end = record.source, self._stamp
        period = self._periods.get(source, 0.0)
        begin = end - round(record.steps * period * NS)
        before = self._ends.get(source)
        if before is not None:
            begin = max(begin, before) if period else before
        with self._lock:
            key = source, record.episode, record.first_step
            self._spans[key] = _Span(record.first_step, record.steps, min(begin, end), end)
            self._ends[source] = end
            while len(self._spans) > MOST_SPANS:
                self._spans.popitem(last=False)

    def _times(self, segment: Segment) -> tuple[int, int] | None:
        """When a segment began and ended [ns]; None if that is not known."""
        source, episode, first, length = segment
        begin = end = None
        for (its_source, its_episode, _), span in self._spans.items():
            if (its_source, its_episode) == (source, episode):
                after = span.first + span.steps
                if span.first <= first < after:
                    begin = span.at(first)
                if span.first < first + length <= after:
                    end = span.at(first + length)
        return None if begin is None or end is None else (begin, end)

    # ---- pictures

    def due(self, now: float) -> bool:
        """Whether a picture that arrives is taken, which else is counted.

        Args:
            now: monotonic time [s].
        """
        with self._lock:
            if now - self._arrived < APART:
                self.counts['passed over, since more than some 10 a second came'] += 1
                return False
            self._arrived = now
            return True

    def refuse(self, why: object) -> int:
        """Count a picture that is not taken; how many were not."""
        with self._lock:
            self.counts['refused'] += 1
            self.problem = f'a picture on {self.topic} was refused: {shown(str(why))}'
            return self.counts['refused']

    def take(self, at: int, picture: Pixels) -> None:
        """Hold a picture.

        Args:
            at: its time [ns].
            picture: (H, W, 3) or (H, W).
        """
        made = _jpeg(picture)
        with self._lock:
            self.problem = ''
            self.counts['taken'] += 1
            self._frames.append((at, made))
            self._bytes += len(made)
            while len(self._frames) > MOST_FRAMES or self._bytes > MOST_BYTES:
                self._bytes -= len(self._frames.popleft()[1])
                self.counts['let go of, the oldest'] += 1

    def __call__(self, segment: Segment) -> Pictures:
        """The pictures of a segment, or why there are none."""
        with self._lock:
            times = self._times(segment)
            begin, end = times or (0, -1)
            found = [picture for at, picture in self._frames if begin <= at <= end]
            why = '' if found else self._why(times)
            became = ', '.join(f'{n} {what}' for what, n in self.counts.items())
        if not found:
            return Pictures(note=f'no picture of the camera: {why} (pictures: {became or "none"})')
        chosen = np.linspace(0, len(found) - 1, min(len(found), MOST_SHOWN)).round().astype(int)
        frames = ['data:image/jpeg;base64,' + base64.b64encode(found[i]).decode() for i in chosen]
        note = f'{len(frames)} of {len(found)} pictures on {self.topic} ({became})'
        return Pictures(frames, note)

    def _why(self, times: tuple[int, int] | None) -> str:
        if self.problem:
            return self.problem
        if times is None:
            return 'its time is not known, since its steps came before this page was ready'
        (begin, end), oldest, newest = times, self._frames[0][0], self._frames[-1][0]
        one_clock = 'camera and steps must be stamped by one clock'
        if end < oldest:
            return f'it ended {(oldest - end) / NS:.1f} s before the oldest one held; {one_clock}'
        if begin > newest:
            return f'it began {(begin - newest) / NS:.1f} s after the newest one; {one_clock}'
        return 'none came meanwhile'


def decoded(data: bytes) -> Pixels:
    """The pixels (H, W, 3) of a JPEG or a PNG.

    Raises:
        PictureError: it is neither, too large, or damaged.
    """
    import imageio.v3 as iio

    if not data.startswith(KINDS):
        raise PictureError('it is neither JPEG nor PNG: publish one of these')
    try:
        # reads the head alone
        height, width = iio.improps(data, plugin='pillow', index=0).shape[:2]
        _check_size(width, height)
        read = iio.imread(data, plugin='pillow', index=0, mode='RGB')
    except PictureError:
        raise
    except Exception as error:  # noqa: BLE001 - what a damaged picture raises is not documented
        raise PictureError(f'it is damaged ({type(error).__name__}: {error})') from None
    return np.asarray(read, np.uint8)


def unpacked(encoding: str, width: int, height: int, step: int, data: bytes) -> Pixels:
    """The pixels (H, W, 3) or (H, W) of a picture that is not compressed.

    Args:
        encoding: one of `RAW`.
        width: in pixels.
        height: in pixels.
        step: bytes of a row.
        data: the rows.

    Raises:
        PictureError: another encoding, too large, or of another size.
    """
    if encoding not in RAW:
        raise PictureError(f'encoding {shown(repr(encoding))}: publish {", ".join(RAW)}')
    _check_size(width, height)
    row = width * RAW[encoding]
    if step < row or len(data) != step * height:
        raise PictureError(
            f'{width} x {height} pixels {encoding} in rows of {step} bytes do not fit '
            f'{len(data)} bytes'
        )
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, :row]
    if encoding == 'mono8':
        return rows
    pixels = rows.reshape(height, width, 3)
    return pixels[:, :, ::-1] if encoding == 'bgr8' else pixels


def _check_size(width: int, height: int) -> None:
    if not 0 < width * height <= MOST_PIXELS:
        raise PictureError(f'{width} x {height} pixels: 1 to {MOST_PIXELS} are taken')


def _jpeg(picture: Pixels) -> bytes:
    import imageio.v3 as iio

    every = -(-max(picture.shape[:2]) // WIDEST)
    file = io.BytesIO()
    iio.imwrite(file, np.ascontiguousarray(picture[::every, ::every]), extension='.jpg')
    return file.getvalue()
