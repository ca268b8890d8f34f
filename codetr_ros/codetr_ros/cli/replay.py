"""`codetr replay`: derive a run's weights again from its bag, and compare them."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.playback import PlayError, recorded_run
from codetr_ros.bags.reader import Bag
from codetr_ros.cli import FAILED, refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.processes.openmp import threading_environment
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import origin, run_summary
from codetr_ros.runs import reports as node_reports
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.reports import StartedFrom
from codetr_ros.system.processors import model
from codetr_ros.system.versions import versions

if TYPE_CHECKING:
    from codetr_ros.offline.replay import Replayed


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Derive the weights of a recorded run again from its bag, phase by phase, and print them.

    With --verify compare them with what the run left: labels and policies in its bag, its
    checkpoints, the digests in its summary. Exit code 0: all is the same, 1: something differs, 2:
    there is no run to derive.
    """

    run: Annotated[
        Path,
        tyro.conf.Positional,
        tyro.conf.arg(metavar='RUN', help='the folder of a run, or a bag'),
    ]
    verify: Annotated[
        bool, tyro.conf.arg(help='compare, and name the first phase that differs')
    ] = False
    run_id: Annotated[
        str | None, tyro.conf.arg(metavar='ID', help='which run, where the bag holds several')
    ] = None


def main(arguments: Sequence[str]) -> int:
    """Derive, compare and print; returns the exit code."""
    given = parse_arguments(
        Arguments,
        prog='codetr replay',
        arguments=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    shown = console()
    try:
        bag = Bag(run_folder.bag_of(given.run))
        # torch reads the number of threads once, when it is imported
        os.environ.update(threading_environment(recorded_run(bag, given.run_id).settings))
        from codetr_ros.offline.errors import FitError
        from codetr_ros.offline.replay import replay
        from codetr_ros.runs.checkpoints import CheckpointError
    except (BagError, PlayError) as error:
        return refuse(str(error))
    try:
        where(given.run, shown)
        start, places = _started_from(given.run), given.run / run_folder.CHECKPOINTS
        folder = places if given.verify and places.is_dir() else None
        replayed = replay(bag, folder, given.run_id, start, Progress(shown))
        if given.verify:
            _compare_summary(given.run, replayed)
    except (BagError, PlayError, FitError, CheckpointError, RunFolderError) as error:
        return refuse(str(error))
    return show(replayed, given.verify, shown)


class Progress:
    """Prints how far it is, ten times."""

    def __init__(self, shown: Console) -> None:
        self._shown = shown
        self._said = 0

    def __call__(self, phase: int, phases: int) -> None:
        """Note that so many phases are done."""
        if phase * 10 // phases > self._said:
            self._said = phase * 10 // phases
            self._shown.print(f'phase {phase} of {phases}', style='dim')


def where(run: Path, shown: Console) -> None:
    """Print on which machine, versions and threads a run was made, and what differs here."""
    try:
        made = origin.read(run)
    except RunFolderError:
        path = run / run_folder.SUMMARY
        if not path.is_file():
            shown.print('where the run was made is not known: it has no run.json')
            return
        summary = run_summary.read(path)
        threads = summary.settings.get('threads', 'unknown')
        shown.print(f'made on {summary.host}, {threads} threads, {_in_words(summary.versions)}')
        return
    shown.print(f'made on {made.where()}')
    settings = run_folder.read_settings(run)
    if other := origin.differences(made, settings):
        shown.print(f'other there: {"; ".join(other)}: last bits may differ', style='yellow')
    else:
        shown.print(f'here: the same processor ({model()}), threads and versions', style='dim')


def _in_words(known: Mapping[str, str | None]) -> str:
    here = versions()
    return ', '.join(
        f'{name} {version}' + ('' if here.get(name) == version else f' (here {here.get(name)})')
        for name, version in known.items()
        if version
    )


def _started_from(run: Path) -> StartedFrom | None:
    """The reward model that a run started from, by its node's report."""
    if not (run / run_folder.NODES).is_dir():
        return None
    known = [report.started_from for report in node_reports.read_all(run).values()]
    return next((start for start in known if start is not None), None)


def _compare_summary(run: Path, replayed: 'Replayed') -> None:
    """Compare the digests of the last weights, if the run's summary is of all its phases."""
    path = run / run_folder.SUMMARY
    if not path.is_file():
        return
    summary = run_summary.read(path)
    if summary.phases != replayed.phases or summary.interrupted or summary.failure:
        return
    for side, name in (('learner', 'policy_sha256'), ('reward', 'reward_model_sha256')):
        was = getattr(summary, name)
        if was is not None and side in replayed.reports:
            made = getattr(replayed.reports[side], name)
            replayed.compare(replayed.phases - 1, name, str(made), was)


def show(replayed: 'Replayed', verify: bool, shown: Console) -> int:
    """Print what came out; the exit code."""
    run = replayed.recorded
    learner, reward = replayed.reports['learner'], replayed.reports.get('reward')
    shown.print(f'run {run.run.run_id!r}: {replayed.phases} of {run.settings.phases} phases')
    shown.print(f'policy_sha256        {learner.policy_sha256}')
    if reward is not None:
        shown.print(f'reward_model_sha256  {reward.reward_model_sha256}')
    if not verify:
        return 0
    compared = ', '.join(f'{count} {kind}' for kind, count in sorted(replayed.same.items()))
    shown.print(f'the same: {compared or "nothing"}')
    if replayed.first is None:
        if not replayed.same:
            return refuse('nothing was compared: the run left neither labels nor policies')
        shown.print('every phase leads to the same', style='green')
        return 0
    shown.print(f'phase {replayed.first.phase} is the first that differs', style='bold red')
    for one in sorted(replayed.differences.values(), key=lambda d: d.phase):
        shown.print(str(one), style='red')
    return FAILED
