"""`codetr benchmark`: do many runs under one protocol, and make a table of them."""

import dataclasses
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from codetr_ros.cli import FAILED, INTERRUPTED, refuse, refuse_command
from codetr_ros.cli.terminal import parse_arguments
from codetr_ros.config import Settings
from codetr_ros.processes.supervise import Interrupts


@dataclasses.dataclass(frozen=True)
class Run:
    """Run every cell of a benchmark that is not finished yet.

    A cell is one run in process, of one method, task, composite reward, delay and seed: the spec
    lists them, and all combinations are run. After a stop or a crash, the same command goes on:
    finished cells are kept, unfinished ones begin again. Exit code 1: a cell has failed.
    """

    spec: Annotated[
        str,
        tyro.conf.Positional,
        tyro.conf.arg(
            metavar='SPEC.yaml',
            help='keys: methods, tasks, composites, delays, seeds, steps, and optionally config: '
            'a preset or file, or settings, with `base` for the preset or file they change',
        ),
    ]
    out: Annotated[str, tyro.conf.arg(metavar='DIR', help="the benchmark's folder")]
    workers: Annotated[
        int,
        tyro.conf.arg(metavar='N', help='cells at a time; with threads auto they share the cores'),
    ] = 1
    ray: Annotated[
        str | None,
        tyro.conf.arg(
            metavar='ADDRESS',
            help='run the cells on a Ray cluster instead of with --workers; all of its nodes must '
            'see DIR; `local` starts one on this machine',
        ),
    ] = None
    retry_failed: Annotated[
        bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help='run failed cells again')
    ] = False


@dataclasses.dataclass(frozen=True)
class Report:
    """Make a report of one or several benchmarks: tables, pictures and failures.

    Writes index.html, table.md, pictures, and CSV files: table, standings, cells, evaluations.
    """

    folders: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar='DIR [DIR ...]', help="the benchmarks' folders"),
    ]
    out: Annotated[
        str | None, tyro.conf.arg(metavar='DIR', help='report folder; by default DIR/report')
    ] = None


def main(arguments: Sequence[str]) -> int:
    """Carry out the command line; returns the exit code."""
    known = ('run', 'report')
    if arguments and not arguments[0].startswith('-') and arguments[0] not in known:
        return refuse_command(f'benchmark {arguments[0]}', arguments[0], known)
    kinds: Any = (
        Annotated[Run, tyro.conf.subcommand(known[0])]
        | Annotated[Report, tyro.conf.subcommand(known[1])]
    )
    given: Run | Report = parse_arguments(
        kinds,
        prog='codetr benchmark',
        description='Do many runs under one protocol, and make a table of them.',
        arguments=arguments,
    )
    return _run(given) if isinstance(given, Run) else _report(given)


def _try_out(runs: Iterable[Settings]) -> None:
    """Try out what these runs need, each task and device once.

    Raises:
        TryoutError: no run with one of them can be done.
    """
    from codetr_ros.cli import tryout

    wanted = {(run.task, run.device, run.reward_device): run for run in runs}
    for settings in wanted.values():
        tryout.apart(settings, os.environ)


def _run(given: Run) -> int:
    from codetr_ros.benchmark import run, spec
    from codetr_ros.cli.tryout import TryoutError

    if given.workers < 1:
        return refuse(f'--workers {given.workers}: at least 1')
    path, out = Path(given.spec), Path(given.out)
    with Interrupts() as interrupts:
        try:
            loaded = spec.load(path)
            if given.ray is None:  # the machines of a cluster may have what this one lacks
                _try_out(cell.settings for cell in loaded.cells)
            failed = run.run(
                loaded,
                path,
                out,
                given.workers,
                given.ray,
                given.retry_failed,
                lambda: interrupts.count > 0,
            )
        except (spec.BenchmarkError, TryoutError) as error:
            return refuse(str(error))
    if interrupts.count:
        print('stopped: what has ended is kept; the same command goes on')
        return INTERRUPTED
    if failed:
        print(f'{len(failed)} cells have failed:')
        for cell, why in failed.items():
            print(f'  {cell}: {why}')
        print(f'their logs: {out}/cells/<cell>.log; --retry-failed runs them again')
    return FAILED if failed else 0


def _report(given: Report) -> int:
    from codetr_ros.benchmark import report, spec
    from codetr_ros.simulation.tasks import TaskError

    if not given.folders:
        return refuse('benchmark report: give the folder of a benchmark')
    try:
        folder, text = report.write(
            [Path(name) for name in given.folders], Path(given.out) if given.out else None
        )
    except (spec.BenchmarkError, TaskError) as error:
        return refuse(str(error))
    print(text)
    print(f'report: {folder / "index.html"}')
    return 0
