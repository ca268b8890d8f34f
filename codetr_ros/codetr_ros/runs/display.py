"""Shows the progress of something that runs: in place on a terminal, else in plain lines."""

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import ClassVar, TextIO

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text


class Display(ABC):
    """Shows the progress of something. A context manager.

    Args:
        stream: where to show it.
        live: change the display in place; None: if `stream` is a terminal.
        clock: seconds, never going back.
    """

    plain_every: ClassVar[float]  # seconds between regular plain lines
    live_every: ClassVar[float]  # seconds between changes of the display

    def __init__(
        self,
        stream: TextIO | None = None,
        live: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream = stream or sys.stdout
        self._console = Console(file=self._stream)
        wanted = self._console.is_terminal if live is None else live
        # No thread of its own, which would have to be synchronised with arriving records.
        self._live = Live(console=self._console, auto_refresh=False) if wanted else None
        self._clock = clock
        self._began = self._shown = clock()

    def __enter__(self) -> 'Display':
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.update(self._render(), refresh=True)
            self._live.stop()

    def log(self, text: str, style: str = '') -> None:
        """Print a line above the display; it stays there."""
        self._console.print(Text(text, style=style), soft_wrap=True)
        self._stream.flush()

    def tick(self) -> None:
        """Show the progress if it is due. Call it now and then while nothing arrives."""
        now = self._clock()
        if now - self._shown < (self.plain_every if self._live is None else self.live_every):
            return
        self._shown = now
        if self._live is None:
            self._plain()
        else:
            self._live.update(self._render(), refresh=True)

    @abstractmethod
    def _plain(self) -> None:
        """Show the progress in a line."""

    @abstractmethod
    def _render(self) -> RenderableType:
        """The progress, for the display in place."""
