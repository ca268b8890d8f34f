"""The process of a node: ROS from its begin to its end, signals, and what the library logs."""

import gc
import logging
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from codetr_ros.processes import middleware
from codetr_ros.ros import signals
from codetr_ros.ros.signals import Stop

SHUTDOWN_DEADLINE = 8  # [s] for the middleware to shut down, after everything is saved and sent:
# well before `launcher.STOP_DEADLINE`, which counts from the signal


class ToRos(logging.Handler):
    """Hands what the library logs to the node's logger."""

    def __init__(self, log: Any) -> None:
        super().__init__()
        self._log = log

    def emit(self, record: logging.LogRecord) -> None:
        """Log a record."""
        # rclpy insists that one line of code logs with one severity
        if record.levelno >= logging.ERROR:
            self._log.error(self.format(record))
        elif record.levelno >= logging.WARNING:
            self._log.warning(self.format(record))
        else:
            self._log.info(self.format(record))


def in_ros(
    name: str,
    argv: Iterable[str] | None,
    stop: Stop | None,
    body: Callable[[Sequence[str], Stop], int],
    punctual: bool = False,
) -> int:
    """Initialise ROS, do what a node does, and end ROS.

    Args:
        name: node name unless remapped.
        argv: command line without the program; None: that of the process.
        stop: handlers of signals that are installed already; None: install them here.
        body: is the node, given the command line and the handlers; returns the exit code.
        punctual: whether it must not wait for other nodes where it sends.

    Returns:
        Exit code: that of the body, or 2 for arguments that ROS cannot read.
    """
    stop = stop or Stop().install()
    stop.started()
    middleware.set_defaults()
    if punctual:
        middleware.avoid_shared_memory(rclpy.get_rmw_implementation_identifier())
    arguments = sys.argv if argv is None else [name, *argv]
    code: int | None = None
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # an argument, or a parameter file, that ROS cannot read
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    try:
        code = body(arguments, stop)
        return code
    finally:
        rclpy.try_shutdown()
        signals.ignore()
        gc.freeze()  # or the interpreter's last collection goes through all of torch: 2 to 7 s
        if stop.cut_short and code is not None:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
