"""`codetr train`: start everything, show its progress, end with a summary and a report."""

import dataclasses
import os
import re
import secrets
import shlex
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from codetr_ros import config
from codetr_ros.cli import (
    FAILED,
    INTERRUPTED,
    beside,
    refuse,
    results,
    resume,
    train_in_process,
    train_over_topics,
)
from codetr_ros.cli.audience import Audience
from codetr_ros.cli.flags import parse
from codetr_ros.cli.joiners import how_to_join
from codetr_ros.cli.outcome import Outcome
from codetr_ros.cli.terminal import console
from codetr_ros.cli.train_flags import FLAGS, wrong
from codetr_ros.cli.train_over_topics import Topics
from codetr_ros.config import Settings, SettingsError
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import LaunchError
from codetr_ros.processes.openmp import crowded, threading_environment
from codetr_ros.processes.restarts import Restarts
from codetr_ros.processes.supervise import Interrupts
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import origin
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.live import Live
from codetr_ros.runs.middle import Middle
from codetr_ros.runs.origin import Origin, held
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.report_text import evaluations_missing
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.runs.summary import Summary
from codetr_ros.runs.tensorboard import Events

DESCRIPTION = """Train on a task.

Starts a simulator, an evaluator, the reward model, the learner and a recorder as ROS 2 nodes in a
namespace of their own, shows their progress, and ends with a summary, a report and a picture.
Ctrl-C ends all of it cleanly. Every setting is a flag; --config sets their defaults."""


@dataclasses.dataclass(frozen=True)
class Shown:
    """What people see of a run, beside its progress and its report.

    Attributes:
        film: the robot in the report, if it can be drawn here.
        tensorboard: events for TensorBoard.
        offered: pages and services beside it.
    """

    film: bool = False
    tensorboard: bool = False
    offered: beside.Offered = dataclasses.field(default_factory=beside.Offered)


def main(arguments: Sequence[str], start: launcher.Start = launcher.start_program) -> int:
    """Train by the values of the command line; returns the exit code.

    Args:
        arguments: those of `codetr train`.
        start: starts the nodes.
    """
    from codetr_ros.cli import tryout
    from codetr_ros.simulation import tasks

    try:
        given = resume.with_settings(arguments)
        settings, extra = parse(given, 'codetr train', DESCRIPTION, 'quick', FLAGS)
        folder: Path | None = extra['resume']
        begun = None if folder is None else resume.check(folder, settings, extra)
        in_process = extra['in_process'] if begun is None else begun.in_process
        if reason := _does_not_fit(settings, extra, in_process):
            return refuse(reason)
        if in_process:
            # before torch is imported: the threads of the nodes, for the same results bit for bit
            os.environ.update(threading_environment(settings))
        tasks.check(settings, tasks.find(settings.task))
        if not in_process:
            for role in settings.roles:
                launcher.executable(role)
        if begun is None and (reason := wrong(extra)):
            return refuse(reason)
        stamp = time.strftime('%Y%m%d-%H%M%S')
        out = Path(extra['out'] or default_out(settings, stamp))
        if extra['out']:
            run_folder.check(out)
        if in_process:
            tryout.here(settings)
        else:
            train_over_topics.watcher(settings)
            tryout.apart(settings, launcher.environment(settings))
        if folder is None:
            folder = run_folder.create(out) if extra['out'] else run_folder.create_next(out)
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
    namespace = extra['namespace']
    if begun is not None:
        run_id, namespace = begun.run_id, begun.namespace
    topics = None if in_process else _topics(extra, namespace, start)
    command = shlex.join(['codetr', 'train', *arguments])
    offered = beside.Offered(
        watch=extra['watch'],
        service=extra['score_service'],
        camera=extra['camera'],
        open=extra['open'],
    )
    shown = Shown(extra['film'], extra['tensorboard'], offered)
    try:
        with held(folder, launcher.STOP_DEADLINE if begun else 0.0) as lock:
            if topics is not None and topics.start is launcher.start_program:
                # nodes hold the folder too: if this process is killed, they need a while to end
                holding = partial(launcher.start_program, keep_open=(lock,))
                topics = dataclasses.replace(topics, start=holding)
            return train(settings, run_id, folder, topics, command, shown, extra['bag'], begun)
    except RunFolderError as error:
        return refuse(str(error))


def _does_not_fit(settings: Settings, extra: Mapping[str, Any], in_process: bool) -> str | None:
    """Why flags and settings do not fit each other; None: they do."""
    if settings.method in config.IN_PROCESS_ONLY and not in_process:
        return (
            f'--method {settings.method} {config.IN_PROCESS_ONLY[settings.method]}: '
            'it runs in process only. Add --in-process, or choose another --method'
        )
    if in_process and settings.scorer in ('person', 'topic'):
        return (
            f'--scorer {settings.scorer} with --in-process: scores come over topics, which it '
            'does without; leave out --in-process, or take --scorer simulated'
        )
    if extra['score_service'] and not settings.scored_elsewhere:
        return (
            f'--score-service with --scorer {settings.scorer}: nobody else can score; add '
            '--scorer topic'
        )
    if extra['camera'] and settings.scorer != 'person':
        return (
            f'--camera with --scorer {settings.scorer}: no page to score is served; add '
            '--scorer person'
        )
    if settings.joiners and in_process:
        return (
            f'--joiners {" ".join(settings.joiners)} with --in-process: nobody joins a run '
            'without nodes; leave out one of them'
        )
    if extra['score_service'] and in_process:
        return '--score-service with --in-process: services need nodes; leave out one of them'
    return None


