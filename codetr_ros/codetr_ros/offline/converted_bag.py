"""`codetr convert`: write a bag for `codetr fit` from a bag with ordinary topics."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.unfinished import unfinished
from codetr_ros.bags.writer import McapWriter
from codetr_ros.offline.converting import Converter, Timed
from codetr_ros.offline.errors import FitError
from codetr_ros.records import TOPICS, CompositeReward, Transitions
from codetr_ros.records.fields import type_name
from codetr_ros.robots.conversion import Conversion
from codetr_ros.robots.mapping import Mapping

LATE = 'messages that lay behind later ones of their file, put in order of time'
OVERLAPS = 'files that overlap in time with others, merged in order of time'
UNSET = 'messages without a time in their header'


def convert(bag: Bag, rules: Mapping, folder: Path) -> Conversion:
    """Write a bag for `codetr fit`.

    Args:
        bag: the bag with ordinary topics; it is not touched.
        rules: the mapping.
        folder: of the new bag: does not exist, or is empty.

    Raises:
        BagError: the bag cannot be read, or the new one cannot be written.
        FitError: the mapping names something that is not in the bag.
    """
    if rules.score is None:
        raise FitError(
            'the mapping names no score: without one there is nothing to learn from. Give '
            '`score`, the topic of scores'
        )
    order = bag.time_order(rules.topics, stamped=rules.stamped)
    if missing := sorted(rules.topics - bag.topics.keys()):
        raise FitError(
            f'{bag.path} has no topic {", ".join(missing)}. It has: {", ".join(bag.topics)}'
        )
    converter = Converter(rules, folder.name)
    for what, count in (
        (LATE, order.late),
        (OVERLAPS, order.overlaps),
        (UNSET, order.unset.total()),
    ):
        if count:
            converter.conversion.dropped[what] += count
    with unfinished(folder, 'convert again') as new:
        _write(_records(bag, rules, converter), rules.source, new)
        if not converter.conversion.steps:
            lost = ', '.join(f'{n} {what}' for what, n in converter.conversion.dropped.items())
            raise FitError(f'{bag.path}: not one step could be made: {lost or "no command"}')
    return converter.conversion


def _write(records: Iterator[Timed], source: str, folder: Path) -> None:
    names = {kind: f'/{source}/{TOPICS[kind]}' for kind in (Transitions, CompositeReward)}
    topics = [BagTopic(name, type_name(kind), 1000, False) for kind, name in names.items()]
    with closing(McapWriter(folder, topics)) as writer:
        for record, time in records:
            writer.write(names[type(record)], encode(record, time), time)


def _records(bag: Bag, rules: Mapping, converter: Converter) -> Iterator[Timed]:
    for message in bag.messages(rules.topics, stamped=rules.stamped):
        yield from converter.feed(message)
    yield from converter.finish()
