"""The bags given to a command, and the runs that they hold."""

from collections.abc import Sequence
from pathlib import Path

from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings, from_canonical
from codetr_ros.offline.errors import FitError
from codetr_ros.records import RunSpec
from codetr_ros.runs import folder as run_folder


def open_bags(paths: Sequence[Path]) -> list[Bag]:
    """Open bags by their folder or file, or by the folder of the run that recorded them.

    Raises:
        BagError: there is none, or it cannot be read.
        FitError: one was given twice.
    """
    bags = []
    seen: dict[Path, Path] = {}
    for path in paths:
        bag = Bag(run_folder.bag_of(path))
        if (real := bag.path.resolve()) in seen:
            raise FitError(
                f'{path} is the same bag as {seen[real]}: its episodes would be learnt from and '
                'held out at the same time'
            )
        seen[real] = path
        bags.append(bag)
    return bags


def runs_of(bag: Bag) -> list[RunSpec]:
    """The runs of a bag, in its order."""
    runs: dict[str, RunSpec] = {}
    for entry in bag.entries((RunSpec,)):
        assert isinstance(entry.record, RunSpec)
        runs.setdefault(entry.record.run_id, entry.record)
    return list(runs.values())


def one_run(bag: Bag, run_id: str | None) -> RunSpec:
    """The run of a bag; if it holds several, the one with this id.

    Raises:
        FitError: there is none, or there are several and no id is given.
    """
    runs = runs_of(bag)
    names = ', '.join(run.run_id for run in runs)
    if not runs:
        raise FitError(
            f'{bag.path} holds no RunSpec, so the settings of its run are not known: '
            'fit it with --schedule epochs'
        )
    if run_id is None and len(runs) > 1:
        raise FitError(f'{bag.path} holds the runs {names}: choose one with --run')
    for run in runs:
        if run_id in (None, run.run_id):
            return run
    raise FitError(f'{bag.path} holds no run {run_id!r}; it holds {names}')


def settings_of(run: RunSpec, bag: Bag) -> Settings:
    """The settings of a run, from its bag.

    Raises:
        SettingsError: this version does not know one of them.
    """
    return from_canonical(run.settings, f'run {run.run_id!r} in {bag.path}')
