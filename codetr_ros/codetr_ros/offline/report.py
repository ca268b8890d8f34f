"""The report of a fit: one HTML page with its pictures."""

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codetr_ros.config import flatten
from codetr_ros.offline.judging import Judgement, Shown
from codetr_ros.offline.results import rows
from codetr_ros.offline.settings import OF_NO_EFFECT
from codetr_ros.runs import document
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.document import Block, Heading, Paragraph, Picture, facts
from codetr_ros.system.files import atomic_write

_TRUE, _INFERRED, _GREY = '#1f5fa8', '#b8561c', '#555'
_MOST_POINTS = 5000
"""The most points of a scatter plot; of more, every n-th is shown, as the caption states."""

Axes = Any  # matplotlib has no types


def title(summary: Mapping[str, Any]) -> str:
    """The fit in a line."""
    return (
        f'{summary["method"]} fitted to {summary["task"]}, {summary["delay"]} steps per score, '
        f'schedule {summary["schedule"]}'
    )


def write(folder: Path, summary: Mapping[str, Any], judged: Judgement | None) -> None:
    """Write the page into the folder of a fit."""
    atomic_write(folder / run_folder.REPORT, page(summary, judged))


def page(summary: Mapping[str, Any], judged: Judgement | None) -> str:
    """The HTML page, with everything in it."""
    blocks: list[Block] = [Heading(title(summary), 1), facts(rows(summary))]
    if summary['curve']:
        blocks += [Heading('Training'), Picture(draw_curve(summary), 'training curve')]
    if judged is not None:
        blocks += _judged(summary, judged)
    skipped = summary['skipped']
    settings = [
        *((f'fit: {name}', value) for name, value in summary['fit'].items()),
        *(
            (name, value)
            for name, value in flatten(summary['settings'])
            if name.partition('.')[0] not in OF_NO_EFFECT
        ),
    ]
    blocks += [
        Heading('Skipped'),
        facts(skipped) if skipped else Paragraph('nothing'),
        *(Paragraph(note) for note in summary.get('notes', ())),
        Heading('Data'),
        facts(summary['data']),
        Heading('Settings'),
        facts(settings),
    ]
    return document.page(blocks)


def _judged(summary: Mapping[str, Any], judged: Judgement) -> list[Block]:
    what = summary['judged_on']
    blocks: list[Block] = [Heading(f'Composite rewards: predicted and true, {what}')]
    if judged.predicted is not None:
        picture = draw_composites(judged)
        blocks.append(Picture(picture, 'predicted and true composite rewards'))
    else:
        blocks.append(Paragraph('This method predicts no composite rewards.'))
    blocks.append(Heading(f'Step rewards: inferred and true, {what}'))
    if len(judged.true):
        blocks.append(Picture(draw_steps(judged), 'inferred and true step rewards'))
    else:
        blocks.append(Paragraph('The bags hold no true step rewards of these segments.'))
    bars = (
        ' The bars are the attention weights w, which are 1 on average: how much each step '
        'counts for the score.'
    )
    weights = any(shown.weights is not None for shown in judged.shown)
    return [
        *blocks,
        Heading('Some segments, step by step'),
        Paragraph(
            f'From the lowest to the highest score, evenly chosen.{bars if weights else ""}'
        ),
        Picture(draw_segments(judged.shown), 'segments step by step'),
    ]


def _png(size: tuple[float, float], draw: Callable[[Any], None]) -> bytes:
    # Without pyplot there is no display, and no state that outlives the picture.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    draw(figure)
    picture = io.BytesIO()
    figure.savefig(picture, format='png')
    return picture.getvalue()


