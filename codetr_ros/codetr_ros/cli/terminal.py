"""How wide output is: as the terminal and, where there is none, as wide as it needs to be.

A path that is cut in two can neither be clicked nor copied nor found by `grep`. So output into a
file or another program is never wrapped, but for the explanations of `--help`.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import tyro
from rich.console import Console

WIDE = 100_000
"""Columns that no line of ours needs."""
HELP_COLUMNS = 129
"""Columns of help where there is no terminal. Its explanations stand in a column beside the flags,
and with more columns than these the parser would set its boxes side by side.
"""

_T = TypeVar('_T')


def console(*, stderr: bool = False, tables: bool = False) -> Console:
    """A console for the lines of a command. Names of files and topics may look like markup, so
    nothing is markup.

    Args:
        stderr: print to standard error.
        tables: fit what is printed, tables above all, to the width of a terminal.
    """
    made = Console(stderr=stderr, markup=False, highlight=False, soft_wrap=not tables)
    if not made.is_terminal:
        made.width = WIDE
    return made


def parse_arguments(
    kind: type[_T],
    arguments: Sequence[str],
    prog: str,
    description: str | None = None,
    **more: Any,
) -> _T:
    """Parse the arguments of a command.

    Args:
        kind: dataclass of the arguments, or a union of several for commands with commands.
        arguments: the command's arguments.
        prog: its name.
        description: what it does, for its help, if not the docstring of `kind`.
        more: options of `tyro.cli`.

    Raises:
        SystemExit: code 0 after help, 2 for a flag that does not exist or a value of the wrong
            type.
    """
    asks_for_help = '-h' in arguments or '--help' in arguments
    with _columns(*((sys.stdout, HELP_COLUMNS) if asks_for_help else (sys.stderr, WIDE))):
        given: _T = tyro.cli(kind, prog=prog, description=description, args=arguments, **more)
        return given


@contextmanager
def _columns(stream: Any, columns: int) -> Iterator[None]:
    """Let `shutil.get_terminal_size`, by which help and errors are wrapped, return so many columns
    if a stream is no terminal.
    """
    before = os.environ.get('COLUMNS')
    if not stream.isatty():
        os.environ['COLUMNS'] = str(columns)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop('COLUMNS', None)
        else:
            os.environ['COLUMNS'] = before
