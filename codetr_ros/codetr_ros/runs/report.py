"""The report of a run for people: a picture of the learning curve and one HTML page."""

import io
import math
from collections.abc import Sequence
from pathlib import Path

from codetr_ros.config import flatten
from codetr_ros.runs import document
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.document import Block, Heading, Paragraph, Picture, facts, records
from codetr_ros.runs.run_summary import RunSummary
from codetr_ros.system.files import atomic_write

_TRUE, _SCORE = '#1f5fa8', '#b8561c'


def title(summary: RunSummary) -> str:
    """Names the run in a line."""
    s = summary
    what = f'{s.task}, {s.composite} of {s.delay} steps, {s.method}, seed {s.seed}'
    return what + (' (interrupted)' if s.interrupted else '')


def draw(summary: RunSummary) -> bytes:
    """The learning curve as a PNG: true return and score of each evaluation against steps.

    The bands show the spread over an evaluation's episodes: worst to best for the true return, one
    standard deviation for the score. The dashed lines are the random policy.
    """
    # Without pyplot: no display, no state that outlives the picture, half the import time.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, random = summary.evaluations, summary.random
    figure = Figure(figsize=(8, 6), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(title(summary), fontsize=11)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    upper.set_ylabel('true return of an episode')
    lower.set_ylabel('score\n(composite return / perfect)')
    lower.set_xlabel('environment steps')
    lower.set_xlim(0, summary.steps_planned)

    def column(name: str) -> list[float]:
        values = [getattr(row, name) for row in rows]
        return [math.nan if value is None else value for value in values]

    score, std = column('score_mean'), column('score_std')
    for axes, colour, mean, low, high, name in (
        (
            upper,
            _TRUE,
            column('true_return_mean'),
            column('true_return_min'),
            column('true_return_max'),
            'true_return_mean',
        ),
        (
            lower,
            _SCORE,
            score,
            [m - s for m, s in zip(score, std, strict=True)],
            [m + s for m, s in zip(score, std, strict=True)],
            'score_mean',
        ),
    ):
        axes.grid(alpha=0.3)
        if rows:
            steps = column('step')
            spread = 'worst to best' if axes is upper else 'standard deviation'
            axes.fill_between(steps, low, high, color=colour, alpha=0.15, lw=0, label=spread)
            axes.plot(steps, mean, 'o-', color=colour, markersize=4, label='mean')
        else:
            axes.text(0.5, 0.5, 'no evaluation', transform=axes.transAxes, ha='center')
        if random:
            axes.axhline(getattr(random, name), color='#555', ls='--', lw=1, label='random policy')
        if rows or random:
            axes.legend(loc='best', fontsize=8, framealpha=0.8)
    picture = io.BytesIO()
    figure.savefig(picture, format='png')
    return picture.getvalue()


def page(summary: RunSummary, picture: bytes) -> str:
    """The HTML page, with everything in it."""
    identity = {
        name: getattr(summary, name)
        for name in ('run_id', 'policy_sha256', 'reward_model_sha256', 'settings_hash')
    }
    versions = {f'version of {name}': value for name, value in summary.versions.items()}
    processes = [{'process': n, **row.model_dump()} for n, row in summary.processes.items()]
    messages = [{'topic': topic, **row.model_dump()} for topic, row in summary.messages.items()]
    blocks: list[Block] = [
        Heading(title(summary), 1),
        *([Paragraph(summary.failure, bad=True)] if summary.failure else []),
        Picture(picture, 'learning curve'),
        Heading('Result'),
        facts(result_rows(summary)),
        Paragraph(
            'The score is the composite return of an episode over that of an agent that earns the '
            "task's largest reward at every step."
        ),
        Heading('Evaluations'),
        records([row.model_dump() for row in summary.evaluated()]),
        Heading('Messages'),
        records(messages),
        Heading('Processes'),
        records(processes),
        Heading('Settings'),
        facts(list(flatten(summary.settings))),
        Heading('Identity'),
        facts(identity | versions),
    ]
    return document.page(blocks)


def result_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """The few numbers that people look for first, for the page and the terminal."""

    def number(value: float | None, form: str) -> str:
        return 'not evaluated' if value is None else format(value, form)

    last = summary.evaluations[-1] if summary.evaluations else None
    spread = f' +- {last.true_return_std:.1f}' if last and last.true_return_std is not None else ''
    after = f' after {last.step} steps' if last else ''
    return [
        ('score', f'{number(summary.final_score, ".3f")}{after}'),
        ('score of the random policy', number(summary.random_score, '.3f')),
        ('true return', f'{number(summary.final_true_return, ".1f")}{spread}'),
        ('true return of the random policy', number(summary.random_true_return, '.1f')),
        ('reward recovery', _recovery(summary)),
        ('steps', f'{summary.steps} of {summary.steps_planned}'),
        ('phases', f'{summary.phases} of {summary.phases_planned}'),
        ('time', f'{summary.wall_s:.1f} s, {summary.steps_per_s or 0:.0f} steps per second'),
        (
            'messages',
            f'{sum(row.published for row in summary.messages.values())} published, '
            f'{summary.lost} lost, {summary.duplicated} duplicated, {summary.refused} refused',
        ),
    ]


def _recovery(summary: RunSummary) -> str:
    """The agreement of step rewards with the true ones at the last comparison."""
    rows, evaluations = summary.reward_recovery, summary.evaluations
    if not rows:
        return 'no labels were compared'
    last = rows[-1]
    values = {'correlation': last.pearson, 'within segments': last.within}
    shown = [f'{name} {value:.2f}' for name, value in values.items() if value is not None]
    late = bool(evaluations) and evaluations[-1].step != last.step
    after = f', after {last.step} steps' if late else ''
    return (', '.join(shown) or 'not defined where one side does not vary') + after


_BARS = ' ▁▂▃▄▅▆▇█'


def sketch(values: Sequence[float], encoding: str | None) -> str:
    """A learning curve in a line of text: one bar for each value, the highest full."""
    bars = _BARS
    try:
        bars.encode(encoding or 'ascii')
    except (UnicodeEncodeError, LookupError):
        bars = ' .:-=+*#@'
    low, high = min(values), max(values)
    top = len(bars) - 1
    if high == low:
        return bars[1] * len(values)
    return ''.join(bars[1 + round((v - low) / (high - low) * (top - 1))] for v in values)


def write(folder: Path, summary: RunSummary) -> None:
    """Write the picture and the page into a run's folder."""
    picture = draw(summary)
    atomic_write(folder / run_folder.PICTURE, picture)
    atomic_write(folder / run_folder.REPORT, page(summary, picture))
