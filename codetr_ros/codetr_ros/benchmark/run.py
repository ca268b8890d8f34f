"""Run the unfinished cells of a benchmark, with an overview."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from codetr_ros.benchmark import pool, ray_pool
from codetr_ros.benchmark.attempt import Job
from codetr_ros.benchmark.folder import Folder, session
from codetr_ros.benchmark.overview import Overview
from codetr_ros.benchmark.spec import Spec
from codetr_ros.config.threads import AUTO
from codetr_ros.system import processors


def run(
    spec: Spec,
    path: Path,
    out: Path,
    workers: int,
    ray: str | None,
    retry_failed: bool,
    stopped: Callable[[], bool],
) -> dict[str, str]:
    """Run every cell that is not finished.

    Args:
        spec: the benchmark.
        path: the file of the spec.
        out: its folder.
        workers: cells at a time; not used on Ray, which runs as many as its nodes have cores for.
        ray: address of a Ray cluster, `local` for one on this machine; None runs without Ray.
        retry_failed: run failed cells again.
        stopped: whether a stop is requested.

    Returns:
        The errors of the cells that have failed, now or before, by cell.

    Raises:
        BenchmarkError: the folder is another spec's or has another runner in it, Ray is not
            installed, or its cluster cannot be reached.
    """
    folder = Folder(out)
    spec = settled(spec, folder, workers, ray)
    folder.check(spec)
    if ray is not None:
        ray_pool.check(ray)
    with folder.alone():
        folder.check(spec)  # another runner may have changed it before, but cannot from here on
        folder.prepare(spec, session(path, workers, ray))
        left = folder.clear_attempts()
        jobs, failed = _todo(spec, folder, retry_failed)
        done = len(spec.cells) - len(jobs) - len(failed)
        overview = Overview(folder, jobs, done)
        overview.log(
            f'{len(spec.cells)} cells: {done} finished before, {len(failed)} failed before, '
            f'{len(jobs)} to be run'
        )
        if left:
            overview.log(f'{left} runs that an earlier runner left unfinished were removed')
        if failed:
            overview.log('cells that failed before are run again with --retry-failed')
        for job in jobs:
            if (aside := folder.set_aside(job.cell)) is not None:
                overview.log(f'{job.cell} is not finished: its old folder is now {aside}')
        with overview:
            if ray is not None:
                ray_pool.run(folder, jobs, ray, overview, stopped)
            else:
                _warn(jobs, workers, overview)
                pool.run(folder, jobs, workers, overview, stopped)
    return failed | overview.failed


def settled(spec: Spec, folder: Folder, workers: int, ray: str | None) -> Spec:
    """The same benchmark with one number of threads for all cells, for it decides their bits.

    A folder that is begun keeps its number, however many workers go on with it. For `auto`, cells
    side by side share the cores; on Ray, which finds room for them by itself, each takes one.
    """
    cells = [cell.settings for cell in spec.cells]
    if all(settings.threads != AUTO for settings in cells):
        return spec
    cores = workers if ray else processors.count()
    threads = folder.threads() or min(one.threads_on(cores, workers) for one in cells)
    chosen = {'threads': threads}
    return dataclasses.replace(
        spec,
        base=spec.base.model_copy(update=chosen),
        cells=tuple(
            dataclasses.replace(cell, settings=cell.settings.model_copy(update=chosen))
            for cell in spec.cells
        ),
    )


def _todo(spec: Spec, folder: Folder, retry_failed: bool) -> tuple[list[Job], dict[str, str]]:
    """The cells to run, and the errors of failed cells that are not run again."""
    jobs: list[Job] = []
    failed: dict[str, str] = {}
    for cell in spec.cells:
        settings = cell.settings
        state = folder.state(cell.name, settings.hash())
        if state == 'failed' and not retry_failed:
            failed[cell.name] = folder.error(cell.name)
        elif state != 'finished':
            threads = max(settings.thread_count, min(settings.envs, processors.count()))
            jobs.append(
                Job(
                    cell=cell.name,
                    settings_hash=settings.hash(),
                    steps=settings.steps,
                    phases=settings.phases,
                    threads=threads,
                )
            )
    return jobs, failed


def _warn(jobs: list[Job], workers: int, overview: Overview) -> None:
    cores = processors.count()
    threads = max((job.threads for job in jobs), default=1)
    if workers * threads > cores:
        overview.log(
            f'{workers} workers with {threads} threads each on {cores} cores: they will wait for '
            'each other; give fewer --workers, or lower config.threads or config.envs in the spec',
            'yellow',
        )
