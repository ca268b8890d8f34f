"""`codetr label`: write a bag with the step rewards of all its segments added.

The new bag holds the messages of the old one, byte for byte. At its end follow the `StepRewards`
of every segment, in parts, on the topic `step_rewards` beside that of the steps; also of segments
that state that they have no score. They are of the phase after the bag's last, so that they
replace labels that a run has recorded: the later of two labels of a step holds.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml

from codetr_ros.bags.copying import copy, write_metadata
from codetr_ros.bags.definitions import encode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.raw import LIBRARY, Channel, RawMessage
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.schemas import Definition
from codetr_ros.bags.topics import BagTopic, schema_text, type_hash
from codetr_ros.bags.unfinished import unfinished
from codetr_ros.offline.cutting import Stretch, stretches
from codetr_ros.offline.episodes import Index, Key
from codetr_ros.offline.judging import labels_of
from codetr_ros.offline.loading import load
from codetr_ros.records import MESSAGE_BYTES, TOPICS, StepRewards
from codetr_ros.records.fields import type_name
from codetr_ros.rewards.base import RewardMethod, RewardModelError
from codetr_ros.rewards.saved import SavedModel, restore

STRETCH_STEPS = 10_000
"""Longer episodes are labelled in stretches of about this many steps."""
_DEPTH = 1000


@dataclass
class Labelled:
    """The counts of a labelling."""

    messages: int = 0  # of the old bag
    segments: int = 0
    steps: int = 0  # that got a label
    unlabelled: int = 0  # steps that no score covers
    skipped: Counter[str] = field(default_factory=Counter)
    topics: set[str] = field(default_factory=set)


def label(bag: Bag, saved: SavedModel, folder: Path, memory_steps: int) -> Labelled:
    """Write a bag with step rewards added.

    Args:
        bag: the bag; it is not touched.
        saved: the reward model.
        folder: of the new bag: does not exist, or is empty.
        memory_steps: the most steps to hold at a time.

    Raises:
        BagError: the bag cannot be read, or the new one cannot be written.
        FitError: there is nothing to label.
        RewardModelError: the model has other sizes, or its labels are not finite.
    """
    index = Index([bag]).read()
    settings = saved.settings
    method = restore(saved, settings, index.observation_size, index.action_size)
    data = stretches(index, settings.longest, min(STRETCH_STEPS, max(1, memory_steps // 4)), True)
    made = Labelled(unlabelled=data.unscored - data.declared, skipped=data.skipped)
    messages = _messages(bag, index, method, data.usable, memory_steps, made)
    with unfinished(folder, 'label again') as new:
        copied = copy(messages, new, f'labelled by {LIBRARY}')
        write_metadata(copied, new)
    return made


def _messages(
    bag: Bag,
    index: Index,
    method: RewardMethod,
    usable: Sequence[Stretch],
    memory_steps: int,
    made: Labelled,
) -> Iterator[RawMessage]:
    """Yield all messages of the bag, then those with labels."""
    channels: dict[str, Channel] = {}
    counts: Counter[str] = Counter()
    last: RawMessage | None = None
    for message in bag.raw():
        channels[message.channel.topic] = message.channel
        made.messages += 1
        if message.channel.numbered:  # labels continue after the last number, gaps or not
            topic = message.channel.topic
            counts[topic] = max(counts[topic], message.sequence + 1)
        last = message
        yield message
    assert last is not None  # the index has steps
    for key, parts in _parts(usable).items():
        topic = f'{index.topics[key].rpartition("/")[0]}/{TOPICS[StepRewards]}'
        channel = channels.setdefault(topic, _channel(topic))
        if channel.type != type_name(StepRewards):
            raise BagError(
                f'{bag.path}: topic {topic} is of type {channel.type}, so it cannot hold labels'
            )
        made.topics.add(topic)
        phase = index.phases[key]
        for number, record in enumerate(_records(bag, index, method, key, parts, memory_steps)):
            made.segments += len(record.lengths)
            made.steps += len(record.labels)
            part = replace(record, phase=phase, part=number, parts=len(parts))
            yield RawMessage(
                channel,
                last.log_time,
                last.log_time,
                counts[topic],
                encode(part, last.log_time, channel.definition),
                last.place,
            )
            counts[topic] += 1


def _channel(topic: str) -> Channel:
    kind = type_name(StepRewards)
    definition = Definition('ros2msg', schema_text(kind).decode(), type_hash(kind))
    qos = yaml.safe_dump(BagTopic(topic, kind, _DEPTH, False).qos(), sort_keys=False)
    return Channel(topic, kind, 'cdr', definition, qos)


def _parts(usable: Sequence[Stretch]) -> dict[Key, list[list[Stretch]]]:
    """The stretches of each source, in parts that fit into one message each."""
    parts: dict[Key, list[list[Stretch]]] = {}
    sizes: Counter[Key] = Counter()
    for stretch in usable:
        size = int(stretch.segments.lengths.sum()) * 4 + len(stretch.segments.lengths) * 12
        mine = parts.setdefault(stretch.key, [])
        if not mine or sizes[stretch.key] + size > MESSAGE_BYTES:
            mine.append([])
            sizes[stretch.key] = 0
        mine[-1].append(stretch)
        sizes[stretch.key] += size
    return parts


def _records(
    bag: Bag,
    index: Index,
    method: RewardMethod,
    key: Key,
    parts: list[list[Stretch]],
    memory_steps: int,
) -> Iterator[StepRewards]:
    """Yield the labels of each part; the bag is read once for as many parts as memory holds."""
    begin = 0
    while begin < len(parts):
        sizes = np.cumsum([sum(s.steps for s in part) for part in parts[begin:]])
        end = begin + max(1, int(np.searchsorted(sizes, memory_steps, side='right')))
        yield from _label(bag, index, method, key, parts[begin:end])
        begin = end


def _label(
    bag: Bag, index: Index, method: RewardMethod, key: Key, parts: list[list[Stretch]]
) -> Iterator[StepRewards]:
    wanted = [stretch for part in parts for stretch in part]
    delay = max(int(s.segments.lengths.max()) for s in wanted)
    loaded = load([bag], wanted, (index.observation_size, index.action_size), delay)
    ids = loaded.memory.segments.all_ids()
    labels = labels_of(method, loaded, ids)
    episodes = loaded.memory.segments.spans(ids)[0][1]
    rows = {id(s): np.flatnonzero(episodes == i) for i, s in enumerate(loaded.stretches)}
    for part in parts:
        mine = labels[np.concatenate([rows[id(s)] for s in part])]
        values = mine[~np.isnan(mine)]
        lengths = np.concatenate([s.segments.lengths for s in part])
        if len(values) != lengths.sum() or not np.isfinite(values).all():
            raise RewardModelError(
                f'labels of method {method.name!r} are not finite on {bag.path}: its data is far '
                'from what the model was trained on, or training had diverged'
            )
        yield StepRewards(
            run_id=key.run_id,
            phase=0,
            version=method.version,
            part=0,
            parts=0,
            source=key.source,
            episodes=np.repeat(
                [s.episode for s in part], [len(s.segments.firsts) for s in part]
            ).astype(np.uint32),
            first_steps=np.concatenate([s.segments.firsts for s in part]).astype(np.uint32),
            lengths=lengths.astype(np.uint32),
            labels=values,
        )
