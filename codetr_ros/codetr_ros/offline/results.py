"""The results of a fit: its folder, its summary, and the table that it prints at the end."""

import dataclasses
import json
import resource
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings
from codetr_ros.offline.cutting import Stretches
from codetr_ros.offline.episodes import Index
from codetr_ros.offline.fitting import Fitted
from codetr_ros.offline.judging import MEASURES, Judgement
from codetr_ros.offline.phases import Fold
from codetr_ros.offline.settings import FitSettings
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system.files import atomic_write
from codetr_ros.system.parsing import ParseError, read_json

DIGEST = 'reward_model_sha256'

WORST = 1000
"""Explained parts of a variance are shown down to minus this."""


def make_folder(path: Path) -> Path:
    """Make the folder of a fit; returns its absolute path.

    Raises:
        RunFolderError: it is not empty, or cannot be made.
    """
    run_folder.check(path)
    try:
        (path / run_folder.CHECKPOINTS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f'output folder {path} cannot be made ({error.strerror}): choose another with --out'
        ) from error
    return path.absolute()


def peak_mb() -> float:
    """The most memory that this process has used so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def live_digest(bag: Bag) -> str | None:
    """The digest that the run itself ended with, if the bag still lies in the run's folder.

    Raises:
        RunFolderError: the run's summary cannot be read.
    """
    path = bag.path.parent / run_folder.SUMMARY
    if not path.is_file():
        return None
    try:
        summary = read_json(path)
    except (OSError, ParseError) as error:
        raise RunFolderError(
            f'{path} cannot be read as JSON ({error}): move the bag elsewhere'
        ) from None
    digest = summary.get(DIGEST) if isinstance(summary, dict) else None
    return digest if isinstance(digest, str) else None


def _common(
    index: Index, data: Stretches, settings: Settings, fit: FitSettings, judged: Judgement | None
) -> dict[str, Any]:
    sources = sorted({f'{key.run_id}/{key.source}' for key, _ in index.episodes})
    unscored = sum(int(np.isnan(s.segments.values).sum()) for s in data.usable)
    return {
        'schedule': fit.schedule,
        'bags': [str(bag.path) for bag in index.bags],
        'runs': [run.run_id for _, run in index.runs],
        'task': settings.task,
        'method': settings.method,
        'delay': settings.delay,
        'settings': settings.model_dump(mode='json'),
        'fit': fit.model_dump(mode='json'),
        'data': {
            'bags': ', '.join(str(bag.path) for bag in index.bags),
            'sources': f'{len(sources)}: {", ".join(sources[:8])}'
            + (', ...' if len(sources) > 8 else ''),
            'observation size': index.observation_size,
            'action size': index.action_size,
            'episodes': len({(s.key, s.episode) for s in data.usable}),
            'steps': index.steps,
            'steps that no score covers': data.unscored,
            'scored segments': sum(len(s.segments.firsts) for s in data.usable) - unscored,
            **({'segments without a score': index.unscored} if index.unscored else {}),
        },
        'metrics': judged.metrics if judged else dict.fromkeys(MEASURES),
        'skipped': {name: n for name, n in data.skipped.items() if n},
        'notes': index.notes,
        'peak_rss_mb': peak_mb(),
    }


def of_phases(
    folded: Fold,
    index: Index,
    data: Stretches,
    own: Settings,
    fit: FitSettings,
    judged: Judgement | None,
    seconds: float,
    live: str | None,
) -> dict[str, Any]:
    """The summary of a fit that learnt as the run did."""
    report = folded.core.report()
    changed = {
        name: value for name, value in folded.settings.flat().items() if own.flat()[name] != value
    }
    summary = _common(index, data, folded.settings, fit, judged)
    summary['skipped'] |= {f'{topic} refused': n for topic, n in folded.refused.items()}
    return summary | {
        'run_id': folded.run.run_id,
        'changed_settings': changed,
        'phases': folded.phases,
        'phases_of_the_run': own.phases,
        'gradient_steps': report.gradient_steps or 0,
        'curve': [{'gradient_steps': n, 'loss': loss} for n, loss in folded.losses],
        'judged_on': 'on data that it was trained on',
        DIGEST: report.reward_model_sha256,
        'live_' + DIGEST: live,
        'recorded_labels': {'same': folded.recorded.same, 'other': folded.recorded.other},
        'wall_s': seconds,
    }


def of_epochs(
    fitted: Fitted,
    index: Index,
    data: Stretches,
    settings: Settings,
    fit: FitSettings,
    judged: Judgement,
) -> dict[str, Any]:
    """The summary of a fit on all of the data."""
    summary = _common(index, data, settings, fit, judged)
    held = fitted.held_out
    summary['data'] |= {
        'held out': f'{len(held.stretches)} of {len(data.usable)} stretches, '
        f'{held.memory.steps} steps, {len(held.memory.segments.ids())} segments',
        'steps held in memory at most': f'{fitted.most_steps} of memory_steps = '
        f'{settings.memory_steps}, {held.memory.bytes_per_step} bytes each',
        'times that the bags were read': 1 + fitted.reads,
    }
    return summary | {
        'gradient_steps': fitted.method.gradient_steps,
        'curve': [dataclasses.asdict(check) for check in fitted.curve],
        'best': dataclasses.asdict(fitted.best) if fitted.best else None,
        'stopped': fitted.stopped,
        'most_steps_held': fitted.most_steps,
        'target_scale': fitted.method.target_scale,
        'judged_on': 'on held-out episodes',
        DIGEST: checkpoints.digest(fitted.method.state()),
        'wall_s': fitted.seconds,
    }


def write(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write `summary.json` into the folder of a fit."""
    text = json.dumps(summary, indent=2) + '\n'
    atomic_write(folder / run_folder.SUMMARY, text)


def rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The main facts, for the page and for the terminal."""
    facts = [('gradient steps', str(summary['gradient_steps']))]
    if summary['schedule'] == 'phases':
        labels = summary['recorded_labels']
        facts += [
            ('phases', f'{summary["phases"]} of {summary["phases_of_the_run"]}'),
            (
                'labels in the bag',
                f'{labels["same"]} segments as made here, {labels["other"]} otherwise',
            ),
        ]
        if live := summary['live_' + DIGEST]:
            same = 'the same weights' if live == summary[DIGEST] else f'no, it ended with {live}'
            facts.append(('as the run itself', same))
    else:
        facts.append(('ended', summary['stopped']))
    metrics = summary['metrics']
    facts.append(('composite R²', _explained(metrics['composite_r2'], summary['judged_on'])))
    known = [
        f'{metrics[key]:.3f} ({name})'
        for name, key in (
            ('Pearson', 'pearson'),
            ('Pearson, within segments', 'within_pearson'),
            ('Spearman', 'spearman'),
        )
        if metrics[key] is not None
    ]
    judged = f'correlation with the true ones {", ".join(known)} {summary["judged_on"]}'
    none = 'cannot be judged: no true ones are known'
    facts.append(('step rewards', judged if known else none))
    skipped = sum(summary['skipped'].values())
    what = f': {", ".join(f"{n} {name}" for name, n in summary["skipped"].items())}'
    return [
        *facts,
        ('skipped', f'{skipped}{what if skipped else ""}'),
        ('reward model sha256', str(summary[DIGEST])),
        ('time', f'{summary["wall_s"]:.1f} s'),
        ('peak memory', f'{summary["peak_rss_mb"]:.0f} MB'),
    ]


def _explained(r2: float | None, where: str) -> str:
    """The part of the variance of scores that a model explains, for people."""
    if r2 is None:
        return 'not known: the scores do not differ, or the method predicts none'
    if r2 >= 0:
        return f'{r2:.3f} {where}'
    amount = f'{r2:.3f}' if r2 > -WORST else f'below -{WORST}'
    return f'{amount} {where}: worse than their mean score would be'


def show(summary: Mapping[str, Any], folder: Path, console: Console) -> None:
    """Print the results of a fit."""
    console.print()
    for name, text in (*rows(summary), ('report', str(folder / run_folder.REPORT))):
        console.print(f'{name:<26}{text}', markup=False, soft_wrap=True)
