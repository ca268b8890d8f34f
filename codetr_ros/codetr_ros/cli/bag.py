"""`codetr bag`: show, check, recover and play bags."""

from collections.abc import Callable, Sequence

from codetr_ros.cli import carry_out_one_of

HELP = """usage: codetr bag COMMAND BAG [OPTIONS]

A bag is a folder of MCAP or SQLite files, or one such file, written by our recorder,
`ros2 bag record` or others. Only `play` needs ROS.

commands:
  info       show what is in it: runs, episodes, segments, scores, topics, files
  verify     list every gap, duplicate, damaged chunk and missing score, by its place
  recover    make a whole bag from what can be read of a damaged or unfinished one
  play       publish it again, for a reward node or a learner to train from (needs ROS)

`codetr bag COMMAND --help` explains the options of a command.
"""


def _info(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import bag_info

    return bag_info.main(arguments)


def _verify(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import bag_verify

    return bag_verify.main(arguments)


def _recover(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import bag_recover

    return bag_recover.main(arguments)


def _play(arguments: Sequence[str]) -> int:
    from codetr_ros.cli import bag_play

    return bag_play.main(arguments)


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    'info': _info,
    'verify': _verify,
    'recover': _recover,
    'play': _play,
}


def main(arguments: Sequence[str]) -> int:
    """Carry out one of the commands; returns the exit code."""
    return carry_out_one_of('bag', HELP, COMMANDS, arguments)
