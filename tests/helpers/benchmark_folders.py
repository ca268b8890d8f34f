"""A benchmark's folder with results made by hand."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from codetr_ros.benchmark import spec
from codetr_ros.benchmark.folder import Folder, session
from codetr_ros.benchmark.spec import Cell

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
    steps = [1000, 2000, 3000]
    summary = {
        'settings_hash': hashed,
        'steps': 3000,
        'steps_planned': 3000,
        'interrupted': False,
        'failure': None,
        'final_score': said,
        'final_true_return': 1000 * said,
        'wall_s': 12.5,
        'evaluations': [
            {'step': s, 'score_mean': said * s / 3000, 'true_return_mean': said * s / 3}
            for s in steps
        ],
        'reward_recovery': [
            {'step': s, 'pearson': said, 'within': said / 2, 'spearman': None, 'steps': s}
            for s in steps
        ]
        if cell.settings.method == 'codetr'
        else [],
    }
    folder.run(cell.name).mkdir()
    (folder.run(cell.name) / 'summary.json').write_text(json.dumps(summary))
