"""The report of a fit: one HTML page with its pictures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codetr_ros.config import flatten
from codetr_ros.offline.episodes import UNKNOWN_TASK
from codetr_ros.offline.judging import Judgement
from codetr_ros.offline.results import rows
from codetr_ros.offline.settings import OF_NO_EFFECT
from codetr_ros.runs import document, pictures
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.document import Block, Folded, Gallery, Heading, Paragraph, Picture, facts
from codetr_ros.runs.pictures import Figure
from codetr_ros.runs.report_origin import own_settings, setting
from codetr_ros.system.files import atomic_write

_SQUARE = (4.4, 3.9)


def title(summary: Mapping[str, Any]) -> str:
    """The fit in a line."""
    return (
        f'{summary["method"]} fitted to {_data(summary)}, {summary["delay"]} steps per score, '
        f'schedule {summary["schedule"]}'
    )


def _data(summary: Mapping[str, Any]) -> str:
    """The task; where no bag names one, the bags."""
    if summary['task'] != UNKNOWN_TASK:
        return str(summary['task'])
    names = [Path(bag).name for bag in summary['bags']]
    more = f' and {len(names) - 2} more' if len(names) > 3 else ''
    return (
        f'the {"bag" if len(names) == 1 else "bags"} {", ".join(names[: 2 if more else 3])}{more}'
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
            (name, setting(value))
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
        *own_settings(summary['settings'], OF_NO_EFFECT),
        Folded(f'All {len(settings)} settings', [facts(settings)]),
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
        Gallery([Picture(pictures.segment(one), 'a segment') for one in judged.shown]),
    ]


def draw_curve(summary: Mapping[str, Any]) -> bytes:
    """Losses against gradient steps, as a PNG."""
    curve = summary['curve']

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_xlabel('gradient steps')
        axes.set_ylabel('mean squared error\n(in units of c², the scale of scores)')
        axes.set_yscale('log')
        for name, label, colour in (
            ('loss', 'training', pictures.TRUE),
            ('held_out_loss', 'held out', pictures.INFERRED),
        ):
            known = [row for row in curve if row.get(name) is not None]
            points = [(row['gradient_steps'], row[name]) for row in known]
            pictures.line(axes, points, label, colour)
        best = summary.get('best')
        if best:
            axes.axvline(
                best['gradient_steps'],
                color=pictures.GREY,
                ls='--',
                lw=1,
                label='best: the weights kept',
            )
        pictures.plain(axes)
        axes.legend(fontsize=8, framealpha=0.8)

    return pictures.png((pictures.WIDE, 3.2), draw)


def draw_composites(judged: Judgement) -> bytes:
    """Predicted against true composite rewards, as a PNG."""
    assert judged.predicted is not None
    predicted = judged.predicted
    r2 = judged.metrics['composite_r2']

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        low, high = float(judged.values.min()), float(judged.values.max())
        axes.plot([low, high], [low, high], color=pictures.GREY, ls='--', lw=1)
        caption = 'R² not defined' if r2 is None else f'R² {r2:.3f}'
        pictures.scatter(axes, judged.values, predicted, caption)
        axes.set_xlabel('true composite reward of a segment')
        axes.set_ylabel('predicted')

    return pictures.png(_SQUARE, draw)


def draw_steps(judged: Judgement) -> bytes:
    """Inferred against true step rewards, as a PNG."""
    correlations = [
        f'{name.replace("_", " ")} {judged.metrics[name]:.3f}'
        for name in ('pearson', 'spearman', 'within_pearson')
        if judged.metrics[name] is not None
    ]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        caption = ', '.join(correlations) or 'no variance'
        pictures.scatter(axes, judged.true, judged.labels, caption)
        axes.set_xlabel('true step reward')
        axes.set_ylabel('inferred step reward')

    return pictures.png(_SQUARE, draw)
