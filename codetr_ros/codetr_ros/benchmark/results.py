"""The results of the cells of benchmarks, read from their folders."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codetr_ros.benchmark.folder import Folder, State, read_json
from codetr_ros.benchmark.spec import BenchmarkError
from codetr_ros.runs.run_summary import Evaluation, RewardRecovery, RunSummary
from codetr_ros.system.parsing import ParseError, read_yaml

VARIED = ('task', 'composite', 'delay', 'method', 'seed')
"""The settings in which the cells of a benchmark differ."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """A cell and its result.

    Attributes:
        cell: its name.
        folder: the benchmark that it belongs to.
        task, composite, delay, method, seed: its place in the benchmark.
        settings: all of its settings, as planned.
        state: finished, failed or missing.
        error: why it is not finished; empty if it is.
        log: the end of a failed cell's output.
        summary: of a finished cell.
        commit: of the code that ran it, if known.
    """

    cell: str
    folder: Path
    task: str
    composite: str
    delay: int | str
    method: str
    seed: int
    settings: Mapping[str, Any]
    state: State
    error: str
    log: str
    summary: RunSummary | None
    commit: str | None

    @property
    def score(self) -> float | None:
        """Mean score of the last evaluation's episodes."""
        return self.summary.final_score if self.summary else None

    @property
    def true_return(self) -> float | None:
        """Mean true return of the last evaluation's episodes."""
        return self.summary.final_true_return if self.summary else None

    @property
    def evaluations(self) -> Sequence[Evaluation]:
        """The evaluations of a finished cell, in the order of training steps."""
        return self.summary.evaluations if self.summary else ()

    @property
    def reward_recovery(self) -> Sequence[RewardRecovery]:
        """The agreement of labels and true rewards at each evaluation of a finished cell."""
        return self.summary.reward_recovery if self.summary else ()


def read(paths: Sequence[Path]) -> list[Result]:
    """Read all cells of benchmarks, in the order of their specs.

    Raises:
        BenchmarkError: a folder is not a benchmark's, two of them have the same cell, or cells
            that are compared have different settings.
    """
    by_cell: dict[str, Result] = {}
    for path in paths:
        for result in _read(Folder(path)):
            if (other := by_cell.get(result.cell)) is not None:
                raise BenchmarkError(
                    f'cell {result.cell} is in {other.folder} and in {result.folder}: report '
                    'them one by one'
                )
            by_cell[result.cell] = result
    results = list(by_cell.values())
    _check(results)
    return results


def _read(folder: Folder) -> Iterator[Result]:
    for name, row in folder.index()['cells'].items():
        state = folder.state(name, row['settings_hash'])
        ending = read_json(folder.ending(name)) or {}
        try:
            settings = read_yaml(folder.settings(name))
        except (OSError, ParseError) as error:
            raise BenchmarkError(f'{folder.settings(name)}: {error}') from None
        if not isinstance(settings, dict):
            raise BenchmarkError(
                f'{folder.settings(name)} must hold a mapping of settings, not '
                f'{type(settings).__name__}'
            )
        failed = state == 'failed'
        yield Result(
            cell=name,
            folder=folder.path,
            task=row['task'],
            composite=row['composite'],
            delay=row['delay'],
            method=row['method'],
            seed=row['seed'],
            settings=settings,
            state=state,
            error=folder.error(name) if failed else '' if state == 'finished' else 'not run yet',
            log=(ending.get('log') or '') if failed else '',
            summary=folder.summary(name) if state == 'finished' else None,
            commit=ending.get('commit'),
        )


def _check(results: Sequence[Result]) -> None:
    """Check that cells of a task differ only in composite reward, delay, method and seed, because
    their results are averaged and compared.
    """
    first: dict[str, Result] = {}
    for result in results:
        other = first.setdefault(result.task, result)
        for name in {**result.settings, **other.settings}:
            here, there = result.settings.get(name), other.settings.get(name)
            if name not in VARIED and here != there:
                raise BenchmarkError(
                    f'{result.folder}: cell {result.cell} has {name} = {here!r}, but '
                    f'{other.cell} in {other.folder} has {there!r}: what is compared must be '
                    'alike; report them one by one'
                )
