"""Stop on SIGINT and SIGTERM without a traceback, at any moment of the process.

rclpy's own handlers shut the context down from a thread. That races with everything that still
publishes (a double `shutdown`, publishing on an invalid context, a KeyboardInterrupt in the middle
of a record). Here a signal sets a flag, and the main loop checks it. A second signal changes
nothing.
"""

import faulthandler
import signal
from types import FrameType

from codetr_ros.ros import exit_timer

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """True once a signal has asked the process to stop."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._installed = False

    def __bool__(self) -> bool:
        return self.signal is not None

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is None:
            self.signal = signal.Signals(number)

    def install(self) -> 'Stop':
        """Handle the two signals from now on. Call it first, before any slow import."""
        for number in SIGNALS:
            signal.signal(number, self._note)
        self._installed = True
        return self

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
