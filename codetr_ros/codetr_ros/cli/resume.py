"""`codetr train --resume`: which run is gone on with, and whether it can be."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from codetr_ros import config
from codetr_ros.config import Settings, SettingsError
from codetr_ros.runs import facts, origin
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.runs.origin import Origin
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.system.versions import version_of

FLAG = '--resume'
MAY_CHANGE = ('steps',)
"""Settings that may be others when a run goes on."""
OF_NEW_RUNS = {'out': None, 'namespace': None, 'in_process': False, 'bag': True}
"""Flags that decide how a run begins, each with its default: a run goes on as it began."""


def with_settings(arguments: Sequence[str]) -> list[str]:
    """The arguments of `codetr train`, with the settings of the run that is gone on with as their
    defaults, if there is one.

    Raises:
        RunFolderError: `--resume` names no folder of a run, or comes with `--config`.
    """
    folder = None
    for i, argument in enumerate(arguments):
        if argument == FLAG:
            folder = arguments[i + 1] if i + 1 < len(arguments) else ''
        elif argument.startswith(f'{FLAG}='):
            folder = argument.removeprefix(f'{FLAG}=')
    if folder is None:
        return list(arguments)
    if not folder:
        raise RunFolderError(f'{FLAG} needs the folder of a run')
    if any(argument.partition('=')[0] == '--config' for argument in arguments):
        raise RunFolderError(
            f'{FLAG} {folder} goes on with the settings of the run: leave out --config'
        )
    _settings_of(Path(folder))
    return [*arguments, '--config', str(Path(folder) / run_folder.CONFIG)]


def _settings_of(folder: Path) -> Settings:
    """The settings of a run.

    Raises:
        RunFolderError: it is no folder of a run, or its settings are refused.
    """
    if run_folder.has_only_begun(folder):
        raise RunFolderError(
            f'the run in {folder} was ended before it had begun: there is no {run_folder.CONFIG} '
            f'yet, and nothing is lost. Start it again, with --out {folder}'
        )
    if not (folder / run_folder.CONFIG).is_file() and (folder / run_folder.BAG).is_dir():
        raise RunFolderError(
            f'the run in {folder} has a {run_folder.BAG} and no {run_folder.CONFIG}: restore that '
            'from a copy, or start the run again in another folder'
        )
    try:
        return run_folder.read_settings(folder)
    except SettingsError as error:
        raise RunFolderError(
            f'{error}. A run goes on with the settings that it began with: restore '
            f'{run_folder.CONFIG} from a copy, or start the run again'
        ) from error


def check(folder: Path, settings: Settings, extra: Mapping[str, Any]) -> Origin:
    """Check that a run can be gone on with under these settings.

    Args:
        folder: of the run.
        settings: by the command line.
        extra: the flags that are no settings.

    Returns:
        How the run was begun.

    Raises:
        RunFolderError: it cannot: names the reason and the remedy.
    """
    before = _settings_of(folder)
    made = origin.read(folder)
    for name, default in OF_NEW_RUNS.items():
        if extra[name] != default:
            flag = name.replace('_', '-')
            raise RunFolderError(
                f'{FLAG} goes on with a run as it began: leave out --{flag}'.replace(
                    '--bag', '--no-bag'
                )
            )
    if not made.recorded:
        raise RunFolderError(
            f'the run in {folder} was made with --no-bag: without a bag there is nothing to go on '
            'from. Start it again'
        )
    mine = version_of('codetr_ros')
    if made.versions.get('codetr_ros') != mine:
        raise RunFolderError(
            f'the run in {folder} was begun with codetr_ros {made.versions.get("codetr_ros")}, '
            f'this is {mine}: go on with the version that began it, or start the run again'
        )
    _check_settings(folder, before, settings)
    if _finished(folder, settings):
        raise RunFolderError(
            f'the run in {folder} has finished its {before.steps} steps: give more, with '
            f'{FLAG} {folder} --steps N'
        )
    return made


def _check_settings(folder: Path, before: Settings, settings: Settings) -> None:
    ours, theirs = settings.flat(), before.flat()
    changed = [name for name in ours if ours[name] != theirs[name] and name not in MAY_CHANGE]
    if changed:
        shown = ', '.join(f'{name} = {theirs[name]!r} (now {ours[name]!r})' for name in changed)
        raise RunFolderError(
            f'the run in {folder} has {shown}: a run goes on with the settings that it began '
            f'with, only {", ".join(MAY_CHANGE)} may change. Leave them out, or start a new run'
        )
    if settings.steps < before.steps:
        raise RunFolderError(
            f'--steps {settings.steps}: the run in {folder} has {before.steps}, and can only get '
            'longer'
        )


def _finished(folder: Path, settings: Settings) -> bool:
    summary, _ = _summary(folder)
    if summary is None:
        return False
    over = not summary.interrupted and summary.failure is None
    return over and summary.steps >= settings.steps


def _summary(folder: Path) -> tuple[RunSummary | None, str]:
    """The summary of a run, or why it cannot be read, in words; neither where there is none."""
    path = folder / run_folder.SUMMARY
    if not path.is_file():
        return None, ''
    try:
        return facts.read(RunSummary, path, 'summary', 'it is made again'), ''
    except RunFolderError as error:
        return None, str(error)


def prepare(settings: Settings, run_id: str, folder: Path) -> list[str]:
    """Prepare the folder of a run over topics; what people should know.

    Raises:
        RunFolderError: its bag is damaged, or not of this run.
        OSError: it cannot be written.
    """
    from codetr_ros.bags.errors import BagError
    from codetr_ros.cores import preparing

    notes: list[str] = []
    try:
        preparing.for_nodes(settings, run_id, folder, notes.append)
    except BagError as error:
        raise RunFolderError(str(error)) from error
    return notes


def begin(folder: Path, made: Origin, settings: Settings) -> list[str]:
    """Note that a run goes on; what people should know of this machine.

    Args:
        folder: of the run.
        made: how it was begun.
        settings: under which it goes on.

    Raises:
        RunFolderError: a file is in the place of one of its folders.
        OSError: it cannot be written.
    """
    settings = config.settled(settings)
    run_folder.make_again(folder)
    run_folder.write_settings(folder, settings)
    origin.gone_on_with(folder, made)
    _, damaged = _summary(folder)
    notes = [damaged] if damaged else []
    if other := origin.differences(made, settings):
        notes.append(
            f'the run was begun with {"; ".join(other)}: the last bits of weights may differ'
        )
    return notes
