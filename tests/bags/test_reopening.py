"""A recorder that begins again goes on with the bag of the one before it."""

import shutil

import pytest

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.phases import NAMED, Phases
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.reopening import reopen
from codetr_ros.bags.verify import verify
from codetr_ros.bags.writer import McapWriter
from codetr_ros.records import TOPICS, Commit, Policy, Transitions
from codetr_ros.records.fields import type_name
from helpers.bags import a_run, own_topics
from helpers.builders import policy


def raw_of(record):
    return bytes(encode(record, 500))


def write(writer, records, phases=None):
    """Write records as the recorder does: flushed at each commit. Sizes of the file then."""
    sizes = []
    for i, record in enumerate(records):
        place = writer.write(f'/run/{TOPICS[type(record)]}', raw_of(record), 1000 + i)
        if phases is not None:
            phases.note(record, place)
        if isinstance(record, Commit):
            writer.flush()
            sizes.append(writer.size)
    return sizes


def contents(folder):
    return [bytes(message.data) for message in Bag(folder).raw()]


@pytest.fixture(scope='module')
def killed(tmp_path_factory):
    """A bag of three phases whose recorder was killed, and the size of its file at each commit."""
    folder = tmp_path_factory.mktemp('killed') / 'bag'
    writer = McapWriter(folder, own_topics(), chunk_bytes=4000)
    sizes = write(writer, a_run())
    writer.flush()
    return folder, sizes


def test_a_bag_cut_anywhere_is_gone_on_with_and_keeps_every_commit_before_the_cut(
    killed, tmp_path
):
    folder, sizes = killed
    whole = [raw_of(record) for record in a_run()]
    commits = [raw_of(record) for record in a_run() if type(record) is Commit]
    size = (folder / 'bag_0.mcap').stat().st_size
    for cut in (
        *range(0, sizes[0], 8000),  # definitions for the most part
        *range(sizes[0], size, 2000),
        *sizes,
        *(at - 1 for at in sizes),
        *(at + 1 for at in sizes),
    ):
        torn = tmp_path / str(cut) / 'bag'
        shutil.copytree(folder, torn)
        with (torn / 'bag_0.mcap').open('r+b') as file:
            file.truncate(cut)
        kept = []
        written = reopen(torn, lambda message, kept=kept: kept.append(bytes(message.data)))
        assert kept == whole[: len(kept)]
        commits = [
            raw for raw, record in zip(whole, a_run(), strict=True) if type(record) is Commit
        ]
        assert sum(raw in commits for raw in kept) >= sum(at <= cut for at in sizes)
        writer = McapWriter(torn, own_topics(), written=written)
        write(writer, a_run()[len(kept) :])
        writer.close()
        assert contents(torn) == whole
        assert verify(torn).sound, cut
        shutil.rmtree(torn.parent)


def test_a_recorder_killed_while_it_makes_the_bag_whole_leaves_it_as_it_was(killed, tmp_path):
    folder, _ = killed
    torn = tmp_path / 'bag'
    shutil.copytree(folder, torn)
    (torn / '.bag_0.mcap.partial').write_bytes(b'\x89MCAP0\r\nhalf')
    reopen(torn, lambda message: None)
    assert sorted(path.name for path in torn.iterdir()) == ['bag_0.mcap']
    assert contents(torn) == [raw_of(record) for record in a_run()]


def test_a_phase_is_read_from_a_file_that_was_made_whole(killed, tmp_path):
    folder, _ = killed
    torn = tmp_path / 'bag'
    shutil.copytree(folder, torn)
    phases = Phases()
    reopen(torn, lambda raw: phases.note(Bag(torn).entry(raw).record, raw.place))
    found = [list(phases.read(phase)) for phase in range(3)]
    assert [messages[-1][0] for messages in found] == [Commit] * 3
    assert len({len(messages) for messages in found}) == 1


def in_two_files(folder, records, cut, left):
    """The phases of a bag that was gone on with behind so many records.

    Args:
        left: how the first writer was left: flushed, as by who is killed, or closed.
    """
    writer = McapWriter(folder, own_topics(), chunk_bytes=1000)
    write(writer, records[:cut])
    left(writer)
    phases = Phases()
    written = reopen(folder, lambda raw: phases.note(Bag(folder).entry(raw).record, raw.place))
    writer = McapWriter(folder, own_topics(), chunk_bytes=1000, written=written)
    write(writer, records[cut:], phases)
    return phases


