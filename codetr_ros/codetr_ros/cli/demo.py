"""`codetr demo`: whole examples, each in one command."""

import sys
from collections.abc import Callable, Sequence

from codetr_ros.cli import USAGE, refuse_command

HELP = """usage: codetr demo NAME [OPTIONS]

A whole example in one command; it ends by itself.

examples:
  robot      a robot in real time learns from the scores of an inspection

`codetr demo NAME --help` explains the options of an example.
"""


def _robot(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import demo_robot

    return demo_robot.main(arguments)


DEMOS: dict[str, Callable[[Sequence[str]], int]] = {'robot': _robot}


def main(arguments: Sequence[str]) -> int:
    """Run an example; returns the exit code."""
    if not arguments:
        print(HELP, end='', file=sys.stderr)
        return USAGE
    if arguments[0] in ('-h', '--help', 'help'):
        print(HELP, end='')
        raise SystemExit(0)  # as after --help of the other commands
    demo = DEMOS.get(arguments[0])
    if demo is None:
        return refuse_command(f'demo {arguments[0]}', arguments[0], DEMOS)
    return demo(arguments[1:])
