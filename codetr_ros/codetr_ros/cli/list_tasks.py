"""`codetr tasks`: the tasks that have a name."""

import dataclasses
from collections.abc import Sequence

import tyro
from rich.console import Console
from rich.table import Table

from codetr_ros.runs.numbers import exact
from codetr_ros.simulation import tasks


@dataclasses.dataclass(frozen=True)
class Arguments:
    """List the tasks that have a name. Any other Gymnasium id with Box spaces works as well."""


def main(arguments: Sequence[str]) -> int:
    """Print the table."""
    tyro.cli(Arguments, prog='codetr tasks', args=arguments)
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
    console = Console()
    console.print(table)
    console.print(
        '\nAny other Gymnasium id with Box spaces works as well: --task Pusher-v5', highlight=False
    )
    return 0
