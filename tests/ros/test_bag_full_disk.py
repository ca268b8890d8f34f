"""The disk runs full while a bag is written: the error says so, nothing flushed is lost."""

import errno
import os
import resource
import shutil

import pytest
from mcap.reader import make_reader

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.writer import McapWriter
from helpers.bag_writing import TRANSITIONS, files, raw, sequences
from helpers.disks import fill, small_disk


@pytest.fixture
def disk(tmp_path):
    with small_disk(tmp_path / 'disk', 2) as disk:
        yield disk


def write(writer, count, first=0):
    for i in range(first, first + count):
        writer.write(TRANSITIONS.name, raw(i, steps=100), i)


def at_a_chunk(writer):
    write(writer, 100, 30)  # chunks end by themselves


def at_a_flush(writer):
    write(writer, 5, 30)  # fewer than a chunk
    writer.flush()


def at_closing(writer):
    writer.close()


@pytest.mark.parametrize('moment', [at_a_chunk, at_a_flush, at_closing])
def test_what_was_flushed_survives_a_disk_that_is_full(disk, moment):
    writer = McapWriter(disk / 'bag', [TRANSITIONS])
    write(writer, 30)
    writer.flush()
    fill(disk)
    with pytest.raises(
        BagError, match=r'bag_0.mcap cannot be written: No space left on device'
    ) as e:
        moment(writer)
    assert f'It holds the {writer.size} bytes flushed before' in str(e.value)
    assert f'`codetr bag recover {disk / "bag"} --out NEW` makes it whole' in str(e.value)
    path = disk / 'bag' / 'bag_0.mcap'
    assert path.stat().st_size == writer.size
    assert sequences(path) == list(range(30))
    writer.close()  # harmless
    assert writer.closed and not (disk / 'bag' / 'metadata.yaml').exists()


@pytest.mark.parametrize('leave', [0, 8192], ids=['no room', 'room for its beginning'])
def test_a_disk_that_is_full_at_a_split_leaves_the_files_before_it_whole(disk, leave):
    writer = McapWriter(disk / 'bag', [TRANSITIONS], chunk_bytes=2000, split_bytes=200_000)
    i = 0
    while writer.size < 190_000:
        write(writer, 1, i)
        i += 1
    writer.flush()
    filler = fill(disk)
    # room for the rest of the first file and its index, and some for the next
    with filler.open('r+b') as file:
        file.truncate(filler.stat().st_size - 45_000 - leave)
    with pytest.raises(BagError, match='cannot be written: No space left'):
        write(writer, 100, i)
    first, *others = files(disk / 'bag')
    with first.open('rb') as file:
        read = [m.sequence for *_, m in make_reader(file, validate_crcs=True).iter_messages()]
    for path in others:
        read += sequences(path)
    assert read == list(range(len(read))) and len(read) >= i


def test_a_bag_is_closed_while_there_is_room_for_its_index(disk):
    writer = McapWriter(disk / 'bag', [TRANSITIONS], keep_free=1_000_000)
    write(writer, 30)
    writer.check_room()
    fill(disk, leave=900_000)
    with pytest.raises(
        BagError, match='the disk has 0.9 MB left, fewer than the 1.0 MB to be kept'
    ):
        writer.check_room()
    writer.close()
    with (disk / 'bag' / 'bag_0.mcap').open('rb') as file:
        assert len(list(make_reader(file).iter_messages())) == 30
    assert (disk / 'bag' / 'metadata.yaml').is_file()


def test_a_bag_whose_metadata_cannot_be_written_says_that_it_is_whole(tmp_path):
    writer = McapWriter(tmp_path / 'bag', [TRANSITIONS])
    write(writer, 3)
    (tmp_path / 'bag' / 'metadata.yaml').mkdir()
    with pytest.raises(BagError, match=r'is whole but metadata.yaml cannot be written: Is a dir'):
        writer.close()
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as file:
        assert len(list(make_reader(file).iter_messages())) == 3


def read_only(path, monkeypatch):
    def refused(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(os, 'truncate', refused)
    return 'Read-only file system'


def gone(path, monkeypatch):
    path.unlink()
    return 'No such file or directory'


@pytest.mark.parametrize('happened', [read_only, gone])
def test_a_file_that_cannot_be_cut_back_is_said_in_the_same_error(tmp_path, monkeypatch, happened):
    writer = McapWriter(tmp_path / 'bag', [TRANSITIONS])
    write(writer, 30)
    writer.flush()
    flushed = writer.size
    reason = happened(tmp_path / 'bag' / 'bag_0.mcap', monkeypatch)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (flushed, limits[1]))
    try:
        with pytest.raises(BagError, match='bag_0.mcap cannot be written: File too large') as e:
            at_a_flush(writer)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert f'It holds the {flushed} bytes flushed before' in str(e.value)
    assert f'not cut back to them ({reason})' in str(e.value)
    assert 'codetr bag recover' in str(e.value)
    writer.close()  # harmless


def test_a_disk_that_does_not_say_how_full_it_is_is_named(tmp_path):
    writer = McapWriter(tmp_path / 'bag', [TRANSITIONS], keep_free=1)
    shutil.rmtree(tmp_path / 'bag')
    with pytest.raises(BagError, match='bag: the room left on its disk is unknown: No such'):
        writer.check_room()
