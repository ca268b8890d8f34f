"""`codetr fit`: fit a reward model to bags, without any node."""

import dataclasses
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from codetr_ros import config
from codetr_ros.bags.errors import BagError
from codetr_ros.cli import FAILED, refuse
from codetr_ros.cli.flags import HELP_ALL_FIELD, explained, settings_fields
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import Settings, SettingsError
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.settings import OF_NO_EFFECT, FitSettings
from codetr_ros.processes.openmp import waiting_environment
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.numbers import exact

if TYPE_CHECKING:
    from codetr_ros.offline.episodes import Index
    from codetr_ros.offline.fitting import Check

DESCRIPTION = """Fit a reward model to bags, without any node and without ROS.

The bags hold Transitions and CompositeReward messages: those of `codetr train`, or anybody's.
Settings that are not given are those of the first bag's run, where the bag holds them, else of the
preset `quick`. The command writes a checkpoint that a reward node can start from, a summary and a
report into the folder DIR."""


def _own_fields() -> list[tuple[str, Any, Any]]:
    def field(name: str, kind: Any, default: Any, metavar: str, text: str) -> tuple[str, Any, Any]:
        return name, Annotated[kind, tyro.conf.arg(metavar=metavar, help=text)], default

    bags = Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar='BAG...', help='bags, or folders of runs'),
    ]
    return [
        ('bags', bags, dataclasses.field()),
        field('out', str, dataclasses.field(), 'DIR', 'output folder, new or empty'),
        HELP_ALL_FIELD,
        field(
            'config',
            str | None,
            None,
            'NAME|FILE',
            f'{", ".join(config.PRESETS)} or a YAML file: the defaults of the settings below',
        ),
        field('run', str | None, None, 'ID', 'use this run only, where bags hold several'),
        field(
            'checkpoint',
            str,
            '',
            'PATH',
            'go on from this model: folder of a fit, of a run or of a checkpoint; with --schedule '
            'phases, the model that the run started from',
        ),
        (
            'frozen',
            Annotated[
                bool,
                tyro.conf.arg(help='the checkpoint only labelled in the run (--schedule phases)'),
            ],
            False,
        ),
    ]


@dataclasses.dataclass(frozen=True)
class Arguments:
    """The values of the command line."""

    bags: tuple[Path, ...]
    out: Path
    config: str | None
    run: str | None
    checkpoint: str
    frozen: bool
    fit: FitSettings
    settings: Settings


def parse(arguments: Sequence[str], base: Settings) -> Arguments:
    """Parse the command line with the settings of `base` as defaults.

    Raises:
        SettingsError: a value is out of range.
        SystemExit: after `--help` or `--help-all`, or for a flag that does not exist.
    """
    own, fit = _own_fields(), settings_fields(FitSettings())
    words, shown, text = explained(arguments, base, DESCRIPTION, OF_NO_EFFECT)
    kind = dataclasses.make_dataclass('Arguments', [*own, *fit, *shown], frozen=True)
    kind.__doc__ = text
    values = dataclasses.asdict(
        parse_arguments(kind, prog='codetr fit', description=text, arguments=words)
    )
    mine = {field[0]: values.pop(field[0]) for field in own}
    fitting = {field[0]: values.pop(field[0]) for field in fit}
    return Arguments(
        tuple(map(Path, mine['bags'])),
        Path(mine['out']),
        mine['config'],
        mine['run'],
        mine['checkpoint'],
        mine['frozen'],
        config.validate(FitSettings, fitting, 'command line'),
        config.settled(config.parse(base.model_dump() | values, 'command line')),
    )


def main(arguments: Sequence[str]) -> int:
    """Fit by the values of the command line; returns the exit code."""
    try:
        given = parse(arguments, config.load('quick'))
        run_folder.check(given.out)
    except (SettingsError, RunFolderError) as error:
        return refuse(str(error))
    os.environ.update(waiting_environment())
    from codetr_ros.rewards.base import RewardModelError
    from codetr_ros.runs.checkpoints import CheckpointError
    from codetr_ros.system.devices import DeviceError

    try:
        return (_phases if given.fit.schedule == 'phases' else _epochs)(arguments, given)
    except (SettingsError, RunFolderError, FitError, BagError, CheckpointError) as error:
        return refuse(str(error))
    except (RewardModelError, DeviceError) as error:
        print(f'codetr: {error}', file=sys.stderr)
        return FAILED


