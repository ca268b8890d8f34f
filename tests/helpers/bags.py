"""Bags made for tests: a small run, written by our writer and by those of others. No ROS."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from codetr_ros.bags.definitions import encode, own_types
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic, schema_text
from codetr_ros.bags.writer import McapWriter
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Record,
    Transitions,
    TrueRewards,
    metrics,
)
from codetr_ros.records.fields import type_name
from helpers.builders import run, task_spec, tiny

SETTINGS = tiny(delay=5, phase_steps=20, warmup_steps=20, steps=60)
EPISODE = 15  # steps; so an episode has three segments, and a phase ends within one


def a_run(phases: int = 3, seed: int = 0, run_id: str = 'run', chunk: int = 5) -> list[Record]:
    """What a recorder would have received and committed, in order: one source, sound."""
    rng = np.random.default_rng(seed)
    records: list[Record] = [run(SETTINGS, run_id), task_spec(run_id=run_id)]
    sequence = scored = episode = step = 0
    last = rng.normal(size=3).astype(np.float32)
    for phase in range(phases):
        for taken in range(chunk, 21, chunk):
            observations = np.vstack([last[None], rng.normal(size=(chunk, 3))]).astype(np.float32)
            last = observations[-1]
            done = step + chunk == EPISODE
            actions = rng.uniform(-1, 1, (chunk, 2)).astype(np.float32)
            end = taken == 20
            records += [
                Transitions(
                    run_id=run_id,
                    source='sim',
                    sequence=sequence,
                    phase=phase,
                    episode=episode,
                    first_step=step,
                    steps=chunk,
                    observations=observations,
                    actions=actions,
                    terminated=False,
                    truncated=done,
                    phase_end=end,
                    scores_due=4 * end,
                ),
                TrueRewards(
                    run_id=run_id,
                    source='sim',
                    sequence=sequence,
                    phase=phase,
                    episode=episode,
                    first_step=step,
                    rewards=rng.normal(size=chunk).astype(np.float32),
                ),
                CompositeReward(
                    run_id=run_id,
                    source='sim',
                    scorer='sim',
                    sequence=scored,
                    episode=episode,
                    first_step=step,
                    length=chunk,
                    value=float(rng.normal()),
                ),
            ]
            sequence, scored = sequence + 1, scored + 1
            episode, step = (episode + 1, 0) if done else (episode, step + chunk)
        ends = [np.array([n - 1], np.int64) for n in (sequence, scored)]
        records.append(
            Commit(
                run_id=run_id,
                phase=phase,
                sources=('sim',),
                transitions=ends[0],
                scorers=('sim',),
                scores=ends[1],
                dropped=(),
            )
        )
        records.append(metrics(run_id, 'sim', 'sim', phase, 20 * (phase + 1), {'x': 0.5}))
    return records


def topic_of(record: Record, namespace: str = '/run') -> str:
    return f'{namespace}/{TOPICS[type(record)]}'


def own_topics(namespace: str = '/run') -> list[BagTopic]:
    return [BagTopic(f'{namespace}/{t}', type_name(k), 10, False) for k, t in TOPICS.items()]


def ours(folder: Path, records: Iterable[Record], namespace: str = '/run', **options) -> Path:
    """As our recorder writes it, if its chunks were small."""
    records = list(records)
    writer = McapWriter(folder, own_topics(namespace), **({'chunk_bytes': 1500} | options))
    for i, record in enumerate(records):
        writer.write(topic_of(record, namespace), encode(record, 500 + i), 1000 + i, 500 + i)
    writer.close()
    return folder


def by_rosbags(
    storage: StoragePlugin, version: int, mode: CompressionMode = CompressionMode.NONE
) -> Callable[..., Path]:
    def write(folder: Path, records: Iterable[Record], namespace: str = '/run') -> Path:
        writer = RosbagsWriter(folder, version=version, storage_plugin=storage)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connections = {}
            for i, record in enumerate(records):
                topic = topic_of(record, namespace)
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        topic, type_name(type(record)), typestore=own_types()
                    )
                writer.write(connections[topic], 1000 + i, encode(record, 500 + i))
        return folder

    return write


def by_mcap(compression: CompressionType, **options) -> Callable[..., Path]:
    def write(folder: Path, records: Iterable[Record], namespace: str = '/run') -> Path:
        folder.mkdir()
        with (folder / 'a.mcap').open('wb') as file:
            writer = Writer(file, **({'chunk_size': 1500, 'compression': compression} | options))
            writer.start('ros2', 'somebody')
            channels = {}
            for i, record in enumerate(records):
                topic, kind = topic_of(record, namespace), type_name(type(record))
                if topic not in channels:
                    schema = writer.register_schema(kind, 'ros2msg', schema_text(kind))
                    channels[topic] = writer.register_channel(topic, 'cdr', schema)
                writer.add_message(channels[topic], 1000 + i, encode(record, 500 + i), 500 + i)
            writer.finish()
        return folder

    return write


WRITERS: dict[str, Callable[..., Path]] = {
    'ours': ours,
    'rosbags-sqlite-8': by_rosbags(StoragePlugin.SQLITE3, 8),
    'rosbags-sqlite-9': by_rosbags(StoragePlugin.SQLITE3, 9),
    'rosbags-sqlite-zstd-messages': by_rosbags(StoragePlugin.SQLITE3, 9, CompressionMode.MESSAGE),
    'rosbags-sqlite-zstd-file': by_rosbags(StoragePlugin.SQLITE3, 9, CompressionMode.FILE),
    'rosbags-mcap': by_rosbags(StoragePlugin.MCAP, 9),
    'rosbags-mcap-zstd-chunks': by_rosbags(StoragePlugin.MCAP, 9, CompressionMode.STORAGE),
    'rosbags-mcap-zstd-messages': by_rosbags(StoragePlugin.MCAP, 8, CompressionMode.MESSAGE),
    'rosbags-mcap-zstd-file': by_rosbags(StoragePlugin.MCAP, 9, CompressionMode.FILE),
    'mcap': by_mcap(CompressionType.NONE),
    'mcap-zstd': by_mcap(CompressionType.ZSTD),
    'mcap-lz4': by_mcap(CompressionType.LZ4),
    'mcap-without-chunks': by_mcap(CompressionType.NONE, use_chunking=False),
}


def messages(path, on_damage=None):
    """Everything that a message is, for comparison."""
    return [
        (m.channel.topic, m.channel.type, m.log_time, m.publish_time, m.sequence, bytes(m.data))
        for m in Bag(path, on_damage).raw()
    ]
