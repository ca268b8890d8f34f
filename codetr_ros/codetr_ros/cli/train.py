"""`codetr train`: start everything, show its progress, end with a summary and a report."""

import dataclasses
import os
import re
import secrets
import shlex
import time
import traceback
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from codetr_ros import config
from codetr_ros.cli import FAILED, INTERRUPTED, refuse
from codetr_ros.cli.flags import parse
from codetr_ros.config import Settings, SettingsError
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import LaunchError
from codetr_ros.processes.supervise import Interrupts, Silence, supervise, why_it_gave_up
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
from codetr_ros.runs import reports as node_reports
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.recovery import RecoveryError
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.runs.summary import Summary
from codetr_ros.runs.summary import write as write_summary
from codetr_ros.system.files import atomic_write

DESCRIPTION = """Train on a task.

Starts a simulator, an evaluator, the reward model, the learner and a recorder as ROS 2 nodes in a
namespace of their own, shows their progress, and ends with a summary, a report and a picture.
Ctrl-C ends all of it cleanly. Every setting is a flag; --config sets their defaults."""


@dataclasses.dataclass
class Outcome:
    """How a run ended."""

    reports: Mapping[str, NodeReport]
    interrupted: bool = False
    failure: str | None = None
    log: Path | None = None  # explains the failure


def main(arguments: Sequence[str], start: launcher.Start = launcher.start_program) -> int:
    """Train by the values of the command line; returns the exit code.

    Args:
        arguments: those of `codetr train`.
        start: starts the nodes.
    """
    from codetr_ros.cli import tryout
    from codetr_ros.simulation import tasks

    more = [
        (
            'out',
            Annotated[
                str | None,
                tyro.conf.arg(
                    metavar='DIR',
                    help='output folder, new or empty; by default '
                    'runs/<task>-<method>-<seed>-<time>',
                ),
            ],
            None,
        ),
        (
            'in_process',
            Annotated[
                bool,
                tyro.conf.arg(help='do the same run with plain calls, without nodes and topics'),
            ],
            False,
        ),
    ]
    try:
        settings, extra = parse(arguments, 'codetr train', DESCRIPTION, 'quick', more)
        in_process = extra['in_process']
        if settings.method in config.IN_PROCESS_ONLY and not in_process:
            return refuse(
                f'--method {settings.method} {config.IN_PROCESS_ONLY[settings.method]}: '
                'it runs in process only. Add --in-process, or choose another --method'
            )
        if in_process:
            # before torch is imported: the threads of the nodes, for the same results bit for bit
            os.environ.update(launcher.threading_environment(settings))
        tasks.check(settings, tasks.find(settings.task))
        if not in_process:
            for role in settings.roles:
                launcher.executable(role)
        stamp = time.strftime('%Y%m%d-%H%M%S')
        out = Path(extra['out'] or default_out(settings, stamp))
        run_folder.check(out)
        if in_process:
            tryout.here(settings)
        else:
            tryout.apart(settings, launcher.environment(settings))
        folder = run_folder.create(out)
    except (
        SettingsError,
        tasks.TaskError,
        tryout.TryoutError,
        RunFolderError,
        LaunchError,
    ) as error:
        return refuse(str(error))
    # A letter first: as a ROS parameter and in a namespace it must not read as a number.
    run_id = f'r{stamp.replace("-", "_")}_{secrets.token_hex(2)}'
    command = shlex.join(['codetr', 'train', *arguments])
    return train(settings, run_id, folder, in_process, start, command)


def default_out(settings: Settings, stamp: str) -> str:
    """The output folder that is used if none is given."""
    task = re.sub(r'[^A-Za-z0-9_.-]+', '_', settings.task)
    return f'runs/{task}-{settings.method}-{settings.seed}-{stamp}'


def train(
    settings: Settings,
    run_id: str,
    folder: Path,
    in_process: bool,
    start: launcher.Start = launcher.start_program,
    command: str | None = None,
) -> int:
    """Do a run and write everything about it into its folder.

    Args:
        settings: the run's settings.
        run_id: its name: letters, digits and `_`.
        folder: its folder, which exists.
        in_process: run without nodes.
        start: starts the nodes.
        command: the command line, for the summary.

    Returns:
        The exit code: 0 finished, 1 failed, 2 refused, 130 interrupted.
    """
    try:
        run_folder.write_settings(folder, settings)
    except OSError as error:
        return refuse(str(error))
    summary = Summary(settings, run_id, in_process, command=command)
    progress = Progress(settings)
    progress.log(
        f'{settings.task}: {settings.composite} of {settings.delay} steps, method '
        f'{settings.method}, {settings.steps} steps, seed {settings.seed}'
        + (', in process' if in_process else '')
    )
    progress.log(f'output: {_short(folder)}')
    with Interrupts() as interrupts:
        with progress:
            way = _in_process if in_process else partial(_over_topics, start)
            outcome = way(settings, run_id, folder, summary, progress, interrupts)
        bag = folder / run_folder.BAG
        built = summary.build(
            outcome.reports, bag if bag.is_dir() else None, outcome.interrupted, outcome.failure
        )
        try:
            write_summary(folder, built, summary.metrics_csv(), summary.segments())
            report.write(folder, built)
        except OSError as error:
            outcome.failure = '; '.join(filter(None, (outcome.failure, str(error))))
    show(built, folder, Console())
    if outcome.failure:
        show_failure(outcome)
    if outcome.interrupted:
        return INTERRUPTED
    return FAILED if outcome.failure else 0


