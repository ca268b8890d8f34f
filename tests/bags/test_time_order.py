"""Messages come in order of time whatever the order of the file, in bounded memory."""

import random
import shutil
import tracemalloc

import pytest

from codetr_ros.bags import time_order
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.metadata import BagFile, render
from codetr_ros.bags.reader import Bag
from helpers.arm import NOON, NS, STORE, Sent, array_of, attempt, bag, files_of, mcap_file

TOPICS = ['/joint_states', '/cmd', '/score']


def by_topic(sent):
    return sorted(sent, key=lambda one: TOPICS.index(one.topic))


def by_threads(sent):
    rng = random.Random(0)
    return sorted(sent, key=lambda one: one.time + rng.uniform(0, 150_000_000))


def in_batches(sent):
    """Each topic is written every 100 ms, one topic after the other."""
    return sorted(sent, key=lambda one: (one.time // 100_000_000, TOPICS.index(one.topic)))


def seen(messages):
    """Topic, time and content of messages."""
    return [(m.topic, m.time, bytes(STORE.serialize_cdr(m.message, m.type))) for m in messages]


def plain(sent):
    return [
        (s.topic, s.time, bytes(STORE.serialize_cdr(s.message, s.message.__msgtype__)))
        for s in sent
    ]


def in_time(sent):
    """The same, sorted: those of one time stay in their order."""
    return sorted(plain(sent), key=lambda one: one[1])


def small_blocks(monkeypatch):
    monkeypatch.setattr(time_order, 'BLOCK_MESSAGES', 5)


WRITERS = {
    'mcap': lambda path, sent: mcap_file(path / 'a.mcap', sent),
    'mcap, small chunks': lambda path, sent: mcap_file(path / 'a.mcap', sent, chunk_bytes=400),
    'mcap, no chunks': lambda path, sent: mcap_file(path / 'a.mcap', sent, chunked=False),
    'sqlite': lambda path, sent: bag(path / 'a', sent),
}


@pytest.mark.parametrize('writer', WRITERS)
@pytest.mark.parametrize('order', [list, by_topic, by_threads, in_batches])
def test_messages_come_in_order_of_time_whatever_the_order_of_the_file(
    writer, order, tmp_path, monkeypatch
):
    small_blocks(monkeypatch)
    sent = order(attempt(60))
    there = Bag(WRITERS[writer](tmp_path, sent))
    assert seen(there.messages()) == in_time(sent)
    some = [one for one in sent if one.topic != '/cmd']
    assert seen(there.messages(topics=['joint_states', '/score'])) == in_time(some)


@pytest.mark.parametrize('writer', WRITERS)
def test_where_the_clock_starts_again_what_came_before_comes_first(writer, tmp_path, monkeypatch):
    small_blocks(monkeypatch)
    first, second = attempt(60, begin=0), in_batches(attempt(40, begin=0, first=500))
    there = Bag(WRITERS[writer](tmp_path, first + second))
    assert seen(there.messages()) == in_time(first) + in_time(second)
    (fall,) = there.time_order().falls
    assert (fall.topic, fall.high, fall.to) == ('/joint_states', 60 * 20_000_000, 0)


def test_messages_of_one_time_stay_in_the_order_of_the_file(tmp_path, monkeypatch):
    small_blocks(monkeypatch)
    sent = [one._replace(time=NOON + one.time % 2) for one in attempt(40)]
    sent = sorted(sent, key=lambda one: TOPICS.index(one.topic))
    late = [one._replace(time=NOON - 1) for one in sent[-3:]]
    there = Bag(mcap_file(tmp_path / 'a.mcap', [*sent, *late], chunk_bytes=400))
    assert seen(there.messages()) == in_time([*late, *sent])


def test_a_restarted_clock_in_a_file_written_topic_by_topic_is_refused(tmp_path):
    sent = by_topic(attempt(60, begin=0) + attempt(60, begin=0))
    with pytest.raises(BagError, match=r'a.mcap: the clock went back .* cannot be known'):
        list(Bag(mcap_file(tmp_path / 'a.mcap', sent)).messages())


def splits(folder, parts, listed=None, names=('b_0', 'b_1'), storage='.mcap'):
    """A bag of these files, its metadata listing them in another order."""
    folder.mkdir()
    for name, part in zip(names, parts, strict=True):
        if storage == '.mcap':
            mcap_file(folder / f'{name}.mcap', part)
        else:
            (made,) = files_of(bag(folder.parent / f'{folder.name}-{name}', part))
            shutil.copy(made, folder / f'{name}.db3')
    if listed is not None:
        files = [BagFile(name + storage) for name in listed]
        (folder / 'metadata.yaml').write_text(render(files, []))
    return folder


def halves(sent, begin):
    """Two files that overlap by 60 ms, in which messages fall to either."""
    rng = random.Random(0)
    middle = begin + 400_000_000
    first = [s for s in sent if s.time + rng.uniform(-1, 1) * 30_000_000 < middle]
    return first, [one for one in sent if one not in first]


@pytest.mark.parametrize('storage', ['.mcap', '.db3'])
@pytest.mark.parametrize('begin', [0, NOON])
@pytest.mark.parametrize('listed', [None, ['b_0', 'b_1'], ['b_1', 'b_0']])
def test_splits_that_overlap_are_merged_however_they_are_listed(tmp_path, storage, begin, listed):
    sent = attempt(40, begin)
    parts = halves(sent, begin)
    assert max(one.time for one in parts[0]) > min(one.time for one in parts[1])
    there = Bag(splits(tmp_path / 'bag', parts, listed, storage=storage))
    assert seen(there.messages()) == in_time(sent)
    assert there.time_order().overlaps == 1


def test_splits_of_a_topic_each_are_merged(tmp_path):
    sent = attempt(40)
    parts = [[one for one in sent if (one.topic == '/score') == score] for score in (True, False)]
    assert seen(Bag(splits(tmp_path / 'bag', parts)).messages()) == in_time(sent)


@pytest.mark.parametrize('names', [('b_1', 'b_0'), ('early', 'a_late_one')])
def test_splits_of_a_clock_that_shows_a_date_are_read_in_order_of_time(tmp_path, names):
    sent = attempt(40)
    parts = [[s for s in sent if (s.time > NOON + 400_000_000) == late] for late in (False, True)]
    there = Bag(splits(tmp_path / 'bag', parts, sorted(names), names))
    assert seen(there.messages()) == in_time(sent)
    assert not there.time_order().falls


@pytest.mark.parametrize('begin', [0, NOON])
def test_a_clock_that_starts_again_with_a_split_is_seen(tmp_path, begin):
    parts = attempt(40, begin), attempt(40, begin, first=100)
    there = Bag(splits(tmp_path / 'bag', parts))
    assert seen(there.messages()) == plain(parts[0]) + plain(parts[1])
    assert len(there.time_order().falls) == 1


def test_a_simulation_that_is_reset_to_an_earlier_time_than_ever_is_no_split_in_wrong_order(
    tmp_path,
):
    parts = attempt(40, begin=500 * NS), attempt(40, begin=0)
    there = Bag(splits(tmp_path / 'bag', parts))
    assert seen(there.messages()) == plain(parts[0]) + plain(parts[1])
    assert len(there.time_order().falls) == 1


def test_sorting_takes_the_memory_of_the_blocks_that_overlap(tmp_path):
    payload = array_of(range(1000))
    sent = [
        Sent(topic, NOON + i * NS, payload) for topic in ('/a', '/b', '/c') for i in range(1500)
    ]
    file = mcap_file(tmp_path / 'a.mcap', sent, chunk_bytes=100_000)
    assert file.stat().st_size > 30e6
    there = Bag(file)
    next(there.messages())  # what is kept for good: definitions
    tracemalloc.start()
    try:
        times = [m.time for m in there.messages()]
        assert tracemalloc.get_traced_memory()[1] < 6e6
    finally:
        tracemalloc.stop()
    assert times == sorted(times)


def test_what_would_take_too_much_memory_to_sort_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(time_order, 'MOST_HELD', 10_000)
    sent = by_topic(attempt(200))
    with pytest.raises(BagError, match=r'would have to be held .* with `mcap sort`'):
        list(Bag(mcap_file(tmp_path / 'a.mcap', sent, chunk_bytes=4000)).messages())


def test_damage_is_reported_once_though_the_bag_is_read_twice(tmp_path):
    file = mcap_file(tmp_path / 'a.mcap', by_topic(attempt(60)), chunk_bytes=400, finish=False)
    damage = []
    found = seen(Bag(file, damage.append).messages())
    assert len(damage) == 1 and 'its writer was killed' in damage[0].text
    assert found == sorted(found, key=lambda one: one[1]) and len(found) > 100


def test_a_file_that_changes_between_is_noticed(tmp_path):
    file = mcap_file(tmp_path / 'a.mcap', by_topic(attempt(60)), chunk_bytes=400)
    there = Bag(file)
    there.time_order()
    mcap_file(file, by_topic(attempt(20)), chunk_bytes=400)
    with pytest.raises(BagError):
        list(there.messages())
