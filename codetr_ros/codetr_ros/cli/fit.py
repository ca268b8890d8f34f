"""`codetr fit`: a reward model from bags, without any node."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from codetr_ros import config, run_folder
from codetr_ros.bags.errors import BagError
from codetr_ros.cli import refuse
from codetr_ros.cli.flags import settings_fields
from codetr_ros.config import Settings, SettingsError
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.settings import FitSettings
from codetr_ros.run_folder import RunFolderError

DESCRIPTION = """Fit a reward model to bags, without any node and without ROS.

The bags hold Transitions and CompositeReward messages: those of `codetr train`, or anybody's.
Settings that are not given are those of the first bag's run, where it says what they are, else of
the preset `quick`. The folder DIR then has a checkpoint that a reward node starts from, a summary
and a report."""

OF_NO_EFFECT = frozenset(
    [
        *('task', 'composite', 'beta', 'steps', 'phase_steps', 'warmup_steps', 'overlap'),
        *('simulators', 'evaluate_every', 'evaluate_episodes', 'r_max', 'record_relabels'),
        'sac',
    ]
)
"""Settings about simulating and about learning a policy: facts of the data, or of no interest."""


def _own_fields() -> list[tuple[str, Any, Any]]:
    def field(name: str, kind: Any, default: Any, metavar: str, said: str) -> tuple[str, Any, Any]:
        return name, Annotated[kind, tyro.conf.arg(metavar=metavar, help=said)], default

    bags = Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar='BAG...', help='bags, or folders of runs'),
    ]
    return [
        ('bags', bags, dataclasses.field()),
        field('out', str, dataclasses.field(), 'DIR', 'output folder, new or empty'),
        field(
            'config',
            str | None,
            None,
            'NAME|FILE',
            f'{", ".join(config.PRESETS)} or a YAML file: the defaults of the settings below',
        ),
        field('run', str | None, None, 'ID', 'use this run only, where bags hold several'),
    ]


@dataclasses.dataclass(frozen=True)
class Arguments:
    """What the command line says."""

    bags: tuple[Path, ...]
    out: Path
    config: str | None
    run: str | None
    fit: FitSettings
    settings: Settings


def parse(arguments: Sequence[str], base: Settings) -> Arguments:
    """Parse the command line with the settings of `base` as defaults.

    Raises:
        SettingsError: a value is out of range.
        SystemExit: after `--help`, or for a flag that does not exist.
    """
    own, fit = _own_fields(), settings_fields(FitSettings())
    shown = [field for field in settings_fields(base) if field[0] not in OF_NO_EFFECT]
    kind = dataclasses.make_dataclass('Arguments', [*own, *fit, *shown], frozen=True)
    kind.__doc__ = DESCRIPTION
    values = dataclasses.asdict(
        tyro.cli(kind, prog='codetr fit', description=DESCRIPTION, args=arguments)
    )
    mine = {field[0]: values.pop(field[0]) for field in own}
    fitting = {field[0]: values.pop(field[0]) for field in fit}
    return Arguments(
        tuple(map(Path, mine['bags'])),
        Path(mine['out']),
        mine['config'],
        mine['run'],
        config.validate(FitSettings, fitting, 'command line'),
        config.parse(base.model_dump() | values, 'command line'),
    )


def main(arguments: Sequence[str]) -> int:
    """Fit as the command line says; the exit code."""
    try:
        given = parse(arguments, config.load('quick'))
        run_folder.check(given.out)
        if given.fit.schedule == 'phases':
            return _phases(arguments, given)
        raise FitError('not yet')
    except (SettingsError, RunFolderError, FitError, BagError) as error:
        return refuse(str(error))


def _phases(arguments: Sequence[str], given: Arguments) -> int:
    from codetr_ros.offline import phases, results, sources

    if len(given.bags) != 1:
        raise FitError(
            f'--schedule phases learns as one run did, from its bag; {len(given.bags)} bags were '
            f'given: {", ".join(map(str, given.bags))}'
        )
    if given.config:
        raise FitError(
            f"--config {given.config}: --schedule phases learns under the run's own settings, "
            'which the bag holds; single settings may be changed by flags'
        )
    bag = sources.open_bag(given.bags[0])
    run = sources.one_run(bag, given.run)
    own = sources.settings_of(run, bag)
    given = parse(arguments, own)
    folder = results.make_folder(given.out)
    run_folder.write_settings(folder, given.settings)
    console = Console(highlight=False)
    console.print(
        f'run {run.run_id}: {own.task}, method {given.settings.method}, {own.phases} phases',
        soft_wrap=True,
    )
    began = time.perf_counter()
    found = phases.fold(
        bag,
        run,
        given.settings,
        folder / run_folder.CHECKPOINTS,
        lambda text: console.print(text, style='yellow', markup=False),
        lambda phase, of: console.print(f'phase {phase} of {of}'),
    )
    summary = results.of_phases(found, bag, own, time.perf_counter() - began)
    results.write(folder, summary)
    results.show(summary, folder, console)
    return 0
