"""Cells on this machine, several processes at a time."""

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
    """Run cells until all have ended or somebody wants to stop; no process is left then.

    Args:
        folder: the benchmark's folder, prepared.
        jobs: the cells, in the order in which they begin.
        workers: how many at a time.
        overview: is told what begins and ends.
        stopped: whether to stop: what runs then is lost, what has ended is kept.
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
