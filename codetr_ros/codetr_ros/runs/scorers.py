"""Who scored, where others than the simulator did: for the summary and the report."""

import math
import re
from collections.abc import Iterable, Iterator

from codetr_ros.runs.document import Block, Heading, Paragraph, Table
from codetr_ros.runs.numbers import number
from codetr_ros.runs.reports import PREFERENCES_UNUSED
from codetr_ros.runs.run_summary import RunSummary, ScorerRow

_NAME = re.compile('scorer_(.+)_(scores|preferences|offset|slope|noise|agreement)')
_COUNTED = ('scores', 'preferences')


def rows(metrics: Iterable[tuple[str, float]]) -> dict[str, ScorerRow]:
    """Who scored, by name.

    Args:
        metrics: names and values of the reward node's metrics, from the first phase to the last.
    """
    known: dict[str, dict[str, float | int | None]] = {}
    for name, value in metrics:
        if found := _NAME.fullmatch(name):
            counted = found[2] in _COUNTED
            shown = None if math.isnan(value) else int(value) if counted else value
            known.setdefault(found[1], {})[found[2]] = shown
    return {name: ScorerRow.model_validate(row) for name, row in sorted(known.items())}


def blocks(summary: RunSummary) -> Iterator[Block]:
    """The part of a report about who scored; nothing where the simulator did."""
    if not summary.scorers:
        return
    yield Heading('Who scored')
    yield Paragraph(
        'A score of each is its offset plus its slope times the worth of the segment, on the '
        'scale of the first scorer. Agreement is the correlation with the mean of the others on '
        'shared segments. Counts are of what the memory held at the end.'
    )
    unused = sum(counts.get(PREFERENCES_UNUSED, 0) for counts in summary.counters.values())
    if unused:
        yield Paragraph(f'{unused} {PREFERENCES_UNUSED}: method {summary.settings["method"]}.')
    head = ['scorer', 'scores', 'preferences', 'offset', 'slope', 'noise', 'agreement']

    def shown(value: float | None) -> str:
        return 'not known' if value is None else number(value)

    yield Table(
        head,
        [
            [
                name,
                str(row.scores),
                str(row.preferences),
                *(shown(v) for v in (row.offset, row.slope, row.noise, row.agreement)),
            ]
            for name, row in summary.scorers.items()
        ],
    )
