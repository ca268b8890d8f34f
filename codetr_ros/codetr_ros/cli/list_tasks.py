"""`codetr tasks`: the tasks that have a name."""

import dataclasses
from collections.abc import Sequence

from rich.table import Table

from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.runs.numbers import exact
from codetr_ros.simulation import tasks


@dataclasses.dataclass(frozen=True)
class Arguments:
    """List the tasks that have a name. Any other Gymnasium id with Box spaces works as well."""


def main(arguments: Sequence[str]) -> int:
    """Print the table."""
    parse_arguments(Arguments, prog='codetr tasks', arguments=arguments)
    table = Table(box=None, pad_edge=False)
    for column, justify in (
        ('task', 'left'),
        ('library', 'left'),
        ('horizon', 'right'),
        ('r_max', 'right'),
    ):
        table.add_column(column, justify='right' if justify == 'right' else 'left', no_wrap=True)
    table.add_column('note', overflow='fold')
    for task in tasks.TASKS.values():
        library = {'gymnasium': 'Gymnasium', 'dm_control': 'DM Control'}.get(
            task.library, task.library
        )
        table.add_row(task.name, library, str(task.horizon), exact(task.r_max), task.note)
    shown = console(tables=True)
    shown.print(table)
    shown.print('\nAny other Gymnasium id with Box spaces works as well: --task Pusher-v5')
    return 0
