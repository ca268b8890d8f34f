"""The parts of a benchmark's report other than scores, each as blocks of a document."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from codetr_ros import config
from codetr_ros.benchmark import paper
from codetr_ros.benchmark.folder import Folder
from codetr_ros.benchmark.results import VARIED, Result
from codetr_ros.benchmark.scores import NONE
from codetr_ros.benchmark.table import methods
from codetr_ros.runs.document import (
    Block,
    Bold,
    Heading,
    Items,
    Paragraph,
    Picture,
    Table,
    Verbatim,
)
from codetr_ros.runs.numbers import exact
from codetr_ros.runs.report_origin import setting


def _every(results: Sequence[Result], name: str) -> str:
    return ', '.join(map(str, dict.fromkeys(getattr(result, name) for result in results)))


def title(results: Sequence[Result]) -> str:
    """The title of the report: the tasks."""
    return f'Benchmark: {_every(results, "task")}'


def protocol(results: Sequence[Result], r_max: Mapping[str, float]) -> list[Block]:
    """The methods, tasks and settings that were run, and the states of the cells.

    Args:
        results: of all cells.
        r_max: the largest reward of a step, by task.
    """
    counts = {state: sum(r.state == state for r in results) for state in _STATES}
    steps = ', '.join(map(str, dict.fromkeys(r.settings['steps'] for r in results)))
    episodes = ', '.join(map(str, dict.fromkeys(r.settings['evaluate_episodes'] for r in results)))
    return [
        Paragraph(
            f'Methods {_every(results, "method")}; composite rewards '
            f'{_every(results, "composite")}; delays {_every(results, "delay")}; seeds '
            f'{_every(results, "seed")}; {steps} steps. Score: composite return of the last '
            f"evaluation's episodes ({episodes}) over that of an agent that earns r_max at every "
            'step (1 is perfect; standing still need not be 0). r_max, the unit of scores: '
            f'{_units(r_max)}.'
        ),
        Paragraph(
            f'{len(results)} cells: '
            + ', '.join(f'{count} {state}' for state, count in counts.items())
            + ('' if counts['finished'] == len(results) else '. See "Failed and missing cells".')
        ),
    ]


_STATES = ('finished', 'failed', 'missing')


def recovery(results: Sequence[Result]) -> list[Block]:
    """The agreement of labels and true rewards at the end of training."""
    order = methods(results)
    lines: list[list[str | Bold]] = []
    for key in dict.fromkeys((r.task, r.composite, r.delay) for r in results):
        line: list[str | Bold] = [key[0], key[1], str(key[2])]
        for method in order:
            last = [
                r.reward_recovery[-1].within
                for r in results
                if (r.task, r.composite, r.delay) == key
                and r.method == method
                and r.reward_recovery
            ]
            values = [value for value in last if value is not None]
            text = f'{np.mean(values):.2f}' if values else NONE
            several = f' ({min(values):.2f} to {max(values):.2f})' if len(values) > 1 else ''
            line.append(text + several)
        lines.append(line)
    return [
        Heading('Reward recovery at the last evaluation'),
        Paragraph(
            'Pearson correlation of the newest labels in memory with the true step rewards, each '
            "segment's mean removed from both: is credit right inside segments? Mean over seeds, "
            f'lowest and highest in brackets; {NONE} if there are no labels, or labels that do '
            'not vary within segments. Each method is measured on the steps of its own policies, '
            'so columns are not on the same data.'
        ),
        Table(['task', 'composite', 'delay', *order], lines),
    ]


def pictures(files: Mapping[str, bytes]) -> list[Block]:
    """All pictures."""
    return [
        Heading('Learning curves'),
        *(Picture(name, 'learning curves') for name in files if name.startswith('learning_')),
        Heading('Reward recovery over training'),
        *(Picture(name, 'reward recovery') for name in files if name.startswith('recovery_')),
    ]


def unfinished(results: Sequence[Result]) -> list[Block]:
    """Every cell without a result, with its error."""
    failed = [result for result in results if result.state == 'failed']
    missing = [result for result in results if result.state == 'missing']
    blocks: list[Block] = [Heading('Failed and missing cells')]
    if not failed and not missing:
        return [*blocks, Paragraph('None.')]
    for result in failed:
        blocks += [Heading(result.cell, 3), Paragraph(f'Failed: {result.error}')]
        if result.log:
            blocks.append(Verbatim(result.log))
    if missing:
        blocks.append(Paragraph(f'Not run yet ({len(missing)}):'))
        blocks.append(Items([result.cell for result in missing]))
    return blocks


def differences(results: Sequence[Result], r_max: Mapping[str, float]) -> list[Block]:
    """All known differences from the paper's table; nothing if its task is not among ours."""
    units = {task: value for task, value in r_max.items() if task in paper.TASKS}
    if not units:
        return []
    mine = _settings([result for result in results if result.task in units], 'paper')
    blocks: list[Block] = [
        Heading('How it differs from the paper', 3),
        Items([text.format(r_max=_units(units)) for text in paper.DIFFERENCES]),
    ]
    if mine is not None:
        blocks += [Paragraph('Settings that differ from the preset paper:'), mine]
    return blocks


def _units(r_max: Mapping[str, float]) -> str:
    return ', '.join(f'{task} {exact(value)}' for task, value in r_max.items())


def settings(results: Sequence[Result]) -> list[Block]:
    """The settings of the cells that differ from the nearest preset."""
    preset = config.nearest(results[0].settings)
    table = _settings(results, preset)
    if table is None:
        return [Heading('Settings'), Paragraph(f'Those of the preset {preset}.')]
    return [Heading(f'Settings that differ from the preset {preset}, the nearest'), table]


def _settings(results: Sequence[Result], preset: str) -> Table | None:
    """The settings that differ from a preset, but for those that vary; None if there are none."""
    lines: dict[tuple[str, str, str], dict[str, None]] = {}
    for result in results:
        for name, there, here in config.differences(result.settings, preset):
            if name not in VARIED:
                key = name, setting(there), setting(here)
                lines.setdefault(key, {})[result.task] = None
    rows: list[list[str | Bold]] = [[*key, ', '.join(tasks)] for key, tasks in lines.items()]
    return Table(['setting', preset, 'here', 'task'], rows) if rows else None


def sessions(paths: Sequence[Path]) -> list[Block]:
    """The machines, versions and times of the runs."""
    lines: list[list[str | Bold]] = []
    for path in paths:
        for session in Folder(path).index()['sessions']:
            machine, versions = session['machine'], session['versions']
            lines.append(
                [
                    session['began'],
                    str(session['commit']),
                    f'{machine["cores"]} cores, {machine["cpu"]}',
                    f'Python {versions["python"]}, torch {versions["torch"]}, MuJoCo '
                    f'{versions["mujoco"]}, Gymnasium {versions["gymnasium"]}',
                    str(session['workers']),
                ]
            )
    return [
        Heading('Where it was run'),
        Table(['begun', 'commit', 'machine', 'versions', 'workers'], lines),
    ]