def _topics(extra: Mapping[str, Any], namespace: str | None, start: launcher.Start) -> Topics:
    restarts = Restarts(extra['restarts'], extra['restarts_within'])
    return Topics(
        namespace, extra['peer_deadline'], extra['leave_out_after'], start, restarts=restarts
    )


def default_out(settings: Settings, stamp: str) -> str:
    """The output folder that is used if none is given and none is there yet."""
    task = re.sub(r'[^A-Za-z0-9_.-]+', '_', settings.task)
    return f'runs/{task}-{settings.method}-{settings.seed}-{stamp}'


def train(
    settings: Settings,
    run_id: str,
    folder: Path,
    topics: Topics | None = None,
    command: str | None = None,
    shown: Shown = Shown(),
    bag: bool = True,
    begun: Origin | None = None,
) -> int:
    """Do a run, or go on with one, and write everything about it into its folder.

    Args:
        settings: the run's settings.
        run_id: its name: letters, digits and `_`.
        folder: its folder, which exists.
        topics: how the nodes are started; None: run in process, without any.
        command: the command line, for the summary.
        shown: what people see of it.
        bag: record it, if it runs in process.
        begun: how the run began that is gone on with; None: it begins now.

    Returns:
        The exit code: 0 finished, 1 failed, 2 refused, 130 interrupted.
    """
    settings = config.settled(settings)
    in_process = topics is None
    namespace = None if topics is None else topics.namespace or launcher.namespace_of(run_id)
    recorded = bag or not in_process
    try:
        if begun is not None:
            notes = [] if in_process else resume.prepare(settings, run_id, folder)
            notes += resume.begin(folder, begun, settings)
            run_folder.forget_reports(folder)
        else:
            where = namespace or launcher.namespace_of(run_id)
            made = origin.origin(settings, run_id, where, in_process, recorded, command)
            notes = []
            _begin(folder, settings, made)
    except (OSError, RunFolderError) as error:
        return refuse(str(error))
    recorded_before = True if begun is not None else None
    summary = Summary(settings, run_id, in_process, command=command, recorded=recorded_before)
    progress = Progress(settings)
    live = Live(folder, summary, progress, namespace, recorded=recorded)
    how = ', in process' * in_process + ', gone on with' * (begun is not None)
    _introduce(progress, settings, how, folder, notes)
    if namespace is not None:
        progress.log(f'namespace: {namespace}')
        for line in how_to_join(settings, namespace):
            progress.log(line)
    events = None
    if shown.tensorboard:
        events = Events(folder / run_folder.TENSORBOARD, settings, progress.log)
    key = {} if topics is None else topics.key
    pages = beside.pages(folder, settings, progress.log, shown.offered, namespace, key)
    middle = Middle(folder, settings, progress.log) if shown.film else None
    audience = Audience(summary, progress, live, events, pages, middle)
    with Interrupts() as interrupts, ExitStack() as open_pages:
        for page in pages:
            open_pages.enter_context(page)
        with progress:
            way = (
                partial(train_in_process.run, bag=bag, resumed=begun is not None)
                if topics is None
                else partial(train_over_topics.run, topics=topics)
            )
            outcome = way(settings, run_id, folder, audience, interrupts)
        if outcome.refused:
            return refuse(outcome.refused)
        built = _write_results(folder, outcome, audience, shown.film)
    results.show(built, folder, console(tables=True))
    if outcome.failure:
        show_failure(outcome)
    if outcome.interrupted:
        return INTERRUPTED
    return FAILED if outcome.failure else 0


def _begin(folder: Path, settings: Settings, made: Origin) -> None:
    """Write into a folder what a run goes on from, if it does not end.

    Raises:
        OSError: it cannot be written.
    """
    run_folder.begin_anew(folder)
    origin.write(folder, made)
    run_folder.write_settings(folder, settings)  # the last: from now on it can go on


def _introduce(
    progress: Progress, settings: Settings, how: str, folder: Path, notes: Sequence[str]
) -> None:
    """Log what begins, where it goes, and what people should know before."""
    progress.log(
        f'{settings.task}: {settings.composite} of {config.delay_in_words(settings.delay)}, '
        f'method {settings.method}, {settings.steps} steps, seed {settings.seed}{how}'
    )
    progress.log(f'output: {results.short(folder)}')
    for note in notes:
        progress.log(note)
    if reason := crowded(settings.thread_count, os.getloadavg()[0]):
        progress.log(reason)


def _write_results(folder: Path, outcome: Outcome, audience: Audience, film: bool) -> RunSummary:
    """Write the summary and the report of a run that has ended; what fails then is its failure."""
    summary, progress, live = audience.summary, audience.progress, audience.live
    live.end('ending')
    place = folder / run_folder.BAG
    built = summary.build(
        outcome.reports, place if place.is_dir() else None, outcome.interrupted, outcome.failure
    )
    if built.evaluations_missing and not outcome.interrupted:
        progress.log(f'warning: {evaluations_missing(built)}')
    try:
        audience.end()
        draw = film and not outcome.interrupted and not outcome.failure
        if draw:
            progress.log('drawing the robot for the report')
        results.write(folder, summary, built, draw)
    except OSError as error:
        outcome.failure = '; '.join(filter(None, (outcome.failure, str(error))))
    live.end(outcome.state, outcome.failure)
    return built


def show_failure(outcome: Outcome) -> None:
    """Print on stderr why the run failed, with the end of the log that explains it."""
    shown = console(stderr=True)
    shown.print(
        f'\ncodetr: the run failed: {outcome.failure}',
        style='bold red',
    )
    if outcome.log is not None:
        shown.print(
            f'the end of {results.short(outcome.log)}:',
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
        text = launcher.end_of_log(outcome.log)
        shown.print(text)
