"""The spec of a benchmark: a YAML file with lists whose combinations are the cells.

    methods: [codetr, none, 'true']
    tasks: [HalfCheetah-v5]
    composites: [sum, max]
    delays: [25]                # also drawn lengths, 10:50, and episode
    seeds: [0, 1, 2]
    steps: 30000
    config:                     # optional; without it, the preset quick
      base: cpu                 # a preset, or a YAML file beside the spec
      evaluate_every: 5000      # any setting, nested or by dotted name
      sac.batch: 128

`config: cpu` alone is short for `config: {base: cpu}`.
"""

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, ValidationError, field_validator

from codetr_ros import config
from codetr_ros.config import Composite, Delay, Group, Method, Settings, SettingsError
from codetr_ros.simulation import tasks
from codetr_ros.system.parsing import ParseError, read_yaml
from codetr_ros.system.similar import did_you_mean

DEFAULT_BASE = 'quick'
_AXES = {
    'task': 'tasks',
    'composite': 'composites',
    'delay': 'delays',
    'method': 'methods',
    'seed': 'seeds',
    'steps': 'steps',
}
"""The settings that have their own keys in a spec."""


class BenchmarkError(ValueError):
    """A benchmark that cannot be run or read: names value, key, file and remedy."""


@dataclass(frozen=True)
class Cell:
    """One run of a benchmark.

    Attributes:
        name: the name of its folder, the same in every spec with this cell.
        settings: all of its settings.
    """

    name: str
    settings: Settings


class _Keys(Group):
    """The keys of a spec."""

    methods: tuple[Method, ...] = Field(min_length=1)
    tasks: tuple[Annotated[str, Field(min_length=1)], ...] = Field(min_length=1)
    composites: tuple[Composite, ...] = Field(min_length=1)
    delays: tuple[Delay, ...] = Field(min_length=1)
    seeds: tuple[int, ...] = Field(min_length=1)
    steps: int = Field(ge=1)
    config: str | dict[str, Any] = DEFAULT_BASE

    @field_validator('methods', mode='before')
    @classmethod
    def _unquoted_true(cls, methods: Any) -> Any:
        # YAML reads the name of the oracle as a boolean unless it is quoted
        return (
            ['true' if name is True else name for name in methods]
            if isinstance(methods, list)
            else methods
        )

    @field_validator('methods', 'tasks', 'composites', 'delays', 'seeds')
    @classmethod
    def _each_once(cls, values: tuple[Any, ...]) -> tuple[Any, ...]:
        if twice := sorted({str(v) for v in values if values.count(v) > 1}):
            raise ValueError(f'{", ".join(twice)} twice: each cell is run once, name it once')
        return values


@dataclass(frozen=True)
class Spec:
    """A benchmark, validated.

    Attributes:
        keys: the spec's lists and `steps`, by key.
        base: the settings that all cells share; those of the lists are the first cell's.
        cells: all runs, those of one seed together, so that a whole table is there early.
    """

    keys: Mapping[str, Any]
    base: Settings
    cells: tuple[Cell, ...]

    def to_yaml(self) -> str:
        """The spec with every setting, which needs no preset and no other file."""
        shared = {
            name: value
            for name, value in self.base.model_dump(mode='json').items()
            if name not in _AXES
        }
        text = yaml.safe_dump({**self.keys, 'config': shared}, sort_keys=False)
        return f'# Every setting of this benchmark: `codetr benchmark run` repeats it.\n{text}'