def _in_process(
    settings: Settings,
    run_id: str,
    folder: Path,
    summary: Summary,
    progress: Progress,
    interrupts: Interrupts,
) -> Outcome:
    os.environ.update(launcher.threading_environment(settings))
    from codetr_ros.cores import in_process

    def observe(record: Record) -> None:
        summary.receive(record)
        progress.receive(record)

    def tick() -> None:
        if interrupts.count:
            raise KeyboardInterrupt

    # A slice may be long: a second Ctrl-C does not wait for its end.
    interrupts.raising = True
    try:
        return Outcome(in_process.run(settings, run_id, folder, observe, tick))
    except KeyboardInterrupt:
        progress.log('stopped')
        return Outcome(node_reports.read_all(folder), interrupted=True)
    except Exception as error:  # noqa: BLE001
        # The summary keeps what was learnt until now, and names the failure, whatever it is.
        log = folder / run_folder.LOGS / 'in_process.log'
        atomic_write(log, traceback.format_exc())
        reports = node_reports.read_all(folder)
        return Outcome(reports, failure=f'{type(error).__name__}: {error}', log=log)
    finally:
        interrupts.raising = False


def _over_topics(
    start: launcher.Start,
    settings: Settings,
    run_id: str,
    folder: Path,
    summary: Summary,
    progress: Progress,
    interrupts: Interrupts,
) -> Outcome:
    commands = launcher.commands(settings, run_id, folder)
    environment = launcher.environment(settings)
    # The watcher lives in this process and must look for the nodes where they are.
    os.environ.update(
        {name: v for name, v in environment.items() if name.startswith(('ROS_', 'RMW_'))}
    )
    try:
        from codetr_ros.ros.watch import Watcher
    except ImportError as error:
        return Outcome(
            {},
            failure=f'ROS cannot be imported ({error}): `codetr doctor` names what is missing; '
            '--in-process trains without ROS',
        )
    silence = Silence()

    def receive(record: Record) -> None:
        silence.receive(record)
        summary.receive(record)
        progress.receive(record)

    failure = None
    asked = interrupts.again
    with launcher.Processes(progress.log, asked, start_program=start) as processes:
        try:
            # The watcher comes first, so as to receive everything from the nodes' start on.
            with Watcher(receive, f'/run_{run_id}') as watcher:

                def poll() -> None:
                    watcher.poll(0.1)
                    progress.tick()

                processes.start(commands, folder / run_folder.LOGS, environment)
                failure = supervise(
                    processes,
                    poll,
                    interrupts,
                    silence,
                    lambda node: why_it_gave_up(node, folder),
                )
                watcher.poll(0.0)  # the last messages of the last node
        except LaunchError as error:
            failure = str(error)
    reports = node_reports.read_all(folder)
    for node in processes.nodes:
        key = run_folder.report_path(folder, node.role, node.name).stem
        known = reports.get(key) or NodeReport(role=node.role, name=node.name)
        reports[key] = known.model_copy(update={'exit_code': node.code})
    summary.end()
    interrupted = bool(interrupts.count)
    _complete(summary, folder, progress, interrupts)
    culprit = next((node.log for node in processes.nodes if node.unasked_failure), None)
    return Outcome(reports, interrupted, failure, culprit)


def _complete(summary: Summary, folder: Path, progress: Progress, interrupts: Interrupts) -> None:
    """Hand the records of the bag to the summary.

    The bag holds the first messages of a run, for which the watcher may have come too late, and
    true rewards and labels, to which it does not subscribe. Takes a second for each evaluation of
    a memory of a million steps; Ctrl-C ends it.
    """
    from codetr_ros.bags.errors import BagError
    from codetr_ros.bags.reader import Bag

    if not (folder / run_folder.BAG).exists():
        return  # no recorder started, and the failure names it
    asked = interrupts.count
    progress.log('reading the bag for the summary')
    try:
        bag = Bag(folder / run_folder.BAG)
        # labels last: they may have been recorded before the true rewards of their phase
        unlabelled = (EpisodeResult, Metrics, Commit, TrueRewards, CompositeReward)
        for kinds in unlabelled, (StepRewards,):
            for entry in bag.entries(kinds):
                if interrupts.count > asked:
                    progress.log('stopped: the summary holds what was read until now')
                    return
                summary.receive(entry.record)
    except BagError as error:
        progress.log(f'the summary holds what was received, and the bag up to a fault: {error}')
    except RecoveryError as error:
        progress.log(f'reward recovery is incomplete: {error}')


def _short(path: Path) -> str:
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
        console.print(
            f'\ntrue return, {begins} to {summary.evaluations[-1].step} steps: '
            f'{known[0]:.1f} |{curve}| {known[-1]:.1f}',
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
        ('summary', run_folder.SUMMARY),
        ('metrics', run_folder.METRICS),
    ):
        table.add_row(name, _short(folder / file))
    if summary.bag:
        table.add_row('bag', _short(Path(summary.bag)))
    console.print()
    console.print(table)
    if summary.interrupted:
        console.print('\ninterrupted: what was done is kept', highlight=False)


def show_failure(outcome: Outcome) -> None:
    """Print on stderr why the run failed, with the end of the log that explains it."""
    console = Console(stderr=True)
    console.print(
        f'\ncodetr: the run failed: {outcome.failure}',
        style='bold red',
        markup=False,
        soft_wrap=True,
    )
    if outcome.log is not None:
        console.print(
            f'the end of {_short(outcome.log)}:', markup=False, highlight=False, soft_wrap=True
        )
        text = launcher.end_of_log(outcome.log)
        console.print(text, markup=False, highlight=False, soft_wrap=True)
