"""`codetr convert`: make a bag for `codetr fit` from a bag with ordinary topics."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from codetr_ros.bags.errors import BagError
from codetr_ros.cli import refuse
from codetr_ros.cli.terminal import console, parse_arguments
from codetr_ros.config import SettingsError
from codetr_ros.offline.errors import FitError
from codetr_ros.records import RecordError
from codetr_ros.robots.errors import MessageError
from codetr_ros.system.files import FileError, check_makeable


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Make Transitions and CompositeReward messages from ordinary topics, by a mapping file.

    The mapping defines which fields of which topics are observation, action and score, when a step
    is taken and where an episode ends: docs/other-peoples-data.md. No ROS is needed.
    """

    bag: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar='BAG', help="MCAP or SQLite, anybody's")
    ]
    mapping: Annotated[str, tyro.conf.arg(metavar='FILE', help='the mapping, a YAML file')]
    out: Annotated[str, tyro.conf.arg(metavar='NEW', help='folder of the new bag, new or empty')]


def main(arguments: Sequence[str]) -> int:
    """Convert and print a summary; returns the exit code."""
    given = parse_arguments(Arguments, prog='codetr convert', arguments=arguments)
    try:
        check_makeable(Path(given.out))
    except FileError as error:
        return refuse(f'--out {given.out}: {error}')
    from codetr_ros.bags.reader import Bag
    from codetr_ros.offline.converted_bag import LATE, OVERLAPS, convert
    from codetr_ros.offline.converting import CLOCK_BACK
    from codetr_ros.robots import mapping
    from codetr_ros.robots.conversion import HINTS, JOINTS_DOUBLED

    try:
        rules = mapping.load(Path(given.mapping))
        made = convert(Bag(Path(given.bag)), rules, Path(given.out))
    except (BagError, FitError, MessageError, RecordError, SettingsError) as error:
        return refuse(str(error))
    read = ', '.join(f'{n} of {topic}' for topic, n in sorted(made.messages.items()))
    kept = (LATE, OVERLAPS, CLOCK_BACK, JOINTS_DOUBLED)
    lost = ', '.join(f'{n} {what}' for what, n in made.dropped.items() if what not in kept)
    noted = ', '.join(f'{n} {what}' for what, n in made.dropped.items() if what in kept)
    each = f'{made.fewest}' if made.fewest == made.most else f'{made.fewest} to {made.most}'
    rows = {
        'messages': read,
        'sizes': f'{made.sizes[0]} observations, {made.sizes[1]} actions',
        'episodes': f'{made.episodes}, {made.steps} steps of '
        f'{made.shortest:.3g} to {made.longest:.3g} s',
        'scores': f'{made.scores}, of {made.scored_steps} steps together, {each} each'
        if made.scores
        else 'none',
        'dropped': lost or 'nothing',
        **({'noted': noted} if noted else {}),
        'output': given.out,
    }
    shown = console()
    for name, text in rows.items():
        shown.print(f'{name:<12}{text}')
    for what, hint in HINTS.items():
        if what in made.dropped:
            shown.print(f'{"hint":<12}{what}: {hint}')
    return 0
