"""Run cells on a Ray cluster: each attempt is a task, and runs again when a node dies.

Every node has this package installed and sees the benchmark's folder under the same path. Ray
(requirements-ray.txt) is imported only here, and only for `--ray`. It pickles the arguments of its
workers: a folder's name and a `Job`.
"""

import importlib.util
import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from codetr_ros.benchmark.attempt import Attempt, Job, running
from codetr_ros.benchmark.folder import Folder, provenance, read_json
from codetr_ros.benchmark.overview import Overview
from codetr_ros.benchmark.spec import BenchmarkError
from codetr_ros.system.files import atomic_write

RETRIES = 3
"""How often a cell that loses its node begins again."""
PATIENCE = 300.0
"""Seconds to wait for a node that has enough cores, once none is left."""
_CANCEL = 20.0  # seconds for running cells to end after a stop is requested
_CONNECT = 5.0  # seconds within which a cluster must answer
_POLL = 0.5  # seconds between looks at the cluster and the folder


def check(address: str) -> None:
    """Check that Ray is installed and that something answers at the address.

    Raises:
        BenchmarkError: it is not installed, or no cluster answers; names the remedy.
    """
    if importlib.util.find_spec('ray') is None:
        raise BenchmarkError(
            '--ray: Ray is not installed. Install it with `pip install -r requirements-ray.txt`, '
            'on every node, or use --workers instead of --ray'
        )
    if address in ('auto', 'local'):
        return
    host, _, port = address.rpartition(':')
    try:
        # Ray itself would keep trying for minutes
        socket.create_connection((host.strip('[]'), int(port)), _CONNECT).close()
    except (OSError, ValueError, OverflowError) as error:
        raise BenchmarkError(_unreachable(address, error)) from None


def _unreachable(address: str, error: Exception) -> str:
    return (
        f'--ray {address}: the cluster cannot be reached ({error}). Give the host:port that '
        '`ray start --head` named, `auto` on a node of the cluster, or `local`'
    )


def run(
    folder: Folder,
    jobs: Sequence[Job],
    address: str,
    overview: Overview,
    stopped: Callable[[], bool],
) -> None:
    """Run cells until all have ended or a stop is requested.

    Args:
        folder: the benchmark's folder, prepared.
        jobs: the cells.
        address: of the cluster, as `ray.init` takes it.
        overview: shows which cells begin and end.
        stopped: whether to stop; running cells are then lost, ended ones are kept.

    Raises:
        BenchmarkError: the cluster cannot be reached, or has no node with as many cores as a cell
            takes threads.
    """
    import ray

    with _connected(address):
        watch = _Nodes(max((job.threads for job in jobs), default=1))
        watch.look(patience=0.0)
        work = ray.remote(_work)
        pending = {
            work.options(num_cpus=job.threads, max_retries=RETRIES, name=job.cell).remote(
                str(folder.path), job
            ): job
            for job in jobs
        }
        begun: set[str] = set()
        try:
            while pending and not stopped():
                watch.look(PATIENCE)
                ended, _ = ray.wait(list(pending), num_returns=1, timeout=_POLL)
                for job in pending.values():
                    if job.cell not in begun and running(folder, job.cell) is not None:
                        begun.add(job.cell)
                        overview.started(job)
                for task in ended:
                    job = pending.pop(task)
                    if job.cell not in begun:
                        overview.started(job)
                    overview.ended(job, _ending(folder, job, task))
                overview.tick()
        finally:
            _cancel(list(pending))
            folder.clear_attempts()  # those of dead nodes


@contextmanager
def _connected(address: str) -> Iterator[None]:
    import ray

    os.environ.setdefault('RAY_USAGE_STATS_ENABLED', '0')
    before = signal.getsignal(signal.SIGTERM)  # Ray replaces this handler
    try:
        ray.init(address=address, log_to_driver=False, include_dashboard=_dashboard(address))
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise BenchmarkError(_unreachable(address, error)) from None
    signal.signal(signal.SIGTERM, before)
    try:
        yield
    finally:
        ray.shutdown()


def _dashboard(address: str) -> bool | None:
    """No dashboard for a cluster of our own; an existing cluster has decided already."""
    return False if address == 'local' else None


class _Nodes:
    """Checks that the cluster has a node with enough cores for a cell."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._last = time.monotonic()

    def look(self, patience: float) -> None:
        """Look at the nodes; give up after `patience` seconds without one.

        Raises:
            BenchmarkError: no node has had enough cores for that long.
        """
        import ray

        most = max((n['Resources'].get('CPU', 0) for n in ray.nodes() if n['Alive']), default=0)
        if most >= self._threads:
            self._last = time.monotonic()
        elif time.monotonic() - self._last >= patience:
            raise BenchmarkError(
                f'no node of the Ray cluster has the {self._threads} cores that a cell takes '
                f'(the most is {most:g}): add a node, or lower config.threads in the spec'
            )


def _work(path: str, job: Job) -> dict[str, Any]:
    """Do one attempt at a cell on a node, from beginning to end."""
    folder = Folder(Path(path))
    if not folder.settings(job.cell).is_file():
        raise BenchmarkError(
            f'{folder.settings(job.cell)} is not on this node ({os.uname().nodename}): all nodes '
            'must share the folder given with --out, under the same path'
        )
    if folder.state(job.cell, job.settings_hash) == 'finished':
        # done by a node that died before it could report it
        return read_json(folder.ending(job.cell)) or {'error': None, 'log': None}
    attempt = Attempt(folder, job)
    try:
        while not attempt.over:
            time.sleep(0.1)
        return attempt.finish()
    except BaseException:  # a task that is cancelled sees KeyboardInterrupt
        attempt.discard()
        raise


def _ending(folder: Folder, job: Job, task: Any) -> dict[str, Any]:
    """The ending of a finished task; that of a lost one is made here and saved."""
    import ray

    try:
        ending: dict[str, Any] = ray.get(task)
    except ray.exceptions.RayError as error:
        cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
        ending = {
            'cell': job.cell,
            'settings_hash': job.settings_hash,
            'error': f'{type(cause).__name__}: {cause}'.strip().splitlines()[0],
            'exit_code': None,
            'log': str(error),
            'wall_s': None,
            **provenance(),
        }
        atomic_write(folder.ending(job.cell), json.dumps(ending, indent=1) + '\n')
    return ending


def _cancel(tasks: list[Any]) -> None:
    """End tasks: cancel them so that they remove their output, then kill those that are left."""
    import ray

    for task in tasks:
        ray.cancel(task)
    if tasks:
        _, left = ray.wait(tasks, num_returns=len(tasks), timeout=_CANCEL)
        for task in left:
            ray.cancel(task, force=True)
