"""A benchmark's folder with results made by hand."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from codetr_ros.benchmark import spec
from codetr_ros.benchmark.folder import Folder, session
from codetr_ros.benchmark.spec import Cell
from codetr_ros.runs import run_summary
from codetr_ros.runs.run_summary import Evaluation, RewardRecovery, RunSummary, Spent
from codetr_ros.runs.summary import Summary

Score = Callable[[Cell], float | str | None]
"""The score of a cell, or why it failed, or None where it has not been run."""


def benchmark(path: Path, score: Score, **keys: Any) -> Folder:
    """Plan a benchmark and give its cells results: a learning curve that ends at the score.

    Args:
        path: its folder, made.
        score: of each cell.
        keys: of the spec, other than the usual ones.
    """
    path.mkdir(parents=True)
    given = {
        'methods': ['codetr', 'none'],
        'tasks': ['InvertedPendulum-v5'],
        'composites': ['sum'],
        'delays': [25],
        'seeds': [0, 1, 2],
        'steps': 3000,
        'config': {'evaluate_every': 1000, 'evaluate_episodes': 2},
    }
    file = path.with_suffix('.yaml')
    file.write_text(yaml.safe_dump({**given, **keys}))
    made = spec.load(file)
    folder = Folder(path)
    folder.prepare(made, session(file, 1, None))
    for cell in made.cells:
        said = score(cell)
        if said is not None:
            _end(folder, cell, said)
    return folder


def _end(folder: Folder, cell: Cell, said: float | str) -> None:
    hashed = cell.settings.hash()
    failed = isinstance(said, str)
    ending = {
        'settings_hash': hashed,
        'error': said if failed else None,
        'log': f'Traceback\n{said}' if failed else None,
        'commit': 'abc',
    }
    folder.ending(cell.name).write_text(json.dumps(ending))
    if failed:
        return
    folder.run(cell.name).mkdir()
    run_summary.write(folder.run(cell.name), _summary(cell, said))


def _summary(cell: Cell, score: float) -> RunSummary:
    """Of a run whose score grew to this one."""
    empty = Summary(cell.settings, 'run', in_process=True).build({})
    steps = [1000, 2000, 3000]
    evaluations = [
        Evaluation(
            step=step,
            version=step // 1000 - 1,
            true_return_mean=score * step / 3,
            true_return_std=0.0,
            true_return_min=0.0,
            true_return_max=0.0,
            composite_return_mean=0.0,
            score_mean=score * step / 3000,
            score_std=0.0,
            length_mean=1.0,
            episodes=2,
        )
        for step in steps
    ]
    recovery = [
        RewardRecovery(step=step, pearson=score, within=score / 2, spearman=None, steps=step)
        for step in steps
    ]
    return empty.model_copy(
        update={
            'steps': 3000,
            'final_score': score,
            'final_true_return': 1000 * score,
            'wall_s': 12.5,
            'evaluations': evaluations,
            'spent': [Spent(step=step, cpu_s=step / 100) for step in steps],
            'reward_recovery': recovery if cell.settings.method == 'codetr' else [],
        }
    )
