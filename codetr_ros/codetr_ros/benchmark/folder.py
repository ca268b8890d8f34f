"""The folder of a benchmark: its files, and the state of each cell.

    spec.yaml                the spec with every setting; `codetr benchmark run` takes it
    benchmark.json           all cells with the hash of their settings; where and when it was run
    cells/<cell>.yaml        the cell's settings
    cells/<cell>.log         the output of its last run
    cells/<cell>.json        the ending of its last run
    <cell>/                  the folder of its run, once it has ended
    attempts/                runs that have not ended
    aside/                   unfinished runs that lay in the place of a cell

A run works in `attempts/`, under a unique name, and is renamed into its place when it has ended.
So a cell is there whole or not at all, and a process that outlives its runner writes into no place
that matters.
"""

import fcntl
import json
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import yaml

from codetr_ros.benchmark.spec import BenchmarkError, Cell, Spec
from codetr_ros.config import flatten
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import run_summary
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.system import parsing
from codetr_ros.system.files import atomic_write
from codetr_ros.system.parsing import ParseError, read_yaml
from codetr_ros.system.versions import versions

SPEC = 'spec.yaml'
INDEX = 'benchmark.json'
CELLS = 'cells'
ATTEMPTS = 'attempts'
ASIDE = 'aside'
FORMAT = 1

State = Literal['finished', 'failed', 'missing']


def finished(summary: RunSummary | None, settings_hash: str) -> bool:
    """Whether a run is complete by its summary, under the settings of this hash."""
    return summary is not None and summary.settings_hash == settings_hash and summary.complete


def read_summary(run: Path) -> RunSummary | None:
    """The summary in the folder of a run; None if it is missing or cannot be read, and so its cell
    is not finished.
    """
    try:
        return run_summary.read(run / run_folder.SUMMARY)
    except run_folder.RunFolderError:
        return None


