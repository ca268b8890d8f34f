"""What the end of a run leaves and shows: summary, report and pictures, and a table of them."""

import os
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from codetr_ros.cli import film
from codetr_ros.processes import launcher
from codetr_ros.records import (
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Record,
    StepRewards,
    TrueRewards,
)
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import report
from codetr_ros.runs.numbers import returns
from codetr_ros.runs.recovery import RecoveryError
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.runs.summary import Summary
from codetr_ros.runs.summary import write as write_summary


def complete(
    summary: Summary,
    path: Path,
    log: Callable[[str], None],
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Hand the records of a run's bag to its summary.

    The bag holds the first messages of a run, for which a watcher may have come too late, and true
    rewards and labels, to which it does not subscribe. Takes a second for each evaluation of a
    memory of a million steps.

    Args:
        summary: takes the records.
        path: the bag.
        log: prints a line for people.
        stopped: whether the user does not want to wait for the end.
    """
    from codetr_ros.bags.dropped import undropped_entries
    from codetr_ros.bags.errors import BagError, Damage
    from codetr_ros.bags.reader import Bag
    from codetr_ros.offline.score_course import score_course

    faults: dict[Damage, None] = {}
    try:
        bag = Bag(path, faults.setdefault)
        # labels last: they may have been recorded before the true rewards of their phase
        unlabelled = (EpisodeResult, Metrics, Commit, TrueRewards, CompositeReward)
        if summary.settings.scored_elsewhere:
            summary.scores_given = score_course(bag).rows(summary.settings.warmup_phases)
        # nobody knows the true rewards of a robot, with which labels are compared
        compared = () if summary.settings.on_robot else ((StepRewards,),)
        for kinds in (unlabelled, *compared):
            for entry in undropped_entries(bag, kinds):
                if stopped():
                    log('stopped: the summary holds what was read until now')
                    return
                record: Record = entry.record
                if record.run_id == summary.run_id:
                    summary.receive(record)
    except BagError as error:
        log(f'the summary holds what was received, and the bag up to a fault: {error}')
    except RecoveryError as error:
        log(f'reward recovery is incomplete: {error}')
    if faults:
        first = next(iter(faults))
        log(
            f'the summary holds what was received, and what can be read of the bag ({len(faults)} '
            f'faults, the first at {first.place}: {first.text})'
        )


def write(folder: Path, summary: Summary, built: RunSummary, draw: bool) -> None:
    """Write summary, metrics, pictures and report into a run's folder.

    Args:
        folder: the run's folder.
        summary: has the records of the run.
        built: the summary itself.
        draw: draw the robot too, if it can be drawn here; takes seconds.

    Raises:
        OSError: one of them cannot be written.
    """
    write_summary(folder, built, summary.metrics_csv(), summary.segments())
    report.write(folder, built, _film(folder, summary) if draw else '')


def _film(folder: Path, summary: Summary) -> str:
    module = launcher.module_environment(summary.settings)
    return film.make(folder, environment={**os.environ, **module})


def short(path: Path) -> str:
    """A path as people type it: relative to the current folder where it lies within."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def show(summary: RunSummary, folder: Path, console: Console) -> None:
    """Print the results of a run."""
    values = [row.true_return_mean for row in summary.evaluated()]
    known = [value for value in values if value is not None]
    if summary.evaluations and len(known) == len(values):
        curve = report.sketch(known, console.encoding)
        begins = 'random policy' if summary.random else f'{summary.evaluations[0].step} steps'
        begin, end = returns(known[0], known[-1])
        console.print(
            f'\ntrue return, {begins} to {summary.evaluations[-1].step} steps: '
            f'{begin} |{curve}| {end}',
            highlight=False,
            markup=False,
        )
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style='dim', no_wrap=True)
    table.add_column(overflow='fold')
    for name, text in report.result_rows(summary):
        table.add_row(name, text)
    for name, file in (
        ('report', run_folder.REPORT),
        ('picture', run_folder.PICTURE),
        ('film', run_folder.FILM),
        ('summary', run_folder.SUMMARY),
        ('metrics', run_folder.METRICS),
    ):
        if name != 'film' or (folder / file).is_file():
            table.add_row(name, short(folder / file))
    if summary.bag:
        table.add_row('bag', short(Path(summary.bag)))
    console.print()
    console.print(table)
    if summary.interrupted:
        console.print('\ninterrupted: what was done is kept', highlight=False)
