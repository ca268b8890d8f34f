"""The report of a run for people: a picture of the learning curve and one HTML page.

Everything comes from the run's folder: `summary.json`, and `metrics.csv`, `step_rewards.csv`,
`film.png` and `film.mp4` where they are.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from codetr_ros.runs import course, document, pictures, references, scorers, segments
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.document import (
    Block,
    Gallery,
    Heading,
    Paragraph,
    Picture,
    Table,
    Video,
    facts,
)
from codetr_ros.runs.numbers import column
from codetr_ros.runs.report_origin import FILES, details, origin
from codetr_ros.runs.report_text import (
    evaluations_missing,
    learnt,
    recovery_text,
    result_rows,
    scale_text,
    sketch,
    title,
)
from codetr_ros.runs.run_summary import GivenScores, RunSummary
from codetr_ros.runs.segments import Segment
from codetr_ros.system.files import atomic_write

__all__ = ['Material', 'draw', 'page', 'result_rows', 'sketch', 'title', 'write']

_SCORE = '#b8561c'
_SCORE_IS = (
    'The score is the composite return of an episode over that of an agent that earns the '
    "task's largest reward at every step."
)


@dataclass(frozen=True, kw_only=True)
class Material:
    """What a page shows beside the summary.

    Attributes:
        columns: of `metrics.csv`.
        segments: some, step by step.
        film: a picture of the robot under its policies; None if there is none.
        video: the robot under these policies, moving; None if there is none.
        film_note: what to know about it, or why there is none.
        files: those of the run's folder, each with what it is.
        notes: what could not be read.
    """

    columns: dict[str, course.Points] = field(default_factory=dict)
    segments: Sequence[Segment] = ()
    film: bytes | None = None
    video: bytes | None = None
    film_note: str = ''
    files: Sequence[tuple[str, str]] = ()
    notes: Sequence[str] = ()


def draw(summary: RunSummary) -> bytes:
    """The learning curve as a PNG: true return and score of each evaluation against steps.

    It begins at step 0 with the random policy, which the dashed lines repeat. The bands show the
    spread over an evaluation's episodes: worst to best for the true return, one standard deviation
    for the score. Where nothing was evaluated, and others than the simulator scored, their scores
    by phase.
    """
    rows = summary.evaluated()
    if not rows and summary.scores_given:
        return given(summary.scores_given, title(summary))
    steps = [row.step for row in rows]

    def numbers(name: str) -> list[float]:
        values = [getattr(row, name) for row in rows]
        return [math.nan if value is None else value for value in values]

    score, std = numbers('score_mean'), numbers('score_std')
    low = [m - s for m, s in zip(score, std, strict=True)]
    high = [m + s for m, s in zip(score, std, strict=True)]
    worst, best = numbers('true_return_min'), numbers('true_return_max')

    def curve(
        axes: Any, name: str, colour: str, lower: list[float], upper: list[float], spread: str
    ) -> None:
        if rows:
            axes.fill_between(steps, lower, upper, color=colour, alpha=0.15, lw=0, label=spread)
            points = list(zip(steps, numbers(name), strict=True))
            pictures.line(axes, points, 'mean', colour)
        else:
            axes.text(0.5, 0.5, 'no evaluation', transform=axes.transAxes, ha='center')
        if summary.random:
            value = getattr(summary.random, name)
            axes.axhline(value, color=pictures.GREY, ls='--', lw=1, label='random policy')
        if rows:
            axes.legend(loc='best', fontsize=8, framealpha=0.8)
        pictures.plain(axes)

    def both(figure: Any) -> None:
        figure.suptitle(title(summary), fontsize=10)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        above.set_ylabel('true return of an episode')
        below.set_ylabel('score\n(1: perfect)')
        below.set_xlabel('environment steps')
        below.set_xlim(0, summary.steps_planned)
        if beside := references.of(summary.settings):
            for other, style in zip(beside.curves, ('-.', ':'), strict=False):
                label = f'{other.label} ({other.seeds} seeds, recorded)'
                above.plot(
                    other.steps, other.mean, style, color=pictures.GREY, lw=1.4, label=label
                )
                above.fill_between(
                    other.steps, other.low, other.high, color=pictures.GREY, alpha=0.08, lw=0
                )
        curve(above, 'true_return_mean', pictures.TRUE, worst, best, 'worst to best')
        curve(below, 'score_mean', _SCORE, low, high, 'standard deviation')

    return pictures.png((pictures.WIDE, 4.8), both)


def given(rows: Sequence[GivenScores], heading: str | None = None) -> bytes:
    """The scores that others than the simulator gave, by phase, as a PNG."""

    def points(of: Sequence[GivenScores]) -> list[tuple[float, float]]:
        return [(row.phase + 1.0, row.per_step) for row in of]

    def one(figure: Any) -> None:
        if heading:
            figure.suptitle(heading, fontsize=10)
        axes = figure.subplots()
        begin = sum(row.random for row in rows)
        pictures.line(axes, points(rows[: begin + 1]), 'random policy', pictures.GREY)
        pictures.line(axes, points(rows[begin:]), 'learnt policy', pictures.INFERRED)
        axes.set_xlabel('phase')
        axes.set_ylabel('mean score given per step')
        axes.legend(frameon=False)
        pictures.plain(axes)

    return pictures.png((pictures.WIDE, 3.4), one)


def page(summary: RunSummary, picture: bytes, material: Material | None = None) -> str:
    """The HTML page, with everything in it.

    Args:
        summary: of the run.
        picture: the learning curve.
        material: what else to show; None: nothing.
    """
    shown = material or Material()
    blocks: list[Block] = [
        Heading(title(summary), 1),
        *([Paragraph(summary.failure, bad=True)] if summary.failure else []),
        *([Paragraph(text, bad=True)] if (text := evaluations_missing(summary)) else []),
        *([Paragraph(text)] if (text := learnt(summary)) else []),
        Picture(picture, 'learning curve'),
        Heading('Result'),
        facts(result_rows(summary)),
        *([Paragraph(_SCORE_IS)] if summary.evaluated() else []),
        *_film(shown),
        *([Heading('Evaluations'), _evaluations(summary)] if summary.evaluated() else []),
        *scorers.blocks(summary),
        *_recovery(summary, shown.segments),
        *_training(summary, shown.columns),
        *origin(summary, shown.files),
        *(Paragraph(note, bad=True) for note in shown.notes),
        *details(summary),
    ]
    return document.page(blocks)


def _film(given: Material) -> Iterator[Block]:
    if given.film is None and not given.film_note:
        return
    yield Heading('The robot under the first, the middle and the last policy')
    if given.film is not None:
        yield Picture(given.film, 'frames of an episode of each policy')
    if given.video is not None:
        yield Video(given.video, 'the beginning of these episodes, side by side')
    if given.film_note:
        yield Paragraph(given.film_note)


def _evaluations(summary: RunSummary) -> Block:
    rows = summary.evaluated()
    returns = [
        *(row.true_return_mean for row in rows),
        *(row.true_return_std for row in rows),
        *(row.true_return_min for row in rows),
        *(row.true_return_max for row in rows),
    ]
    alike = column(returns)
    scores = column([*(row.score_mean for row in rows), *(row.score_std for row in rows)])
    columns = [
        [str(row.step) for row in rows],
        *(alike[i : i + len(rows)] for i in range(0, len(alike), len(rows))),
        scores[: len(rows)],
        scores[len(rows) :],
        column([row.length_mean for row in rows], most=1),
        [str(row.episodes) for row in rows],
    ]
    if summary.random:
        columns[0][0] = '0 (random policy)'
    head = ['after steps', 'true return', 'sd', 'worst', 'best', 'score', 'sd', 'length']
    return Table([*head, 'episodes'], list(zip(*columns, strict=True)))


def _recovery(summary: RunSummary, shown: Sequence[Segment]) -> Iterator[Block]:
    rows = summary.reward_recovery
    yield Heading('Reward recovery: inferred against true step rewards')
    if not rows:
        yield Paragraph('No labels were compared with true rewards in this run.')
        return
    yield Paragraph(recovery_text(rows))
    lines = {
        'inside segments': [(row.step, row.within) for row in rows if row.within is not None],
        'all steps': [(row.step, row.pearson) for row in rows if row.pearson is not None],
    }
    if any(lines.values()):
        panel = {'correlation with\ntrue step rewards': lines}
        yield Picture(
            pictures.curves(panel, end=summary.steps_planned, correlations=True), 'reward recovery'
        )
    if text := scale_text(summary):
        yield Paragraph(text)
    if shown:
        yield Heading('Some segments, step by step', 3)
        yield Paragraph(
            'From the lowest to the highest score in memory, evenly chosen, at the last '
            'evaluation. The policy learns from the orange line; nobody but this report sees the '
            'blue one.'
        )
        yield Gallery([Picture(pictures.segment(one), 'a segment') for one in shown])


def _training(summary: RunSummary, columns: dict[str, course.Points]) -> Iterator[Block]:
    returns = columns.get('training.true_return_mean', ())
    losses = course.losses(columns)
    if not returns and not losses:
        return
    panels = {'true return of\ntraining episodes': {'return': returns}} if returns else {}
    panels |= {name.replace(' of ', '\nof '): {name: points} for name, points in losses.items()}
    yield Heading('Training')
    yield Picture(pictures.curves(panels, end=summary.steps_planned), 'returns and losses')
    yield Paragraph(
        'Each point is the mean of a phase. Training episodes are those of the acting policy, '
        'with its noise; the first phases act at random.'
    )


def write(folder: Path, summary: RunSummary, film_note: str = '') -> None:
    """Write the picture and the page into a run's folder.

    Args:
        folder: the run's folder.
        summary: of the run.
        film_note: what to know about its film, or why it has none.
    """
    picture = draw(summary)
    atomic_write(folder / run_folder.PICTURE, picture)
    text = page(summary, picture, _material(folder, film_note))
    atomic_write(folder / run_folder.REPORT, text)


def _material(folder: Path, film_note: str) -> Material:
    columns: dict[str, course.Points] = {}
    shown: Sequence[Segment] = ()
    notes = []
    try:
        if (folder / run_folder.METRICS).is_file():
            columns = course.read(folder / run_folder.METRICS)
        if (folder / run_folder.STEP_REWARDS).is_file():
            shown = segments.read_csv(folder / run_folder.STEP_REWARDS)
    except run_folder.RunFolderError as error:
        notes.append(str(error))
    film, video = (folder / name for name in (run_folder.FILM, run_folder.FILM_VIDEO))
    return Material(
        columns=columns,
        segments=shown,
        film=film.read_bytes() if film.is_file() else None,
        video=video.read_bytes() if video.is_file() else None,
        film_note=film_note,
        files=[
            (name + '/' * (folder / name).is_dir(), what)
            for name, what in FILES
            if (folder / name).is_file() or any((folder / name).glob('*'))  # no empty folder
        ],
        notes=notes,
    )
