"""The course of a run: the numbers of its `metrics.csv` over training."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from codetr_ros.runs.folder import RunFolderError

Points = Sequence[tuple[float, float]]
"""Environment steps, and the value of a number then."""

LOSSES = (
    *('reward_loss', 'state_loss', 'history_loss', 'meta_gradient_norm'),
    *('critic_loss', 'extrinsic_value_loss', 'actor_loss', 'policy_loss'),
)
"""The metrics that are losses, of every method."""


def read(path: Path) -> dict[str, Points]:
    """The columns of a `metrics.csv`, without cells that are empty.

    Raises:
        RunFolderError: it cannot be read, or is not a run's.
    """
    try:
        with path.open(newline='') as file:
            return parse(file)
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise RunFolderError(
            f'{path} is not the table of a run ({error}): remove it, a report can do without it'
        ) from None


def parse(lines: Iterable[str]) -> dict[str, Points]:
    """The same of the lines of such a table.

    Raises:
        KeyError, ValueError, TypeError, AttributeError: they are no such table.
    """
    columns: dict[str, list[tuple[float, float]]] = {}
    for row in csv.DictReader(lines):
        step = float(row.pop('step'))
        for name, value in row.items():
            if value:
                columns.setdefault(name, []).append((step, float(value)))
    return dict(columns)


def joined(before: str, now: str) -> str:
    """The table of a run that goes on: what it was before, and what has come since.

    Args:
        before: the table as it was; empty if there was none.
        now: the table since; its cells replace those of the same phase.
    """
    rows: dict[str, dict[str, str]] = {}
    for table in (before, now):
        for row in csv.DictReader(io.StringIO(table)):
            known = rows.setdefault(row['phase'], {})
            known |= {name: cell for name, cell in row.items() if cell}
    first = ('step', 'phase')
    columns = sorted({name for row in rows.values() for name in row} - set(first))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*first, *columns], restval='', lineterminator='\n')
    writer.writeheader()
    for _, row in sorted(rows.items(), key=lambda item: int(item[0] or -1)):
        writer.writerow(row)
    return text.getvalue()


def losses(columns: Mapping[str, Points]) -> dict[str, Points]:
    """The losses that a run has, by their names in words."""
    shown = {}
    for metric in LOSSES:
        named = {name: points for name, points in columns.items() if name.endswith(f'.{metric}')}
        for name, points in named.items():
            words = metric.replace('_', ' ')
            # several nodes of a role: the column names the node
            shown[words if len(named) == 1 else f'{words} of {name.partition(".")[0]}'] = points
    return shown
