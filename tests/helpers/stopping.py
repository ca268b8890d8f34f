"""A simulator that stops its own process (SIGSTOP) at a known place of the run, however slow or
busy the machine is. It goes on with SIGCONT.
"""

import os
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

from codetr_ros.processes.launcher import Process, Start
from codetr_ros.records import Transitions
from codetr_ros.ros.node import run_node
from codetr_ros.ros.simulating import Simulating
from helpers.forked import Forked
from sim_node.sim import load

PHASE = 3
"""It stops before it publishes anything of this phase: the one before is committed."""


class Stopping(Simulating):
    """Stops where the first steps of the phase would go out."""

    _has_stopped = False

    def deliver(self, given):
        if isinstance(given, Transitions) and given.phase == PHASE and not self._has_stopped:
            self._has_stopped = True
            os.kill(os.getpid(), signal.SIGSTOP)
        super().deliver(given)


def main() -> int:
    return run_node('sim', 'sim', load, wire=Stopping)


def starter() -> Start:
    """Starts programs as `forked.start_program` does, the first simulator as one that stops."""
    started = set()

    def start(arguments: Sequence[str], environment: Mapping[str, str], log: BinaryIO) -> Process:
        name = Path(arguments[0]).name
        stops = name == 'sim' and name not in started
        started.add(name)
        function = 'helpers.stopping:main' if stops else None
        return Forked(arguments, environment, log, function, death=signal.SIGINT)

    return start