def _epochs(arguments: Sequence[str], given: Arguments) -> int:
    from codetr_ros.offline import fitting, judging, report, results
    from codetr_ros.offline.cutting import stretches
    from codetr_ros.rewards import saved
    from codetr_ros.runs import checkpoints

    if given.frozen:
        raise FitError('--frozen: a frozen model is not fitted; it is for --schedule phases')
    start = saved.read(Path(given.checkpoint)) if given.checkpoint else None
    index, shown = _index(given)
    base = start.settings if start else index.base()
    base = config.load(given.config) if given.config else base
    given = parse(arguments, base.changed(index.facts()))
    settings = given.settings
    _refuse_unfit(settings)
    longest = min(given.fit.stretch_steps, max(1, settings.memory_steps // 4))
    data = stretches(index, settings.longest, longest)
    plan = fitting.plan(data.usable, settings, given.fit)
    sizes = index.observation_size, index.action_size
    method = saved.restore(start, settings, *sizes) if start else None
    folder = results.make_folder(given.out)
    run_folder.write_settings(folder, settings)
    shown.print(
        f'method {settings.method}, {config.delay_in_words(settings.delay)}: '
        f'{len(plan.learnt)} stretches to learn from in {plan.passes} '
        f'{"part" if plan.passes == 1 else "parts"}, '
        f'{len(plan.held_out)} held out'
    )
    fitted = fitting.fit(
        index.bags,
        plan,
        sizes,
        settings,
        given.fit,
        lambda check: shown.print(_line(check, given.fit)),
        method,
    )
    meta = {
        'run_id': '',
        'settings': settings.canonical(),
        'task': settings.task,
        'observation_size': sizes[0],
        'action_size': sizes[1],
        'phase': 0,
    }
    checkpoints.save(folder / run_folder.CHECKPOINTS, 'reward', 0, fitted.method.state(), meta)
    judged = judging.judge(fitted.method, fitted.held_out)
    summary = results.of_epochs(fitted, index, data, settings, given.fit, judged)
    results.write(folder, summary)
    report.write(folder, summary, judged)
    results.show(summary, folder, shown)
    return 0


def _line(check: 'Check', fit: FitSettings) -> str:
    loss = '' if check.loss is None else f'loss {exact(check.loss, 4)}, '
    return (
        f'step {check.gradient_steps} of at most {fit.gradient_steps}: {loss}'
        f'held-out loss {exact(check.held_out_loss, 4)}'
    )


def _index(given: Arguments) -> 'tuple[Index, Console]':
    """Open the bags and read them once."""
    from codetr_ros.offline.episodes import Index
    from codetr_ros.offline.sources import open_bags

    shown = console()
    index = Index(open_bags(given.bags), given.run).read()
    shown.print(
        f'{len(index.bags)} {"bag" if len(index.bags) == 1 else "bags"}: {index.steps} steps, '
        f'{index.scores} scores, {len(index.episodes)} episodes'
        + (f', {index.unscored} segments without a score' * bool(index.unscored))
    )
    return index, shown


def _refuse_unfit(settings: Settings) -> None:
    from codetr_ros.rewards.registry import METHODS, check_device

    fit = [name for name in METHODS if name not in config.IN_PROCESS_ONLY]
    if settings.method not in fit:
        why = config.IN_PROCESS_ONLY.get(
            settings.method, 'has no reward model: its policy learner learns from the scores'
        )
        raise FitError(f'--method {settings.method} {why}. Choose one of --method {"|".join(fit)}')
    check_device(settings)


def _phases(arguments: Sequence[str], given: Arguments) -> int:
    from codetr_ros.offline import judging, loading, phases, report, results, sources
    from codetr_ros.offline.cutting import stretches

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
    (bag,) = sources.open_bags(given.bags)
    run = sources.one_run(bag, given.run)
    own = sources.settings_of(run, bag)
    given = parse([*arguments, '--run', run.run_id], own)
    _refuse_unfit(given.settings)
    live = results.live_digest(bag)
    folder = results.make_folder(given.out)
    run_folder.write_settings(folder, given.settings)
    index, shown = _index(given)
    shown.print(
        f'run {run.run_id}: {own.task}, method {given.settings.method}, {own.phases} phases'
    )
    began = time.perf_counter()
    folded = phases.fold(
        bag,
        run,
        given.settings,
        folder / run_folder.CHECKPOINTS,
        lambda text: shown.print(text, style='yellow', markup=False),
        lambda phase, of: shown.print(f'phase {phase} of {of}'),
        given.checkpoint,
        given.frozen,
    )
    seconds = time.perf_counter() - began
    longest = index.within(own).longest
    data = stretches(index, longest, given.fit.stretch_steps)
    judged = None
    if folded.core.method is not None and folded.core.method.target_scale:
        newest = list(loading.newest(data.usable, given.settings.memory_steps))
        sizes = index.observation_size, index.action_size
        loaded = loading.load(index.bags, newest, sizes, longest, true_rewards=True)
        judged = judging.judge(folded.core.method, loaded)
    summary = results.of_phases(folded, index, data, own, given.fit, judged, seconds, live)
    results.write(folder, summary)
    report.write(folder, summary, judged)
    results.show(summary, folder, shown)
    return 0
