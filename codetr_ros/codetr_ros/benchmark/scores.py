"""The parts of a benchmark's report that hold scores and returns."""

from collections.abc import Sequence

import numpy as np

from codetr_ros.benchmark import paper
from codetr_ros.benchmark.anchors import Anchors
from codetr_ros.benchmark.statistics import CONFIDENCE, REPLICATES, SIGNIFICANCE
from codetr_ros.benchmark.table import ORACLES, TABLE_DELAYS, Aggregate, Entry, Row
from codetr_ros.runs.document import Block, Bold, Heading, Items, Paragraph, Table
from codetr_ros.runs.numbers import returns as returns_of

NONE = '–'
"""Shown where there is no value."""


def _number(value: float | None, digits: int) -> str:
    return NONE if value is None else f'{value:.{digits}f}'


def _score(entry: Entry, mean: float | None, spread: float | None, digits: int) -> str:
    done = len(entry.scores)
    failed = f', {entry.failed} failed' if entry.failed else ''
    lacking = f' [{done} of {entry.planned}{failed}]' if done < entry.planned else ''
    if mean is None:
        return f'no result{lacking}'
    around = f' ({spread:.{digits}f})' if spread is not None else ''
    return f'{mean:.{digits}f}{around}{lacking}'


def _line(row: Row, order: Sequence[str]) -> list[str | Bold]:
    cells: list[str | Bold] = [row.composite, _delays(row)]
    by_method = {entry.method: entry for entry in row.entries}
    for method in order:
        entry = by_method.get(method)
        if entry is None:
            cells.append(NONE)
            continue
        text = _score(entry, entry.mean, entry.spread, 4)
        cells.append(Bold(text) if entry.bold else text)
    return cells


def _delays(row: Row) -> str:
    delays = ', '.join(map(str, row.delays))
    return f'mean of {delays}' if len(row.delays) > 1 else delays


def own(together: Sequence[Row], alone: Sequence[Row], anchors: Anchors) -> list[Block]:
    """The scores of every delay, and their mean if there are several: a table for each task."""
    blocks: list[Block] = [Heading('Scores')]
    for task in dict.fromkeys(row.task for row in alone):
        rows = _rows(task, together, alone)
        order = _methods(rows)
        lines = [
            [*_line(row, order), *(_anchor(row, anchors, which) for which in _ANCHORS)]
            for row in rows
        ]
        head = ['composite', 'delay', *order, *_ANCHORS.values()]
        blocks += [Heading(task, 3), Table(head, lines)]
    return [*blocks, _reading(any(len(row.delays) > 1 for row in together))]


def _rows(task: str, together: Sequence[Row], alone: Sequence[Row]) -> list[Row]:
    """The rows of a task, by composite reward: each delay, then the mean if there are several."""
    mine = [row for row in (*alone, *together) if row.task == task]
    several = [row for row in together if row.task == task and len(row.delays) > 1]
    rows = []
    for composite in dict.fromkeys(row.composite for row in mine):
        rows += [row for row in alone if (row.task, row.composite) == (task, composite)]
        rows += [row for row in several if row.composite == composite]
    return rows


def _methods(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(entry.method for row in rows for entry in row.entries))


def beside_the_paper(in_span: Sequence[Row]) -> list[Block]:
    """Our scores beside the supplement's Table 2, for the tasks that it has; else nothing.

    Args:
        in_span: the rows over the delays of that table.
    """
    low, high = TABLE_DELAYS
    rows = [row for row in in_span if row.task in paper.TASKS and row.composite in paper.TABLE_2]
    if not rows:
        return []
    order = _methods(rows)
    lines: list[list[str | Bold]] = []
    for row in rows:
        lines += [_line(row, order), _paper_line(row.composite, order)]
    return [
        Heading("Beside the paper's Table 2"),
        Paragraph(
            f'Ant-v2 there, {", ".join(paper.TASKS)} here. Mean over delays from {low} to {high}; '
            'that a cell of the paper is such a mean is inferred. There: 3 trials, a million '
            'steps.'
        ),
        Table(['composite', 'delays', *order], lines),
    ]


def _paper_line(composite: str, order: Sequence[str]) -> list[str | Bold]:
    cells: list[str | Bold] = ['... in the paper', '25 to 200']
    for method in order:
        number = paper.TABLE_2[composite].get(method)
        cells.append(f'{number[0]:.4f} ({number[1]:.4f})' if number else NONE)
    return cells


_ANCHORS = {'random': 'random policy', 'zero': 'standing still'}


