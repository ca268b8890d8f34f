"""Stop on SIGINT and SIGTERM without a traceback, whatever the process is doing.

rclpy's own handlers shut the context down from a thread, which races with everything that still
publishes (a double `shutdown`, publishing on an invalid context, a KeyboardInterrupt in the middle
of a record). Here a signal sets a flag, which the main loop looks at; a second signal changes
nothing.
"""

import faulthandler
import signal
from types import FrameType

from codetr_ros.ros import exit_timer

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """True once somebody has asked the process to stop."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._installed = False

    def __bool__(self) -> bool:
        return self.signal is not None

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is None:
            self.signal = signal.Signals(number)

    def install(self) -> 'Stop':
        """Take the two signals; call it first of all, before anything slow is imported."""
        for number in SIGNALS:
            signal.signal(number, self._note)
        self._installed = True
        return self

    def end_within(self, seconds: int, code: int) -> None:
        """Have this process end with an exit code if it is still there after that long.

        For its last moments, when everything is saved: a middleware that hangs while it shuts down
        (seen, rarely, under load) holds the interpreter, and nothing written in Python could end
        it. A second before the end, it is written to standard error where the process hangs.
        """
        if self._installed:
            faulthandler.dump_traceback_later(max(seconds - 1, 0.1))
            exit_timer.start(seconds, code)


def ignore() -> None:
    """Ignore both from now on: last of all, since an interpreter that ends restores the deadly
    defaults.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
