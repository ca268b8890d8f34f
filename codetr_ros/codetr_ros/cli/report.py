"""`codetr report`: the summary, report and pictures of a run from what lies in its folder."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated

import tyro

from codetr_ros.cli import FAILED, benchmark, refuse, results
from codetr_ros.cli import film as film_strip
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import Settings, SettingsError, from_canonical
from codetr_ros.records import RunSpec
from codetr_ros.records.fields import type_name
from codetr_ros.records.roles import TABLE
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import report, reports, run_summary
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.runs.summary import Summary
from codetr_ros.system.parsing import ParseError, read_json

OWN = 'codetr'
"""What a summary calls the process of `codetr train`."""
BENCHMARK = 'benchmark.json'
"""Lies in the folder of a benchmark: `benchmark.folder.INDEX`, which is slow to import."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Make the summary, report and pictures of a run, and print its results.

    For a run whose nodes were started by hand or by a launch file, for one that was killed, and
    for one that still runs. Everything is taken from the bag, the nodes' reports and the settings
    in the folder. What `codetr train` alone can know is taken from its summary, if there is one.
    The folder of a benchmark gets the report of `codetr benchmark report`.
    """

    run_dir: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(metavar='FOLDER', help="the run's folder")
    ]
    film: Annotated[bool, tyro.conf.arg(help=film_strip.HELP)] = True


@dataclasses.dataclass(frozen=True)
class Found:
    """What lies in the folder of a run.

    Attributes:
        reports: of its nodes, by `<role>-<name>`.
        bag: its bag; None without one.
        before: its summary, if one was made before.
    """

    reports: Mapping[str, NodeReport]
    bag: Path | None
    before: RunSummary | None


def main(arguments: Sequence[str]) -> int:
    """Make and print it; returns the exit code."""
    given = parse_arguments(Arguments, arguments, 'codetr report')
    folder = given.run_dir.absolute()
    if (folder / BENCHMARK).is_file():
        return benchmark.main(['report', str(given.run_dir)])
    shown = console()

    def log(text: str) -> None:
        shown.print(text)

    try:
        found = look(folder)
        if found.bag is None:
            built = again(folder, found, given.film)
        else:
            built = from_bag(folder, found, found.bag, log, given.film)
    except (RunFolderError, SettingsError) as error:
        return refuse(str(error))
    except OSError as error:
        refuse(str(error))
        return FAILED
    results.show(built, folder, console(tables=True))
    if built.failure:
        log(f'\nthe run failed: {built.failure}')
    return 0


def look(folder: Path) -> Found:
    """Look what the folder of a run holds.

    Raises:
        RunFolderError: it is no such folder, or a node's report or the summary is damaged.
    """
    if not folder.is_dir():
        what = f'{folder} is a file' if folder.exists() else f'there is no folder {folder}'
        raise RunFolderError(f'{what}: give {_meant(folder)}')
    known = reports.read_all(folder)
    places = [folder / run_folder.BAG, *(Path(r.bag) for r in known.values() if r.bag)]
    bag = next((place for place in places if place.exists()), None)
    path = folder / run_folder.SUMMARY
    if bag is None and path.exists():
        _check_no_fit(path)
    return Found(known, bag, run_summary.read(path) if path.exists() else None)


def _check_no_fit(path: Path) -> None:
    """Refuse the summary of a fit: its report cannot be made again, and is there.

    Raises:
        RunFolderError: it is one.
    """
    try:
        content = read_json(path)
    except (OSError, ParseError):
        return  # whoever reads it in full names what is wrong
    if isinstance(content, dict) and 'fit' in content:
        raise RunFolderError(
            f'{path.parent} is the folder of a fit, whose report is '
            f'{path.with_name(run_folder.REPORT)}: give the folder of a run'
        )


def _meant(place: Path) -> str:
    """The folder of the run that a place seems to lie in, for an error."""
    own = (run_folder.BAG, run_folder.SUMMARY)
    around = (f for f in list(place.parents)[:2] if any((f / name).exists() for name in own))
    return next((f'the folder of the run, {folder}' for folder in around), 'the folder of a run')


def again(folder: Path, found: Found, draw: bool) -> RunSummary:
    """Write picture and report again from the summary of a run without a bag.

    Raises:
        RunFolderError: there is no summary either.
        OSError: they cannot be written.
    """
    if found.before is None:
        raise RunFolderError(
            f'{folder} holds neither a {run_folder.BAG} nor a {run_folder.SUMMARY}, so nothing is '
            f'known of a run: give {_meant(folder)}. Nodes leave a bag there if the recorder has '
            'that folder as its parameter `folder`'
        )
    report.write(folder, found.before, film_strip.make(folder) if draw else '')
    return found.before


def from_bag(
    folder: Path, found: Found, bag: Path, log: Callable[[str], None], draw: bool
) -> RunSummary:
    """Write summary, metrics, picture and report of a run from its bag.

    Args:
        folder: the run's folder.
        found: what is in it.
        bag: its bag.
        log: prints a line for people.
        draw: draw the robot too.

    Raises:
        RunFolderError: the bag holds no run.
        SettingsError: the settings of the run cannot be read.
        OSError: a file cannot be written.
    """
    run_id, settings, began, seconds = _recorded(bag)
    before = found.before
    if before is not None and (before.run_id != run_id or OWN not in before.processes):
        before = None  # of another run, or made by this command, perhaps while the run went on
    summary = Summary(settings, run_id, in_process=False)
    summary.start = began
    results.complete(summary, bag, log)
    walls = [r.wall_s for r in found.reports.values() if r.wall_s is not None]
    summary.end(before.wall_s if before else max(walls, default=seconds))
    named = {
        name: r.model_copy(
            update={
                'exit_code': before.processes[name].exit_code,
                'restarts': before.processes[name].restarts,
            }
        )
        if before and name in before.processes
        else r
        for name, r in found.reports.items()
    }
    needed = _needed(settings, found.reports)
    built = summary.build(
        named,
        bag,
        before.interrupted if before else _interrupted(needed),
        before.failure if before else _failure(needed),
    )
    built = built.model_copy(update=_kept(built, before))
    results.write(folder, summary, built, draw)
    return built


def _recorded(bag: Path) -> tuple[str, Settings, datetime, float]:
    """The id and the settings of the run in a bag, when recording began and how many seconds it
    took.
    """
    from codetr_ros.bags.errors import BagError
    from codetr_ros.bags.reader import Bag

    runs: dict[str, RunSpec] = {}
    first = last = 0
    try:
        for raw in (opened := Bag(bag, lambda _: None)).raw():
            first, last = first or raw.log_time, raw.log_time
            entry = opened.entry(raw) if raw.channel.type == type_name(RunSpec) else None
            if entry is not None and isinstance(entry.record, RunSpec):
                runs[entry.record.run_id] = entry.record
    except BagError as error:
        raise RunFolderError(str(error)) from None
    if len(runs) != 1:
        there = f'{len(runs)} runs ({", ".join(runs)})' if runs else 'no run'
        raise RunFolderError(f'{bag} holds {there}: give the folder of one run')
    (run,) = runs.values()
    settings = from_canonical(run.settings, f'{bag}: run {run.run_id!r}')
    began = datetime.fromtimestamp(first / 1e9).astimezone()
    return run.run_id, settings, began, (last - first) / 1e9


def _kept(built: RunSummary, before: RunSummary | None) -> dict[str, object]:
    """What only the process that has done the run could know: what it took, and its versions."""
    processes = {name: use for name, use in built.processes.items() if name != OWN}
    if before is None:
        return {'processes': processes, 'host': None}
    taken = {OWN: before.processes[OWN]}
    kept = {name: getattr(before, name) for name in ('versions', 'began', 'host', 'command')}
    return {'processes': processes | taken, **kept}


def _needed(settings: Settings, reports: Mapping[str, NodeReport]) -> list[NodeReport]:
    """The reports of nodes that a run cannot do without: simulators in `joiners` come and go."""
    return [
        report
        for report in reports.values()
        if not TABLE[report.role].dispensable
        and not (report.role == 'sim' and report.name in settings.joiners)
    ]


def _failure(needed: Sequence[NodeReport]) -> str | None:
    """Why the nodes gave up, the first one first: the others followed it. None if none did."""
    gone = sorted(needed, key=lambda one: math.inf if one.wall_s is None else one.wall_s)
    why = [f'{report.name}: {report.error}' for report in gone if report.error]
    return '; '.join(why) or None


def _interrupted(needed: Sequence[NodeReport]) -> bool:
    """Whether nodes were asked to end before the run was over."""
    return any(report.finished is False and not report.error for report in needed)
