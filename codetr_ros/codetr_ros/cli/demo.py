"""`codetr demo`: whole examples, each in one command."""

from collections.abc import Callable, Sequence

from codetr_ros.cli import carry_out_one_of

HELP = """usage: codetr demo NAME [OPTIONS]

A whole example in one command; it ends by itself.

examples:
  person     a simulated person teaches an arm; watch it, and score beside
  robot      a robot in real time learns from the scores of an inspection

`codetr demo NAME --help` explains the options of an example.
"""


def _robot(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import demo_robot

    return demo_robot.main(arguments)


def _person(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import demo_person

    return demo_person.main(arguments)


DEMOS: dict[str, Callable[[Sequence[str]], int]] = {'person': _person, 'robot': _robot}


def main(arguments: Sequence[str]) -> int:
    """Run an example; returns the exit code."""
    return carry_out_one_of('demo', HELP, DEMOS, arguments)
