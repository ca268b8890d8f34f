"""The folder of a run and the places in it."""

import re
from itertools import count
from pathlib import Path

import yaml

from codetr_ros import config
from codetr_ros.system.files import (
    FileError,
    atomic_write,
    check_makeable,
    check_writable,
    is_partial,
)

CONFIG = 'config.yaml'
ORIGIN = 'run.json'
BAG = 'bag'
CHECKPOINTS = 'checkpoints'
NODES = 'nodes'
LOGS = 'logs'
SUMMARY = 'summary.json'
METRICS = 'metrics.csv'
STEP_REWARDS = 'step_rewards.csv'
REPORT = 'report.html'
PICTURE = 'learning_curve.png'
FILM = 'film.png'
FILM_VIDEO = 'film.mp4'
MIDDLE = 'middle_policy'
STATUS = 'status.json'
EPISODE = 'newest_episode.json'
TENSORBOARD = 'tensorboard'
ROBOTS = 'robots'
POLICY = 'policy.safetensors'

EVERY = (NODES, LOGS, CHECKPOINTS)
"""The folders in it that every run has from its beginning on."""


class RunFolderError(ValueError):
    """A folder that cannot hold a run, or holds none: the message names it and the remedy."""


def _left(folder: Path) -> list[Path] | None:
    """The files that a run has left which was ended before it had begun, if the folder holds
    nothing else; None if it holds anything that somebody would miss.

    A run begins with `config.yaml`, which is written last.
    """
    left = []
    for entry in folder.iterdir():
        if entry.name in EVERY and entry.is_dir() and not any(entry.iterdir()):
            continue
        if entry.name != ORIGIN and not any(is_partial(entry, n) for n in (CONFIG, ORIGIN)):
            return None
        left.append(entry)
    return left


def has_only_begun(folder: Path) -> bool:
    """Whether a run was ended in this folder before it had begun: nothing of it can be lost."""
    return folder.is_dir() and any(folder.iterdir()) and _left(folder) is not None


def begin_anew(folder: Path) -> None:
    """Remove the files of a run that was ended before it had begun. Call it while the folder is
    held: see `origin.held`.

    Raises:
        RunFolderError: a run has begun here meanwhile.
        OSError: one cannot be removed.
    """
    check(folder)
    for path in _left(folder) or ():
        path.unlink()


def check(path: Path) -> None:
    """Check that `create` would accept this folder, without making anything: a new one, an empty
    one, or one in which a run was ended before it had begun.

    Raises:
        RunFolderError: it holds anything else, is not a folder, or cannot be written.
    """
    if path.exists():
        if not path.is_dir():
            raise RunFolderError(f'output folder {path} is a file: choose another with --out')
        try:
            check_writable(path)
        except FileError as error:
            raise RunFolderError(f'output folder {error} with --out') from None
        if _left(path) is None:
            names = sorted(entry.name for entry in path.iterdir())
            shown = ', '.join(names[:3]) + (', ...' if len(names) > 3 else '')
            goes_on = CONFIG in names and ORIGIN in names
            raise RunFolderError(
                f'output folder {path} exists and is not empty ({shown}): choose another with '
                '--out, or remove it'
                + (f'. The run in it goes on with `codetr train --resume {path}`' * goes_on)
            )
        return
    try:
        check_makeable(path)
    except FileError as error:
        raise RunFolderError(f'output folder {path} cannot be made, {error} with --out') from None


def create(path: Path) -> Path:
    """Make the folder of a new run, with the folders that every run has.

    Returns:
        The absolute path.

    Raises:
        RunFolderError: it holds something (see `check`), or it cannot be written.
    """
    check(path)
    folder = path.absolute()
    again = has_only_begun(folder)
    try:
        for name in EVERY:
            (folder / name).mkdir(parents=True, exist_ok=again)
    except FileExistsError as error:  # since it was checked
        raise RunFolderError(
            f'output folder {path} was made by another run just now: choose another with --out'
        ) from error
    except OSError as error:
        raise RunFolderError(
            f'output folder {path} cannot be made ({error.strerror}): choose another with --out'
        ) from error
    return folder


def make_again(folder: Path) -> None:
    """Make those of the folders that every run has which are gone.

    Raises:
        RunFolderError: a file is in the place of one, or it cannot be made.
    """
    for name in EVERY:
        try:
            (folder / name).mkdir(exist_ok=True)
        except OSError as error:
            raise RunFolderError(
                f'folder {folder / name} cannot be made ({error.strerror}): remove what is there, '
                'or make room'
            ) from error


def create_next(path: Path) -> Path:
    """Make the folder of a new run under this name or, where that is taken, under the next:
    NAME-2, NAME-3, ... Two runs that begin in the same second have the same name.

    Returns:
        The absolute path.

    Raises:
        RunFolderError: none can be made.
    """
    for number in count(1):
        folder = path if number == 1 else path.with_name(f'{path.name}-{number}')
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise RunFolderError(
                f'output folder {folder} cannot be made ({error.strerror}): choose another with '
                '--out'
            ) from error
        return create(folder)
    raise AssertionError('there is always a next number')


def bag_of(path: Path) -> Path:
    """The bag in a run's folder; any other path unchanged."""
    inside = path / BAG
    return inside if (path / CONFIG).is_file() and inside.is_dir() else path


def write_settings(folder: Path, settings: config.Settings) -> Path:
    """Write every setting to the run's `config.yaml`; `config.load` reads it."""
    path = folder / CONFIG
    text = yaml.safe_dump(settings.model_dump(mode='json'), sort_keys=False)
    note = f'# Every setting of this run: `codetr train --config {CONFIG}` repeats it.'
    atomic_write(path, f'{note}\n{text}')
    return path


def read_settings(folder: Path) -> config.Settings:
    """The settings of the run whose folder this is.

    Raises:
        RunFolderError: there is no `config.yaml`, so this is not the folder of a run.
        SettingsError: its settings are refused.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise RunFolderError(
            f'{folder} is not the folder of a run, it has no {CONFIG}: give the folder that '
            '`codetr train` named'
        )
    return config.load(str(path))


def forget_reports(folder: Path) -> None:
    """Remove the reports of the nodes of a run that is gone on with: they write new ones."""
    for path in (folder / NODES).glob('*.json'):
        path.unlink()


def _file_name(text: str) -> str:
    return re.sub(r'[^A-Za-z0-9_.]+', '_', text).strip('_') or 'unnamed'


def report_path(folder: Path, role: str, name: str) -> Path:
    """The path of the report of a node with this role and (fully qualified or plain) name."""
    return folder / NODES / f'{role}-{_file_name(name.rsplit("/", 1)[-1])}.json'
