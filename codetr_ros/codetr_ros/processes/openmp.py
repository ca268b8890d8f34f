"""How many threads OpenMP starts in a process that computes, and how they wait for work.

torch and numpy compute with them. OpenMP reads these variables once, when torch is imported.
"""

import os
from collections.abc import Mapping

from codetr_ros.config import Settings
from codetr_ros.system import processors

SPINS = 2000
"""Rounds that an OpenMP thread spins before it sleeps: some microseconds, as long as the gap
between two products (docs/decisions/0021-threads-where-they-pay.md).
"""


def threading_environment(
    settings: Settings, environ: Mapping[str, str] = os.environ
) -> dict[str, str]:
    """Environment variables that set how many threads torch and numpy use, and how they wait.

    OpenMP reads them once, when torch is imported: they must be set before.

    Args:
        settings: the run's settings.
        environ: the environment of this process; a `GOMP_SPINCOUNT` in it stays.
    """
    return {'OMP_NUM_THREADS': str(settings.thread_count), **waiting_environment(environ)}


def waiting_environment(environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """The part of `threading_environment` that no setting decides: how threads wait."""
    return {
        # Threads that spin for long starve those of other processes on few cores.
        'OMP_WAIT_POLICY': 'PASSIVE',
        # But a thread that sleeps between two products wakes too late for the second. GNU's
        # OpenMP heeds this number before the policy, unless it has more threads than cores.
        'GOMP_SPINCOUNT': environ.get('GOMP_SPINCOUNT', str(SPINS)),
    }


def crowded(threads: int, load: float) -> str | None:
    """Why so many threads will be slow here; None if the machine has room for them.

    A thread that shares its core with another program keeps all others waiting.

    Args:
        threads: of a process.
        load: load average of the machine before it starts.
    """
    cores = processors.count()
    if threads == 1 or load + threads < cores + 1:
        return None
    return (
        f'{threads} threads in each process, and other programs keep {load:.1f} of {cores} cores '
        'busy: one thread, --threads 1, may be several times as fast'
    )
