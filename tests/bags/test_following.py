"""A bag that is still being written, read bit by bit, gives what the whole bag gives."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from codetr_ros.bags.following import Follower
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.records import Commit, CompositeReward, Record, Transitions
from codetr_ros.records.fields import type_name
from helpers.bags import a_run, encode, ours, topic_of

KINDS = (Transitions, CompositeReward)


def shown(records) -> list[tuple[str, int]]:
    return [(type(record).__name__, record.sequence) for record in records]


def wanted(path: Path) -> list[tuple[str, int]]:
    return shown(entry.record for entry in Bag(path).entries(KINDS))


def grown(folder: Path, whole: Path, sizes: list[int]):
    """The first file of a bag as it was when it had each of these sizes."""
    folder.mkdir()
    (source,) = whole.glob('*.mcap')
    content = source.read_bytes()
    for size in [*sizes, len(content)]:
        (folder / source.name).write_bytes(content[:size])
        yield


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ours(tmp_path_factory.mktemp('bag') / 'bag', a_run(40), chunk_bytes=2000)


def test_what_has_come_is_read_once_wherever_the_writer_was_cut_off(whole: Path, tmp_path: Path):
    size = sum(path.stat().st_size for path in whole.glob('*.mcap'))
    follower = Follower(tmp_path / 'live')
    found: list[Record] = []
    assert list(follower.records(KINDS)) == []  # there is no bag yet
    for _ in grown(tmp_path / 'live', whole, list(range(0, size, size // 20))):
        found += follower.records(KINDS)
    assert shown(found) == wanted(whole)
    assert follower.faults == []
    assert list(follower.records(KINDS)) == []


def test_a_bag_of_several_files_is_followed_into_the_next_one(tmp_path: Path):
    whole = ours(tmp_path / 'bag', a_run(30), chunk_bytes=2000, split_bytes=220_000)
    assert len(list(whole.glob('*.mcap'))) == 2
    live = tmp_path / 'live'
    live.mkdir()
    follower = Follower(live)
    found: list[Record] = []
    for path in Bag(whole).files:
        shutil.copy(path, live)
        found += follower.records(KINDS)
    shutil.copy(whole / 'metadata.yaml', live)
    found += follower.records(KINDS)
    assert shown(found) == wanted(whole)


def test_of_a_long_bag_the_end_is_read_and_the_rest_is_counted(whole: Path):
    everything = wanted(whole)
    size = sum(path.stat().st_size for path in whole.glob('*.mcap'))
    follower = Follower(whole, tail=size // 8)
    found = shown(follower.records(KINDS))
    assert found == everything[-len(found) :]
    assert 0 < len(found) < len(everything)
    assert size // 4 < follower.left_out < size
    assert follower.faults == []


def test_a_damaged_chunk_is_noted_and_the_rest_is_read(whole: Path, tmp_path: Path):
    copy = tmp_path / 'copy'
    shutil.copytree(whole, copy)
    (path,) = copy.glob('*.mcap')
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    follower = Follower(copy)
    found = shown(follower.records(KINDS))
    assert set(found) < set(wanted(whole))
    assert len(follower.faults) == 1


def test_a_writer_at_work_is_followed_from_flush_to_flush(tmp_path: Path):
    topics = [BagTopic(topic_of(record), type_name(type(record)), 10, False) for record in a_run()]
    writer = McapWriter(tmp_path / 'live', {topic.name: topic for topic in topics}.values())
    follower = Follower(tmp_path / 'live')
    found: list[Record] = []
    flushed: list[Record] = []
    for number, record in enumerate(a_run(6)):
        writer.write(topic_of(record), encode(record, number), number)
        if isinstance(record, KINDS):
            flushed.append(record)
        if isinstance(record, Commit):
            writer.flush()
            found += follower.records(KINDS)
            assert shown(found) == shown(flushed)
    writer.close()
    assert list(follower.records(KINDS)) == []
    np.testing.assert_array_equal(found[0].observations, flushed[0].observations)
