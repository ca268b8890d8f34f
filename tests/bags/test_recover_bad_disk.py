"""What a disk does not give of a bag, and what is kept of the rest."""

import errno
import io
import os
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.recover import recover
from codetr_ros.cli import main
from helpers.bags import a_run, by_mcap, messages, ours

RUN = a_run()


class BadDisk(io.FileIO):
    """A file of which the disk does not give some bytes: it reads up to there, and then fails."""

    def __init__(self, path, bad):
        super().__init__(path)
        self.bad = bad

    def readinto(self, buffer):
        at = self.tell()
        if at in self.bad:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        most = self.bad.start - at if at < self.bad.start else len(buffer)
        return super().readinto(memoryview(buffer)[:most])


@pytest.fixture
def bad_disk(monkeypatch):
    """Makes a range of bytes of a file unreadable."""

    def make(path, bad):
        opened = Path.open

        def open_(self, mode='r', *more, **others):
            if self == path:
                return io.BufferedReader(BadDisk(self, bad))
            return opened(self, mode, *more, **others)

        monkeypatch.setattr(Path, 'open', open_)

    return make


@pytest.mark.slow
@pytest.mark.parametrize('lost', [1, -1], ids=['amid the bag', 'at its end'])
def test_a_split_that_the_disk_does_not_give_costs_itself_and_the_exit_code(
    lost, tmp_path, bad_disk, capsys
):
    bag = ours(tmp_path / 'bag', a_run(phases=40), split_bytes=130_000)
    files = Bag(bag).files
    path = files[lost]
    whole = [(m.place.file, bytes(m.data)) for m in Bag(bag).raw()]
    bad_disk(path, range(path.stat().st_size))
    with pytest.raises(BagError, match=f'{path.name} byte 0: cannot be read: Input/output error'):
        list(Bag(bag).raw())
    assert main(['bag', 'recover', str(bag), '--out', str(tmp_path / 'new')]) == 1
    said = capsys.readouterr().out
    size = path.stat().st_size
    assert f'{path} byte 0: cannot be read: Input/output error ({size} bytes lost)' in said
    assert 'its writer was killed' not in said
    kept = [bytes(m.data) for m in Bag(tmp_path / 'new').raw()]
    assert kept == [data for file, data in whole if file != path] and len(files) > 3


@pytest.mark.parametrize('length', [1, 512, 9000])
def test_a_bad_sector_costs_the_chunks_it_lies_in_and_at_most_as_much_again(
    length, tmp_path, bad_disk
):
    bag = ours(tmp_path / 'bag', a_run(phases=40))
    path = bag / 'bag_0.mcap'
    places = [entry.place.offset for entry in Bag(bag).entries()]
    whole = messages(bag)
    starts = sorted(set(places))
    chunk = starts[len(starts) * 2 // 3]  # definitions, which come again at times, are not near
    bad = range(chunk + 700, chunk + 700 + length)
    bad_disk(path, bad)
    found = recover(bag, tmp_path / 'new')
    kept = messages(tmp_path / 'new')
    before = places.index(chunk)
    behind = len(kept) - before
    assert kept == whole[:before] + whole[-behind:]
    sound = min(start for start in starts if start >= bad.stop)
    if length <= 512:
        assert behind == len(places) - places.index(sound), 'no other chunk is lost'
    assert places[-behind] < bad.stop + length + 8192
    assert found.unread and not found.whole


def test_a_file_whose_beginning_the_disk_does_not_give_is_read_behind_it(tmp_path, bad_disk):
    bag = ours(tmp_path / 'bag', RUN)
    whole = messages(bag)
    bad_disk(bag / 'bag_0.mcap', range(512))
    recover(bag, tmp_path / 'new')
    kept = messages(tmp_path / 'new')
    assert kept == whole[-len(kept) :] and len(whole) - len(kept) < 10


def test_a_beginning_that_the_disk_does_not_give_costs_no_chunk_that_the_summary_describes(
    tmp_path, bad_disk
):
    bag = by_mcap(CompressionType.NONE, chunk_size=9000)(tmp_path / 'bag', RUN)
    entries = list(Bag(bag).entries())
    second = sorted({entry.place.offset for entry in entries})[1]
    whole = messages(bag)
    bad_disk(bag / 'a.mcap', range(512))
    recover(bag, tmp_path / 'new')
    first = sum(entry.place.offset < second for entry in entries)
    assert messages(tmp_path / 'new') == whole[first:]


def test_a_summary_that_the_disk_does_not_give_costs_no_message(tmp_path, bad_disk):
    bag = ours(tmp_path / 'bag', RUN)
    whole = messages(bag)
    path = bag / 'bag_0.mcap'
    size = path.stat().st_size
    bad_disk(path, range(size - 100, size))
    assert messages(bag) == whole  # what reads strictly does not mind
    found = recover(bag, tmp_path / 'new')
    assert messages(tmp_path / 'new') == whole and found.whole