def test_a_phase_is_read_from_the_file_of_a_killed_recorder_and_the_next(tmp_path):
    """It was under way when the recorder was killed: the first file begins before it and has an
    end by now.
    """
    folder, records = tmp_path / 'bag', a_run()
    first, second, _ = (i for i, record in enumerate(records) if isinstance(record, Commit))
    phases = in_two_files(folder, records, (first + second) // 2, McapWriter.flush)
    assert len(Bag(folder).files) == 2
    found = [raw for _, raw in phases.read(1)]
    assert found == [
        raw_of(record) for record in records[first + 1 : second + 1] if isinstance(record, NAMED)
    ]


def test_a_closed_bag_is_gone_on_with_in_a_new_file(tmp_path):
    writer = McapWriter(tmp_path / 'bag', own_topics())
    write(writer, a_run())
    writer.close()
    written = reopen(tmp_path / 'bag', lambda message: None)
    writer = McapWriter(tmp_path / 'bag', own_topics(), written=written)
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    write(writer, a_run()[-1:])
    writer.close()
    assert [path.name for path in Bag(tmp_path / 'bag').files] == ['bag_0.mcap', 'bag_1.mcap']
    assert len(contents(tmp_path / 'bag')) == len(a_run()) + 1


def test_a_phase_that_goes_on_in_the_next_file_is_read_from_both(tmp_path):
    """All nodes were stopped in the midst of a phase; or a file became too large there."""
    folder, records = tmp_path / 'bag', a_run()
    cut = next(i for i, r in enumerate(records) if getattr(r, 'sequence', -1) == 5)  # of phase 1
    phases = in_two_files(folder, records, cut, McapWriter.close)
    wanted = [
        raw_of(record)
        for record in records
        if getattr(record, 'phase', 1) == 1 and type(record) in (Transitions, Commit)
    ]
    assert [
        raw for _, raw in phases.read(1, [type_name(Transitions), type_name(Commit)])
    ] == wanted


def test_damage_before_a_commit_is_refused_and_changes_nothing(killed, tmp_path):
    folder, sizes = killed
    torn = tmp_path / 'bag'
    shutil.copytree(folder, torn)
    with (torn / 'bag_0.mcap').open('r+b') as file:
        file.seek(sizes[1] - 300)
        file.write(b'\xff' * 8)
    before = (torn / 'bag_0.mcap').read_bytes()
    with pytest.raises(BagError, match='and a commit lies behind it'):
        reopen(torn, lambda message: None)
    assert (torn / 'bag_0.mcap').read_bytes() == before


def test_any_committed_phase_is_read_again_while_the_bag_is_written(tmp_path):
    """What `fetch_phase` sends: each record of the phase once, with its policy and its commit."""
    run, spec, *records = a_run()
    records = [policy(phase=phase) for phase in range(4)] + records
    writer = McapWriter(tmp_path / 'bag', own_topics(), chunk_bytes=1000, split_bytes=9000)
    phases = Phases()
    write(writer, [run, spec, *records, *records[-3:-1]], phases)
    assert len(list((tmp_path / 'bag').iterdir())) > 1 and phases.newest == 2
    last = -1
    for phase in range(3):
        found = list(phases.read(phase))
        (commit,) = [r for r in records if isinstance(r, Commit) and r.phase == phase]
        upto = int(commit.transitions[0])
        wanted = [
            record
            for record in records
            if getattr(record, 'phase', phase) == phase
            and type(record).__name__ in ('Policy', 'Transitions', 'CompositeReward', 'Commit')
            and last < getattr(record, 'sequence', upto) <= upto
        ]
        assert [raw for _, raw in found] == [raw_of(record) for record in wanted]
        last = upto
        only = list(phases.read(phase, [type_name(Policy)]))
        assert only == [(Policy, raw_of(policy(phase=phase)))]
    with pytest.raises(KeyError, match='phase 3 is not committed; these are: 0 to 2'):
        phases.read(3)
