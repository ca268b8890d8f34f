"""Runs that are held before a phase: their learner permits it when the test lets it.

So a test that wants to do something in the midst of a run is never too late for it, however long
the machine lets it stand still. The learner itself stays alive meanwhile: it publishes its
presence, takes what comes and ends when it is asked to. It is the learner of every run, in a node
as `ros2 run learner_node learner` starts it, but for the moment at which it yields a policy.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from codetr_ros.ros.joining import MakeCore

VARIABLE = 'CODETR_TESTS_HELD'
"""Names the file with the number of the first phase that is not permitted; no file: all are."""
POLL = 0.05  # [s] between two looks at it


class Hold:
    """Which phases the learner of a run may permit.

    Args:
        file: says it to the learner.
        phase: the first one that it may not permit.
    """

    def __init__(self, file: Path, phase: int) -> None:
        self._file = file
        self.before(phase)

    def before(self, phase: int) -> None:
        """Let the run go on, and hold it before another phase."""
        self.phase = phase
        new = self._file.with_suffix('.new')
        new.write_text(str(phase))
        new.replace(self._file)

    def release(self) -> None:
        """Let the run go on to its end."""
        self._file.unlink(missing_ok=True)


@contextmanager
def held(file: Path, phase: int) -> Iterator[Hold]:
    """Hold the runs that are started meanwhile, with forked nodes, before a phase.

    Args:
        file: where none is yet.
        phase: the first one that is not permitted; the phases before, which are permitted at the
            start, cannot be held.
    """
    hold = Hold(file, phase)
    os.environ[VARIABLE] = str(file)
    try:
        yield hold
    finally:
        del os.environ[VARIABLE]
        hold.release()


def is_held(phase: int) -> bool:
    """Whether the test wants a phase not to be permitted yet."""
    try:
        return phase >= int(Path(os.environ[VARIABLE]).read_text())
    except FileNotFoundError:
        return False


def learner() -> int:
    """What `learner_node.learner` does, with a learner that can be held."""
    from codetr_ros.ros.signals import Stop

    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('learner', 'learner', _load, None, stop)


def _load() -> 'MakeCore':
    from codetr_ros.cores.learner import Learner
    from codetr_ros.records import Policy, Record

    class Held(Learner):
        """Yields a policy only when it may."""

        def work(self) -> Iterator[list[Record] | None]:
            for given in super().work():
                phases = [each.phase for each in given or () if isinstance(each, Policy)]
                while phases and is_held(max(phases)):
                    time.sleep(POLL)
                    yield []  # it works, for all that others can see: nobody waits in vain
                yield given

    return Held
