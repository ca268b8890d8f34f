"""Run cells on this machine, several processes at a time."""

import time
from collections import deque
from collections.abc import Callable, Sequence

from codetr_ros.benchmark.attempt import Attempt, Job
from codetr_ros.benchmark.folder import Folder
from codetr_ros.benchmark.overview import Overview

_POLL = 0.1  # seconds between looks at the processes


def run(
    folder: Folder,
    jobs: Sequence[Job],
    workers: int,
    overview: Overview,
    stopped: Callable[[], bool],
) -> None:
    """Run cells until all have ended or a stop is requested; leaves no process.

    Args:
        folder: the benchmark's folder, prepared.
        jobs: the cells, in the order in which they begin.
        workers: number of cells at a time.
        overview: shows which cells begin and end.
        stopped: whether to stop; running cells are then lost, ended ones are kept.
    """
    waiting, attempts = deque(jobs), list[Attempt]()
    try:
        while (waiting or attempts) and not stopped():
            while waiting and len(attempts) < workers:
                job = waiting.popleft()
                attempts.append(Attempt(folder, job))
                overview.started(job)
            for attempt in [attempt for attempt in attempts if attempt.over]:
                attempts.remove(attempt)
                overview.ended(attempt.job, attempt.finish())
            overview.tick()
            time.sleep(_POLL)
    finally:
        for attempt in attempts:
            attempt.discard()
