"""`codetr convert`: a bag to fit, of a bag with ordinary topics."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.offline.converting import Conversion, Converter, Timed
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.mapping import Mapping
from codetr_ros.received import type_name
from codetr_ros.records import TOPICS, CompositeReward, Transitions


def convert(bag: Bag, rules: Mapping, folder: Path) -> Conversion:
    """Write a bag to fit.

    Args:
        bag: the bag with ordinary topics; it is not touched.
        rules: the mapping.
        folder: the new bag: does not exist, or is empty.

    Raises:
        BagError: the bag cannot be read, or the new one not be written.
        FitError: the mapping names something that is not in the bag.
    """
    if missing := sorted(rules.topics - bag.topics.keys()):
        raise FitError(
            f'{bag.path} has no topic {", ".join(missing)}. It has: {", ".join(bag.topics)}'
        )
    made = Converter(rules, folder.name)
    names = {kind: f'/{rules.source}/{TOPICS[kind]}' for kind in (Transitions, CompositeReward)}
    writer = McapWriter(
        folder, [BagTopic(name, type_name(kind), 1000, False) for kind, name in names.items()]
    )
    try:
        for record, time in _records(bag, rules, made):
            writer.write(names[type(record)], encode(record, time), time)
        if not made.found.steps:
            lost = ', '.join(f'{n} {what}' for what, n in made.found.dropped.items())
            raise FitError(f'{bag.path}: not one step could be made: {lost or "no command"}')
        writer.close()
    except BaseException:
        # half a bag must not pass for a whole one; the folder was new or empty
        with suppress(BagError):
            writer.close()
        shutil.rmtree(folder)
        raise
    return made.found


def _records(bag: Bag, rules: Mapping, made: Converter) -> Iterator[Timed]:
    for message in bag.messages(topics=rules.topics):
        yield from made.feed(message)
    yield from made.finish()