def read_json(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file; None if there is no file or no such object in it."""
    try:
        data = parsing.read_json(path)
    except (OSError, ParseError):
        return None
    return data if isinstance(data, dict) else None


class Folder:
    """The folder of one benchmark.

    Args:
        path: the folder, which need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()

    def settings(self, cell: str) -> Path:
        """The file of the cell's settings."""
        return self.path / CELLS / f'{cell}.yaml'

    def log(self, cell: str) -> Path:
        """The file of its last run's output."""
        return self.path / CELLS / f'{cell}.log'

    def ending(self, cell: str) -> Path:
        """The file of its last run's ending."""
        return self.path / CELLS / f'{cell}.json'

    def run(self, cell: str) -> Path:
        """The folder of its run."""
        return self.path / cell

    @property
    def attempts(self) -> Path:
        """The folder in which runs work."""
        return self.path / ATTEMPTS

    def summary(self, cell: str) -> RunSummary | None:
        """The summary of the cell's run, if there is one."""
        return read_summary(self.run(cell))

    def state(self, cell: str, settings_hash: str) -> State:
        """The state of a cell whose settings have this hash."""
        if finished(self.summary(cell), settings_hash):
            return 'finished'
        ending = read_json(self.ending(cell))
        failed = ending and ending['settings_hash'] == settings_hash and ending['error']
        return 'failed' if failed else 'missing'

    def error(self, cell: str) -> str:
        """The error of the cell's last run, in a line."""
        ending = read_json(self.ending(cell))
        return str(ending['error']) if ending and ending['error'] else 'unknown'

    def index(self) -> dict[str, Any]:
        """The content of `benchmark.json`.

        Raises:
            BenchmarkError: it is missing, so this is not the folder of a benchmark, or it is
                damaged.
        """
        path = self.path / INDEX
        if not path.is_file():
            raise BenchmarkError(
                f'{self.path} is not the folder of a benchmark, it has no {INDEX}: '
                'give the folder that was the --out of `codetr benchmark run`'
            )
        index = read_json(path)
        if index is None or index.get('format') != FORMAT:
            raise BenchmarkError(
                f'{path} is damaged or of another version: it must be a JSON object with '
                f'format {FORMAT}'
            )
        return index

    def threads(self) -> int | None:
        """The number of threads of the cells; None if the benchmark has not begun.

        Raises:
            BenchmarkError: the spec in the folder cannot be read.
        """
        path = self.path / SPEC
        if not path.is_file():
            return None
        try:
            there = read_yaml(path)
        except (OSError, ParseError) as error:
            raise BenchmarkError(f'{path} cannot be read: {error}') from None
        if not isinstance(there, dict):
            raise BenchmarkError(f'{path} must hold a mapping, not {type(there).__name__}')
        threads = dict(flatten(there)).get('config.threads')
        return threads if isinstance(threads, int) else None

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep every other runner out of this folder.

        Raises:
            BenchmarkError: one is in it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BenchmarkError(
                f'{self.path}: another `codetr benchmark run` is at work there: wait for it, '
                'or choose another folder with --out'
            ) from None
        else:
            yield
        finally:
            os.close(handle)

    def check(self, spec: Spec) -> None:
        """Refuse a folder that holds anything but this benchmark, or the beginnings of it.

        Raises:
            BenchmarkError: it is of another spec, with cells that this one lacks or has under
                other settings; or it is not of a benchmark at all.
        """
        if not (self.path / INDEX).is_file():
            try:
                run_folder.check(self.path)
            except run_folder.RunFolderError as error:
                raise BenchmarkError(str(error)) from None
            return
        new = {cell.name: cell for cell in spec.cells}
        there: dict[str, dict[str, Any]] = self.index()['cells']
        if lacking := [name for name in there if name not in new]:
            raise BenchmarkError(
                f'{self.path} was made by another spec: it has {len(lacking)} cells that this '
                f'one lacks ({", ".join(lacking[:3])}{", ..." if len(lacking) > 3 else ""}). A '
                'spec may only add cells; choose another folder with --out'
            )
        for name, row in there.items():
            if row['settings_hash'] != new[name].settings.hash():
                raise BenchmarkError(
                    f'{self.path} was made by another spec: cell {name} has other settings there '
                    f'({self._difference(new[name])}). A spec may only add cells; choose another '
                    'folder with --out'
                )

    def _difference(self, cell: Cell) -> str:
        """The settings in which the cell differs from that in the folder."""
        path = self.settings(cell.name)
        try:
            there = read_yaml(path)
        except (OSError, ParseError) as error:
            return f'{path}: {error}'
        before = dict(flatten(there if isinstance(there, dict) else {}))
        now = dict(flatten(cell.settings.model_dump(mode='json')))
        names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        shown = [f'{n}: {before.get(n)!r} there, {now.get(n)!r} here' for n in names[:4]]
        return '; '.join(shown) + ('; ...' if len(names) > 4 else '')

    def prepare(self, spec: Spec, session: Mapping[str, Any]) -> None:
        """Write the spec, the index and the settings of the cells.

        Args:
            spec: the benchmark, checked.
            session: of this run of the benchmark; kept beside those before.
        """
        (self.path / CELLS).mkdir(exist_ok=True)
        self.attempts.mkdir(exist_ok=True)
        before = self.index()['sessions'] if (self.path / INDEX).is_file() else []
        cells = {}
        for cell in spec.cells:
            cells[cell.name] = _row(cell)
            path = self.settings(cell.name)
            text = yaml.safe_dump(cell.settings.model_dump(mode='json'), sort_keys=False)
            if not path.is_file() or path.read_text() != text:
                atomic_write(path, text)
        index = {'format': FORMAT, 'cells': cells, 'sessions': [*before, dict(session)]}
        atomic_write(self.path / SPEC, spec.to_yaml())
        atomic_write(self.path / INDEX, json.dumps(index, indent=1) + '\n')

    def clear_attempts(self) -> int:
        """Remove runs that dead runners or nodes left unfinished; returns how many."""
        logs = list(self.attempts.glob('*.log'))  # one for each
        for log in logs:
            # a node that is cut off may still write there: a later runner tries again
            shutil.rmtree(log.with_suffix(''), ignore_errors=True)
            if not log.with_suffix('').exists():
                log.unlink()
        return len(logs)

    def set_aside(self, cell: str) -> Path | None:
        """Move away the run in the cell's place, if any; returns its new path."""
        place = self.run(cell)
        if not place.exists():
            return None
        (self.path / ASIDE).mkdir(exist_ok=True)
        number = 1
        while (aside := self.path / ASIDE / f'{cell}.{number}').exists():
            number += 1
        place.rename(aside)
        return aside


def _row(cell: Cell) -> dict[str, Any]:
    names = ('task', 'composite', 'delay', 'method', 'seed', 'steps')
    settings = cell.settings.model_dump(mode='json', include=set(names))
    return {name: settings[name] for name in names} | {'settings_hash': cell.settings.hash()}


def session(spec: Path, workers: int, ray: str | None) -> dict[str, Any]:
    """The record of one run of a benchmark: versions, commit, machine, time."""
    return {
        'began': time.strftime('%Y-%m-%dT%H:%M:%S%z'),
        'spec': str(spec),
        'workers': workers,
        'ray': ray,
        **provenance(),
    }


def provenance() -> dict[str, Any]:
    """Commit (None outside a git checkout; `+changes` where files differ from it), machine and
    versions.
    """
    return {
        'commit': _commit(Path(__file__).parent),
        'machine': {'cpu': _cpu(), 'cores': os.cpu_count()},
        'versions': versions(),
    }


def _commit(folder: Path) -> str | None:
    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ['git', '-C', str(folder), *arguments], capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.CalledProcessError):
            return None
        return done.stdout.strip()

    commit = git('rev-parse', 'HEAD')
    if commit is None or git('ls-files', '--', str(folder)) in (None, ''):
        return None  # another checkout that happens to surround an installed package
    return commit + ('+changes' if git('status', '--porcelain', '--', str(folder.parent)) else '')


def _cpu() -> str:
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(':', 1)[1].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.processor() or platform.machine()