def _anchor(row: Row, anchors: Anchors, which: str) -> str:
    scores = [anchors[row.task, row.composite, d][which]['score_mean'] for d in row.delays]
    return f'{np.mean(scores):.4f}'


def _reading(several: bool) -> Block:
    means = ['A row of several delays is the mean over them and over seeds.'] if several else []
    return Items(
        [
            *means,
            'In brackets: sample standard deviation over seeds; nothing if there is one seed.',
            'Bold (* in a terminal): the highest mean, and all that do not differ from it by a '
            f'paired t-test at {SIGNIFICANCE:.0%} over pairs of seed and delay. Few pairs show '
            'few differences. With fewer than two pairs no test is possible: then only the '
            'highest mean is bold.',
            f'{", ".join(ORACLES)} sees the rewards that no other method may see: it is never '
            'marked as best, nor compared.',
            '[n of m, k failed]: only n of m cells have finished; the mean is over those, whose '
            'delays and seeds may differ from those of other entries.',
            'random policy, standing still: a uniformly random policy, and the action 0. A method '
            'that does not beat both has learnt nothing that counts.',
        ]
    )


def returns(together: Sequence[Row], alone: Sequence[Row]) -> list[Block]:
    """True returns: the sum of the task's own rewards over an episode."""
    blocks: list[Block] = [
        Heading('True returns'),
        Paragraph(
            "The task's own rewards, summed over an episode: mean, and in brackets the spread "
            'over seeds as above.'
        ),
    ]
    for task in dict.fromkeys(row.task for row in alone):
        rows = _rows(task, together, alone)
        order = _methods(rows)
        digits = _return_digits([e.return_mean for row in rows for e in row.entries])
        lines: list[list[str | Bold]] = []
        for row in rows:
            by_method = {entry.method: entry for entry in row.entries}
            line: list[str | Bold] = [row.composite, _delays(row)]
            for method in order:
                e = by_method.get(method)
                line.append(_score(e, e.return_mean, e.return_spread, digits) if e else NONE)
            lines.append(line)
        blocks += [Heading(task, 3), Table(['composite', 'delay', *order], lines)]
    return blocks


def _return_digits(means: Sequence[float | None]) -> int:
    """Decimals of the returns of a task."""
    return 1 if max((abs(mean) for mean in means if mean is not None), default=0.0) >= 10 else 3


def interquartile(aggregates: Sequence[Aggregate], together: Sequence[Row]) -> list[Block]:
    """Interquartile means with their intervals."""
    lines: list[list[str | Bold]] = []
    for row in together:
        for entry in row.entries:
            lines.append(
                [
                    row.task,
                    row.composite,
                    ', '.join(map(str, row.delays)),
                    entry.method,
                    _number(entry.iqm, 4),
                    _interval(entry.interval),
                    str(len(entry.scores)),
                ]
            )
    for each in aggregates:
        if len(each.composites) > 1:
            lines.append(
                [
                    each.task,
                    'all',
                    'all',
                    each.method,
                    f'{each.iqm:.4f}',
                    _interval(each.interval),
                    str(each.cells),
                ]
            )
    if not lines:
        return []
    return [
        Heading('Interquartile means of scores'),
        Paragraph(
            f'Mean of the middle half of the scores, with {CONFIDENCE:.0%} percentile intervals '
            f'of a stratified bootstrap ({REPLICATES} draws; strata are composite reward and '
            'delay, seeds are drawn within). With three seeds such an interval is rough.'
        ),
        Table(['task', 'composite', 'delays', 'method', 'IQM', 'interval', 'cells'], lines),
    ]


def _interval(interval: tuple[float, float] | None) -> str:
    return NONE if interval is None else f'{interval[0]:.4f} to {interval[1]:.4f}'


def anchors(known: Anchors) -> list[Block]:
    """Trivial policies."""
    lines: list[list[str | Bold]] = [
        [
            task,
            composite,
            str(delay),
            *(f'{by[policy]["score_mean"]:.4f}' for policy in ('random', 'zero')),
            *returns_of(*(by[policy]['true_return_mean'] for policy in ('random', 'zero'))),
        ]
        for (task, composite, delay), by in known.items()
    ]
    head = ['task', 'composite', 'delay', 'random policy: score', 'standing still: score']
    return [
        Heading('Trivial anchors'),
        Paragraph(
            'A uniformly random policy, and one that stands still (action 0). A method that does '
            'not beat both has learnt nothing that counts.'
        ),
        Table([*head, 'random policy: return', 'standing still: return'], lines),
    ]
