"""Bags of several files: each whole by itself, all read as one."""

import resource
import signal

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.writer import McapWriter
from helpers.bag_writing import COMMITS, TRANSITIONS, child, files, raw, sequences

MESSAGES = 40
SPLIT = 45_000  # several files; the definitions alone take 8 kB of each


def split_bag(folder, split_bytes=SPLIT):
    writer = McapWriter(folder, [TRANSITIONS, COMMITS], chunk_bytes=2000, split_bytes=split_bytes)
    write_all(writer)
    writer.close()
    return writer


def write_all(writer):
    for i in range(MESSAGES):
        writer.write(TRANSITIONS.name, raw(i, steps=100), 1000 + i)


def test_a_bag_goes_on_in_a_new_file_at_the_given_size(tmp_path):
    writer = split_bag(tmp_path / 'bag')
    sizes = [path.stat().st_size for path in files(tmp_path / 'bag')]
    assert len(sizes) >= 3
    assert all(SPLIT <= size < SPLIT + 20_000 for size in sizes[:-1])
    assert sum(sizes) == writer.size


def test_without_a_size_there_is_one_file(tmp_path):
    split_bag(tmp_path / 'bag', split_bytes=0)
    assert [path.name for path in files(tmp_path / 'bag')] == ['bag_0.mcap']


def test_rosbags_reads_all_files_as_one_bag(tmp_path):
    split_bag(tmp_path / 'bag')
    with AnyReader([tmp_path / 'bag']) as bag:
        read = list(bag.messages())
    assert [bytes(data) for _, _, data in read] == [raw(i, steps=100) for i in range(MESSAGES)]


def test_our_reader_reads_all_files_as_one_bag_closed_or_not(tmp_path):
    split_bag(tmp_path / 'closed')
    open_ = McapWriter(tmp_path / 'open', [TRANSITIONS], chunk_bytes=2000, split_bytes=SPLIT)
    write_all(open_)
    open_.flush()
    damage = []
    for bag in (Bag(tmp_path / 'closed'), Bag(tmp_path / 'open', damage.append)):
        assert len(bag.files) >= 3
        assert [m.sequence for m in bag.raw()] == list(range(MESSAGES))
    assert all('without its index' in str(said.text) for said in damage) and len(damage) == 1
    open_.close()


def test_each_file_is_whole_by_itself(tmp_path):
    split_bag(tmp_path / 'bag')
    found = []
    for path in files(tmp_path / 'bag'):
        with path.open('rb') as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert {c.topic for c in summary.channels.values()} == {'/r/transitions', '/r/commits'}
            assert summary.statistics.message_count == sum(1 for _ in reader.iter_messages())
            found += [message.sequence for _, _, message in reader.iter_messages()]
    assert found == list(range(MESSAGES))


def test_the_metadata_lists_every_file_with_its_times_and_counts(tmp_path):
    split_bag(tmp_path / 'bag')
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    said = yaml.safe_load(text)['rosbag2_bagfile_information']
    names = [path.name for path in files(tmp_path / 'bag')]
    assert said['relative_file_paths'] == [file['path'] for file in said['files']] == names
    assert said['message_count'] == sum(file['message_count'] for file in said['files']) == 40
    start = 1000
    for file in said['files']:
        assert file['starting_time']['nanoseconds_since_epoch'] == start
        assert file['duration']['nanoseconds'] == file['message_count'] - 1
        start += file['message_count']
    counts = {t['topic_metadata']['name']: t['message_count']
              for t in said['topics_with_message_count']}  # fmt: skip
    assert counts == {'/r/transitions': 40, '/r/commits': 0}


def test_a_killed_writer_leaves_all_files_but_the_last_whole(tmp_path):
    process = child(
        tmp_path / 'bag',
        f"""
        writer._split_bytes = {SPLIT}
        i = 0
        while len(writer._files) < 4:
            writer.write(TRANSITIONS.name, raw(i, steps=100), i)
            i += 1
        print(i, flush=True)
        sys.stdin.read()
        import time; time.sleep(60)
        """,
    )
    count = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait(120)
    *whole, last = files(tmp_path / 'bag')
    found = []
    for path in whole:
        with path.open('rb') as file:
            found += [
                m.sequence for *_, m in make_reader(file, validate_crcs=True).iter_messages()
            ]
    assert len(whole) == 3
    assert found == list(range(len(found)))
    assert count - len(found) <= 32  # a chunk of 64 KB, not yet on the disk
    sequences(last)  # it can be read
    # nobody takes what is left for the whole bag
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()


def test_a_next_file_that_cannot_be_made_leaves_those_before_it_whole(tmp_path):
    writer = McapWriter(tmp_path / 'bag', [TRANSITIONS], chunk_bytes=2000, split_bytes=SPLIT)
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    no_more = writer._stream.fileno()
    resource.setrlimit(resource.RLIMIT_NOFILE, (no_more, limits[1]))
    try:
        with pytest.raises(BagError, match='bag cannot be written: Too many open files'):
            write_all(writer)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    (path,) = files(tmp_path / 'bag')
    with path.open('rb') as file:
        read = [m.sequence for *_, m in make_reader(file, validate_crcs=True).iter_messages()]
    assert read == list(range(len(read))) and len(read) > 5
    with pytest.raises(BagError, match='is closed'):
        writer.write(TRANSITIONS.name, raw(0), 0)
