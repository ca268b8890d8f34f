"""What the cells of benchmarks have come to, read from their folders."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from codetr_ros.benchmark.folder import Folder, State, read_json
from codetr_ros.benchmark.spec import BenchmarkError


@dataclass(frozen=True)
class Result:
    """A cell and what has become of it.

    Attributes:
        cell: its name.
        folder: the benchmark that it belongs to.
        task, composite, delay, method, seed: what it is.
        settings: all of its settings, as they were when it was planned.
        state: finished, failed or missing.
        error: why it is not finished; empty where it is.
        log: the end of what a failed cell printed.
        summary: of a finished cell; else empty.
        commit: what it was run with, where that is known.
    """

    cell: str
    folder: Path
    task: str
    composite: str
    delay: int
    method: str
    seed: int
    settings: Mapping[str, Any]
    state: State
    error: str
    log: str
    summary: Mapping[str, Any]
    commit: str | None

    @property
    def score(self) -> float | None:
        """Mean score of the last evaluation's episodes."""
        value = self.summary.get('final_score')
        return None if value is None else float(value)

    @property
    def true_return(self) -> float | None:
        """Mean true return of the last evaluation's episodes."""
        value = self.summary.get('final_true_return')
        return None if value is None else float(value)


def read(paths: Sequence[Path]) -> list[Result]:
    """All cells of benchmarks, in the order of their specs.

    Raises:
        BenchmarkError: a folder is no benchmark's, two of them have the same cell, or cells that
            are to be compared have different settings.
    """
    found: dict[str, Result] = {}
    for path in paths:
        for result in _read(Folder(path)):
            if (other := found.get(result.cell)) is not None:
                raise BenchmarkError(
                    f'cell {result.cell} is in {other.folder} and in {result.folder}: report '
                    'them one by one'
                )
            found[result.cell] = result
    results = list(found.values())
    _check(results)
    return results


def _read(folder: Folder) -> Iterator[Result]:
    for name, row in folder.index()['cells'].items():
        state = folder.state(name, row['settings_hash'])
        ending = read_json(folder.ending(name)) or {}
        try:
            settings = yaml.safe_load(folder.settings(name).read_text())
        except (OSError, yaml.YAMLError) as error:
            raise BenchmarkError(f'{folder.settings(name)} cannot be read: {error}') from None
        failed = state == 'failed'
        yield Result(
            name,
            folder.path,
            row['task'],
            row['composite'],
            row['delay'],
            row['method'],
            row['seed'],
            settings,
            state,
            folder.error(name) if failed else '' if state == 'finished' else 'not run yet',
            (ending.get('log') or '') if failed else '',
            (folder.summary(name) or {}) if state == 'finished' else {},
            ending.get('commit'),
        )


def _check(results: Sequence[Result]) -> None:
    """Cells of a task must be alike in all but composite reward, delay, method and seed: what they
    came to is averaged and compared.
    """
    first: dict[str, Result] = {}
    for result in results:
        other = first.setdefault(result.task, result)
        for name in {**result.settings, **other.settings}:
            here, there = result.settings.get(name), other.settings.get(name)
            if name not in ('composite', 'delay', 'method', 'seed') and here != there:
                raise BenchmarkError(
                    f'{result.folder}: cell {result.cell} has {name} = {here!r}, but '
                    f'{other.cell} in {other.folder} has {there!r}: what is compared must be '
                    'alike; report them one by one'
                )
