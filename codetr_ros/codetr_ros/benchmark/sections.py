"""The parts of a benchmark's report other than scores, each as blocks of a document."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from codetr_ros.benchmark import paper
from codetr_ros.benchmark.folder import Folder
from codetr_ros.benchmark.results import Result
from codetr_ros.benchmark.scores import NONE
from codetr_ros.benchmark.table import methods
from codetr_ros.config import Settings
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


def _every(results: Sequence[Result], name: str) -> str:
    return ', '.join(map(str, dict.fromkeys(getattr(result, name) for result in results)))


def title(results: Sequence[Result]) -> str:
    """The title of the report: the tasks."""
    return f'Benchmark: {_every(results, "task")}'


def protocol(results: Sequence[Result]) -> list[Block]:
    """The methods, tasks and settings that were run, and the states of the cells."""
    counts = {state: sum(r.state == state for r in results) for state in _STATES}
    steps = ', '.join(map(str, dict.fromkeys(r.settings['steps'] for r in results)))
    episodes = ', '.join(map(str, dict.fromkeys(r.settings['evaluate_episodes'] for r in results)))
    return [
        Paragraph(
            f'Methods {_every(results, "method")}; composite rewards '
            f'{_every(results, "composite")}; delays {_every(results, "delay")}; seeds '
            f'{_every(results, "seed")}; {steps} steps. Score: composite return of the last '
            f"evaluation's {episodes} episodes over that of an agent that earns r_max at every "
            'step (1 is perfect; standing still need not be 0: see the anchors).'
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


def the_paper(r_max: Mapping[str, float]) -> list[Block]:
    """The paper's Table 2, and the differences from ours."""
    order = list(paper.TABLE_2['sum'])
    lines: list[list[str | Bold]] = [
        [composite, *(f'{by[m][0]:.4f} ({by[m][1]:.4f})' for m in order)]
        for composite, by in paper.TABLE_2.items()
    ]
    others = [task for task in r_max if task not in paper.TASKS]
    units = ', '.join(f'{task} {exact(value)}' for task, value in r_max.items())
    return [
        Heading("The paper's Table 2, and how ours differs"),
        Paragraph('Ant-v2, delays from 25 to 200, 3 trials, a million steps.'),
        Table(['composite', *order], lines),
        *(
            [
                Paragraph(
                    f'The supplement has no numbers for {", ".join(others)}: these are not '
                    'comparable with the table above.'
                )
            ]
            if others
            else []
        ),
        Items([text.format(r_max=units) for text in paper.DIFFERENCES]),
    ]


def settings(results: Sequence[Result]) -> list[Block]:
    """Settings that differ from those of the paper."""
    lines: dict[tuple[str, str, str], list[str]] = {}
    descriptions = Settings().flat()
    for result in results:
        for name, there, here in paper.settings_differences(result.settings):
            shown = str(there) if name in descriptions else NONE
            tasks = lines.setdefault((name, shown, str(here)), [])
            if result.task not in tasks:
                tasks.append(result.task)
    rows: list[list[str | Bold]] = [[*key, ', '.join(tasks)] for key, tasks in lines.items()]
    if not rows:
        return [Heading('Settings'), Paragraph('Those of the preset `paper`.')]
    return [
        Heading('Settings that differ from the preset paper'),
        Table(['setting', 'paper', 'here', 'task'], rows),
    ]


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
