"""The standings of methods as tables, for the report of a benchmark."""

from collections.abc import Sequence

from codetr_ros.benchmark.standings import (
    MEASURES,
    REACHED,
    REFERENCES,
    Difference,
    Middle,
    Place,
    Standing,
)
from codetr_ros.benchmark.statistics import CONFIDENCE
from codetr_ros.config import delay_in_words
from codetr_ros.runs.document import Block, Bold, Heading, Items, Paragraph, Table

NONE = '–'
"""Shown where there is no value."""
HEAD = (
    'method',
    'seeds',
    'true return',
    'of the way',
    'score',
    'credit within',
    'CPU s',
    f'CPU s to {REACHED:.0%}',
)


def blocks(rows: Sequence[Standing]) -> list[Block]:
    """The section of a report: two tables for each task, composite reward and delay."""
    made: list[Block] = [
        Heading('Standings'),
        Paragraph(
            'The last evaluation: mean of the middle half of the seeds, and its '
            f'{CONFIDENCE:.0%} bootstrap interval; with few seeds that is rough.'
        ),
    ]
    for place in dict.fromkeys(row.place for row in rows):
        mine = [row for row in rows if row.place == place]
        made += [Heading(title(place), 3), Table(HEAD, lines(mine)), *tests(mine)]
    return [*made, Items(READING)]


READING = (
    'of the way: how far the true return has come from the better of the trivial policies '
    '(random, standing still) to the oracle; below 0 it is worse than that policy.',
    "credit within: correlation of labels and true step rewards, each segment's mean removed; "
    'mean of the seeds.',
    'CPU s: processor time of a run until its last evaluation, evaluations included, median of '
    f'the seeds. CPU s to {REACHED:.0%}: until the first evaluation that has come so much of the '
    'way, of the seeds that came there, their number in brackets; no time unless more than half '
    'did.',
    'Differences are paired by seed. p: t-test; by Holm: corrected for all tests of this report '
    'with the same reference and measure. A small p says that there is a difference, a large one '
    'does not say that there is none.',
)


def title(place: Place) -> str:
    """A place in words."""
    task, composite, delay = place
    return f'{task}: {composite} of {delay_in_words(delay)}'


def lines(rows: Sequence[Standing]) -> list[list[str | Bold]]:
    """The rows of a table with `HEAD`, of one place."""
    digits = _decimals(rows)
    return [
        [
            row.method,
            str(row.seeds) if row.seeds == row.planned else f'{row.seeds} of {row.planned}',
            _middle(row.returns, digits),
            NONE if row.share is None else f'{row.share:.2f}',
            _middle(row.scores, 4),
            NONE if row.within is None else f'{row.within:.2f}',
            NONE if row.cpu_s is None else f'{row.cpu_s:.0f}',
            _price(row),
        ]
        for row in rows
    ]


def tests(rows: Sequence[Standing]) -> list[Block]:
    """The paired tests of one place: a table for each reference that it has."""
    made: list[Block] = []
    for reference in REFERENCES:
        tested = [row for row in rows if (reference, MEASURES[0]) in row.against]
        if tested:
            head = [f'less `{reference}`', 'pairs', 'return', 'p', 'by Holm']
            head += ['score', 'p', 'by Holm']
            made.append(Table(head, [_test(row, reference, _decimals(rows)) for row in tested]))
    return made


def _test(row: Standing, reference: str, digits: int) -> list[str | Bold]:
    by_return = row.against[reference, 'true_return']
    by_score = row.against.get((reference, 'score'))
    line: list[str | Bold] = [row.method, str(by_return.pairs), *_ps(by_return, digits)]
    return [*line, *(_ps(by_score, 4) if by_score else [NONE] * 3)]


def _ps(of: Difference, digits: int) -> list[str]:
    return [f'{of.mean:.{digits}f}', p_value(of.p), p_value(of.corrected)]


def p_value(p: float | None) -> str:
    """A p-value for people."""
    return NONE if p is None else '< 0.001' if p < 0.001 else f'{p:.3f}'


def _decimals(rows: Sequence[Standing]) -> int:
    """Decimals of the returns of a place."""
    return 1 if max((abs(row.returns.iqm) for row in rows if row.returns), default=0) >= 10 else 3


def _middle(of: Middle | None, digits: int) -> str:
    if of is None:
        return NONE
    return f'{of.iqm:.{digits}f} ({of.low:.{digits}f} to {of.high:.{digits}f})'


def _price(row: Standing) -> str:
    if row.reached is None:
        return NONE
    time = NONE if row.cpu_s_to is None else f'{row.cpu_s_to:.0f}'
    return f'{time} ({row.reached})'