def load(path: Path) -> Spec:
    """Read and validate a spec, every cell's settings included.

    Raises:
        BenchmarkError: the file is missing or not YAML, a key or a setting is wrong, or a task
            does not exist. Names key, value and file.
    """
    try:
        data = read_yaml(path)
    except OSError as error:
        raise BenchmarkError(f'spec {path} cannot be read: {error.strerror}') from None
    except ParseError as error:
        raise BenchmarkError(f'spec {path} {error}') from None
    if not isinstance(data, Mapping):
        raise BenchmarkError(
            f'spec {path} must hold a mapping with the keys {", ".join(_Keys.model_fields)}, '
            f'not {type(data).__name__}'
        )
    known = _Keys.model_fields
    if unknown := {str(key): value for key, value in data.items() if key not in known}:
        first = next(iter(unknown))
        raise BenchmarkError(
            f'spec {path}: there is no key {", ".join(unknown)} (value {unknown[first]!r})'
            f'{did_you_mean(first, known)}. '
            f'Keys are: {", ".join(known)}; settings go under config'
        )
    try:
        keys = _Keys.model_validate(dict(data))
        base = _base(keys, path)
        cells = tuple(_cells(keys, base, path))
    except ValidationError as error:
        raise BenchmarkError(config.explain(error, f'spec {path}')) from None
    except (SettingsError, tasks.TaskError) as error:
        raise BenchmarkError(str(error)) from None
    if len({cell.name for cell in cells}) < len(cells):
        raise BenchmarkError(
            f'spec {path}: tasks = {list(keys.tasks)} give the same name to different cells: '
            'put them into benchmarks of their own'
        )
    lists = keys.model_dump(mode='json', exclude={'config'})
    return Spec(lists, cells[0].settings, cells)


def _base(keys: _Keys, path: Path) -> Settings:
    """The settings that all cells share: the base configuration with the overrides."""
    given = {'base': keys.config} if isinstance(keys.config, str) else dict(keys.config)
    name = given.pop('base', DEFAULT_BASE)
    source = f'spec {path}: config'
    if not isinstance(name, str):
        raise BenchmarkError(f'{source}.base = {name!r}: must name a preset or a YAML file')
    if name not in config.PRESETS:
        beside = path.parent / name
        if not beside.is_file():
            raise BenchmarkError(
                f'{source}.base = {name!r}: neither a preset ({", ".join(config.PRESETS)}) nor a '
                f'file ({beside})'
            )
        name = str(beside)
    changes = dict(config.flatten(given))
    if decided := [setting for setting in changes if setting in _AXES]:
        raise BenchmarkError(
            f'{source}.{decided[0]} = {changes[decided[0]]!r}: the key {_AXES[decided[0]]} of '
            'the spec decides it; remove one of them'
        )
    # with the first of each list: some settings fit only the methods of their spec
    lists = {axis: key for axis, key in _AXES.items() if axis != 'steps'}
    first = {axis: getattr(keys, key)[0] for axis, key in lists.items()}
    settings = config.load(name).changed(first | {'steps': keys.steps} | changes, source)
    if not settings.evaluate_every:
        raise BenchmarkError(
            f'{source}.evaluate_every = 0: a run without evaluations has no score; give the steps '
            'between evaluations'
        )
    return settings


def _cells(keys: _Keys, base: Settings, path: Path) -> Iterator[Cell]:
    axes = (keys.seeds, keys.tasks, keys.composites, keys.delays, keys.methods)
    for seed, task, composite, delay, method in itertools.product(*axes):
        name = cell_name(task, composite, delay, method, seed)
        changes = {
            'task': task,
            'composite': composite,
            'delay': delay,
            'method': method,
            'seed': seed,
            'steps': keys.steps,
        }
        settings = base.changed(changes, f'spec {path}, cell {name}')
        try:
            tasks.check(settings, tasks.find(task))
        except (SettingsError, tasks.TaskError) as error:
            raise BenchmarkError(f'spec {path}, cell {name}: {error}') from None
        yield Cell(name, settings)


def cell_name(task: str, composite: str, delay: int | str, method: str, seed: int) -> str:
    """The name of a cell and of its folder, such as HalfCheetah-v5_sum_25_codetr_seed0."""
    plain, steps = (re.sub(r'[^A-Za-z0-9.-]+', '-', str(name)) for name in (task, delay))
    return f'{plain}_{composite}_{steps}_{method}_seed{seed}'
