"""What is shown while something runs: in place on a terminal, else plain lines."""

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
    """Shows how something is doing, while used as a context.

    Args:
        stream: where to show it.
        live: change the display in place; by default if `stream` is a terminal.
        clock: seconds, never going back.
    """

    plain_every: ClassVar[float]  # seconds between plain lines that nothing else asks for
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
        # No thread of its own: what arrives and the display would have to be kept from each other.
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

    def say(self, text: str, style: str = '') -> None:
        """Show a line above the display, to stay."""
        self._console.print(Text(text, style=style), soft_wrap=True)
        self._stream.flush()

    def tick(self) -> None:
        """Show how things are, if it is time; to be called now and then while nothing arrives."""
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
        """Say how things are in a line."""

    @abstractmethod
    def _render(self) -> RenderableType:
        """How things are, for the display in place."""
