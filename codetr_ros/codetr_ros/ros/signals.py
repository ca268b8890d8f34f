"""Stop on SIGINT and SIGTERM without a traceback, at any moment of the process.

rclpy's own handlers shut the context down from a thread. That races with everything that still
publishes (a double `shutdown`, publishing on an invalid context, a KeyboardInterrupt in the middle
of a record). Here a signal sets a flag, and the main loop checks it. A second signal changes
nothing.

Imports take seconds, in which nothing checks a flag, and `ros2 launch` kills a process that has
not ended ten seconds after its first signal. So a signal ends the process at once while it still
imports what makes it a node, and later cuts an import, or a first slice that compiles, short by an
exception.
"""

import faulthandler
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from codetr_ros.ros import exit_timer

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(BaseException):
    """A signal has cut something short. No error, so that nothing which is imported catches it."""


class Stop:
    """True once a signal has asked the process to stop.

    Attributes:
        signal: the first signal; None before.
        cut_short: whether something was: what was imported may be in halves, and the process must
            end without the interpreter's own end.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self.cut_short = False
        self._installed = False
        self._starting = False
        self._importing = False

    def __bool__(self) -> bool:
        return self.signal is not None

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is None:
            self.signal = signal.Signals(number)
        if self._starting:
            name = signal.Signals(number).name
            os.write(2, f'stopped by {name} before it had started\n'.encode())
            os._exit(0)
        if self._importing:
            self.cut_short = True
            raise Stopped

    def install(self, starting: bool = False) -> 'Stop':
        """Handle the two signals from now on. Call it first, before any slow import.

        Args:
            starting: until `started` is called, a signal ends the process at once, with exit code
                0: nobody knows of it yet, and nothing is lost.
        """
        for number in SIGNALS:
            signal.signal(number, self._note)
        self._installed = True
        self._starting = starting
        return self

    def started(self) -> None:
        """From now on a signal sets the flag, and the process ends in order."""
        self._starting = False

    @contextmanager
    def cutting_short(self) -> Iterator[None]:
        """Let a signal cut short what runs inside.

        Raises:
            Stopped: it did, or had come before.
        """
        self._importing = True
        try:
            if self:
                raise Stopped
            yield
        finally:
            self._importing = False
        if self:  # what was imported has caught it
            raise Stopped

    def end_within(self, seconds: int, code: int) -> None:
        """End this process with an exit code if it still runs after that many seconds.

        For its last moments, when everything is saved. A middleware that hangs during shutdown
        (seen, rarely, under load) holds the interpreter, and no Python code could end the process.
        A second before the end, a traceback on standard error shows where it hangs.
        """
        if self._installed:
            faulthandler.dump_traceback_later(max(seconds - 1, 0.1))
            exit_timer.start(seconds, code)


def ignore() -> None:
    """Ignore both from now on. Call it last: an interpreter that ends restores the deadly
    defaults.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