def draw_curve(summary: Mapping[str, Any]) -> bytes:
    """Losses against gradient steps, as a PNG."""
    curve = summary['curve']

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        axes.set_xlabel('gradient steps')
        axes.set_ylabel('mean squared error\n(in units of c², the scale of scores)')
        axes.set_yscale('log')
        axes.grid(alpha=0.3)
        for name, label, colour in (
            ('loss', 'training', _TRUE),
            ('held_out_loss', 'held out', _INFERRED),
        ):
            known = [row for row in curve if row.get(name) is not None]
            if known:
                steps = [row['gradient_steps'] for row in known]
                axes.plot(
                    steps,
                    [row[name] for row in known],
                    'o-',
                    markersize=3,
                    color=colour,
                    label=label,
                )
        best = summary.get('best')
        if best:
            axes.axvline(
                best['gradient_steps'], color=_GREY, ls='--', lw=1, label='best: the weights kept'
            )
        axes.legend(fontsize=8, framealpha=0.8)

    return _png((8, 3.5), draw)


def draw_composites(judged: Judgement) -> bytes:
    """Predicted against true composite rewards, as a PNG."""
    assert judged.predicted is not None
    predicted = judged.predicted
    r2 = judged.metrics['composite_r2']

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        caption = 'R² not defined' if r2 is None else f'R² {r2:.3f}'
        _scatter(axes, judged.values, predicted, caption)
        axes.set_xlabel('true composite reward of a segment')
        axes.set_ylabel('predicted')
        low, high = float(judged.values.min()), float(judged.values.max())
        axes.plot([low, high], [low, high], color=_GREY, ls='--', lw=1)

    return _png((5, 4.5), draw)


def draw_steps(judged: Judgement) -> bytes:
    """Inferred against true step rewards, as a PNG."""
    correlations = [
        f'{name.replace("_", " ")} {judged.metrics[name]:.3f}'
        for name in ('pearson', 'spearman', 'within_pearson')
        if judged.metrics[name] is not None
    ]

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        _scatter(axes, judged.true, judged.labels, ', '.join(correlations) or 'no variance')
        axes.set_xlabel('true step reward')
        axes.set_ylabel('inferred step reward')

    return _png((5, 4.5), draw)


def _scatter(axes: Axes, x: Any, y: Any, caption: str) -> None:
    every = -(-len(x) // _MOST_POINTS)
    shown = '' if every == 1 else f', one of {every} points shown'
    axes.scatter(x[::every], y[::every], s=6, alpha=0.4, color=_TRUE, lw=0)
    axes.set_title(f'{caption}{shown}', fontsize=10)
    axes.grid(alpha=0.3)


def draw_segments(segments: Sequence[Shown]) -> bytes:
    """Labels, true rewards and attention weights over the steps of some segments, as a PNG."""
    columns = min(2, len(segments))
    lines = -(-len(segments) // columns)

    def draw(figure: Any) -> None:
        grid = figure.subplots(lines, columns, squeeze=False)
        for axes, one in zip(grid.flat, segments, strict=False):
            _segment(axes, one)
        for axes in grid.flat[len(segments) :]:
            axes.set_axis_off()
        drawn = dict(
            pair
            for axes in figure.axes
            for pair in zip(*reversed(axes.get_legend_handles_labels()), strict=True)
        )
        figure.legend(
            drawn.values(), drawn.keys(), loc='outside upper center', ncols=3, fontsize=8
        )

    return _png((9, 2.3 * lines + 0.4), draw)


def _segment(axes: Axes, one: Shown) -> None:
    steps = one.first + np.arange(len(one.labels))
    predicted = '' if one.predicted is None else f', predicted {one.predicted:.4g}'
    axes.set_title(
        f'{one.source}, episode {one.episode}: score {one.value:.4g}{predicted}', fontsize=8
    )
    axes.tick_params(labelsize=7)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel('step of the episode', fontsize=7)
    if one.weights is not None:
        behind = axes.twinx()
        behind.bar(steps, one.weights, width=0.9, color='#ccc', label='attention weight w (right)')
        behind.set_ylim(0, 1.05 * max(1.0, float(one.weights.max())))
        behind.tick_params(labelsize=7)
        axes.set_zorder(behind.get_zorder() + 1)
        axes.patch.set_visible(False)
    axes.plot(steps, one.labels, 'o-', markersize=3, color=_INFERRED, label='inferred step reward')
    if one.true is not None:
        axes.plot(steps, one.true, 'o-', markersize=3, color=_TRUE, label='true step reward')
