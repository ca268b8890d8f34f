"""What a fit leaves behind: its folder, its summary, what it says at the end."""

import json
import resource
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from codetr_ros import run_folder
from codetr_ros.config import Settings
from codetr_ros.offline.phases import Fold
from codetr_ros.offline.standin import Bag
from codetr_ros.run_folder import RunFolderError

DIGEST = 'reward_model_sha256'


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
    """The most memory that this process has had so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def live_digest(bag: Bag) -> str | None:
    """The digest that the run itself ended with, where the bag still lies in the run's folder."""
    path = bag.path.parent / run_folder.SUMMARY
    if not path.is_file():
        return None
    try:
        said = json.loads(path.read_text())
    except ValueError as error:
        raise RunFolderError(f'{path} is not JSON ({error}): move the bag elsewhere') from None
    found = said.get(DIGEST) if isinstance(said, dict) else None
    return found if isinstance(found, str) else None


def of_phases(found: Fold, bag: Bag, own: Settings, seconds: float) -> dict[str, Any]:
    """The summary of a fit that learnt as the run did."""
    report = found.core.report()
    changed = {
        name: value for name, value in found.settings.flat().items() if own.flat()[name] != value
    }
    return {
        'schedule': 'phases',
        'bags': [str(bag.path)],
        'run_id': found.run.run_id,
        'task': own.task,
        'method': found.settings.method,
        'settings': found.settings.model_dump(mode='json'),
        'changed_settings': changed,
        'phases': found.phases,
        'phases_of_the_run': own.phases,
        'gradient_steps': report.get('gradient_steps', 0),
        'curve': [{'gradient_steps': n, 'loss': loss} for n, loss in found.losses],
        DIGEST: report.get(DIGEST),
        'live_' + DIGEST: live_digest(bag),
        'recorded_labels': {'same': found.recorded.same, 'other': found.recorded.other},
        'skipped': {f'{topic} refused': n for topic, n in found.refused.items()},
        'wall_s': seconds,
        'peak_rss_mb': peak_mb(),
    }


def write(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write `summary.json` into the folder of a fit."""
    text = json.dumps(summary, indent=2) + '\n'
    run_folder.atomic_write(folder / run_folder.SUMMARY, text)


def rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The few facts that people look for first, for the page and for the terminal."""
    found = [('gradient steps', str(summary['gradient_steps']))]
    if summary['schedule'] == 'phases':
        found.append(('phases', f'{summary["phases"]} of {summary["phases_of_the_run"]}'))
        labels = summary['recorded_labels']
        found.append(
            (
                'recorded labels',
                f'{labels["same"]} segments the same, {labels["other"]} others',
            )
        )
        live = summary['live_' + DIGEST]
        if live:
            same = live == summary[DIGEST]
            found.append(
                ('as the run itself', 'the same weights' if same else f'no, it ended with {live}')
            )
    found.append(('reward model sha256', str(summary[DIGEST])))
    found += [(name, str(n)) for name, n in summary['skipped'].items()]
    found.append(('time', f'{summary["wall_s"]:.1f} s'))
    found.append(('peak memory', f'{summary["peak_rss_mb"]:.0f} MB'))
    return found


def show(summary: Mapping[str, Any], folder: Path, console: Console) -> None:
    """Print what came out of a fit."""
    console.print()
    for name, text in rows(summary):
        console.print(f'{name:<24}{text}', markup=False, soft_wrap=True)
    console.print(f'{"output":<24}{folder}', markup=False, soft_wrap=True)
