import io
import json
import os
import sqlite3
import struct
import subprocess
import sys
import textwrap

import pytest
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.mcap_layout import next_chunk
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.recover import recover
from codetr_ros.bags.topics import schema_text
from codetr_ros.bags.verify import verify
from codetr_ros.cli import main
from codetr_ros.records import Commit, RunSpec, Transitions, TrueRewards
from codetr_ros.records.fields import type_name
from helpers.bags import WRITERS, a_run, by_mcap, messages, ours
from helpers.damage import killed

RUN = a_run()


def ignored(damage):
    """The missing end of a killed recorder's file, which is no news."""


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize('writer', WRITERS)
def test_a_sound_bag_is_kept_byte_for_byte_whoever_wrote_it(writer, tmp_path):
    bag = WRITERS[writer](tmp_path / 'bag', RUN)
    found = recover(bag, tmp_path / 'new')
    assert messages(tmp_path / 'new') == messages(bag)
    assert found.verdict.sound and not found.lost and not found.faults


def test_a_killed_recorders_bag_becomes_one_that_rosbags_opens(tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    whole = messages(bag)
    commits = [entry.place for entry in Bag(bag).entries([Commit])]
    os.truncate(commits[2].file, commits[2].offset + 50)
    (bag / 'metadata.yaml').unlink()
    before = (bag / 'bag_0.mcap').read_bytes()
    found = recover(bag, tmp_path / 'new')
    kept = messages(tmp_path / 'new')
    assert kept == whole[: len(kept)] and len(kept) > 20
    assert found.lost == 50 and found.verdict.sound
    (run,) = found.verdict.runs.values()
    assert (run.phases, run.whole) == (2, 2)
    assert (bag / 'bag_0.mcap').read_bytes() == before
    with AnyReader([tmp_path / 'new']) as reader:
        assert [bytes(data) for _, _, data in reader.messages()] == [m[-1] for m in kept]
        assert (
            reader.topics['/run/transitions'].connections[0].ext.offered_qos_profiles[0].depth
            == 10
        )


def test_a_damaged_chunk_is_left_out_and_what_is_missing_is_said_by_number(tmp_path):
    bag = ours(tmp_path / 'bag', RUN, chunk_bytes=1)
    places = [entry.place for entry in Bag(bag).entries()]
    whole = messages(bag)
    lost = next(i for i, record in enumerate(RUN) if isinstance(record, Commit)) - 3
    flip(places[lost].file, places[lost].offset + 70)
    found = recover(bag, tmp_path / 'new')
    assert messages(tmp_path / 'new') == whole[:lost] + whole[lost + 1 :]
    assert found.faults == 1 + 1, 'the chunk, and the count in the summary'
    assert "transitions of 'sim': number 3 is missing before 4" in [
        f.text for f in found.verdict.findings.named
    ]
    (run,) = found.verdict.runs.values()
    assert (run.phases, run.whole) == (3, 0)


def test_topics_are_taken_from_the_summary_where_the_chunk_that_described_them_is_damaged(
    tmp_path,
):
    bag = ours(tmp_path / 'bag', RUN)
    first = next(Bag(bag).entries()).place
    whole = messages(bag)
    flip(first.file, first.offset + 500)
    found = recover(bag, tmp_path / 'new')
    kept = messages(tmp_path / 'new')
    assert kept == whole[-len(kept) :] and 0 < len(whole) - len(kept) < 10
    assert found.lost > 500


def test_what_comes_twice_stays_there_twice(tmp_path):
    bag = ours(tmp_path / 'bag', [*RUN, RUN[2]])
    recover(bag, tmp_path / 'new')
    assert messages(tmp_path / 'new') == messages(bag)


@pytest.mark.slow
def test_a_missing_split_is_said_and_the_others_are_kept(tmp_path):
    bag = ours(tmp_path / 'bag', a_run(phases=40), split_bytes=130_000)
    (bag / 'bag_1.mcap').unlink()
    found = recover(bag, tmp_path / 'new')
    assert 'lacks bag_1.mcap' in found.losses[0].text
    assert any(f.kind == 'gap' for f in found.verdict.findings.named)
    assert not any(f.kind in ('file', 'metadata', 'index') for f in found.verdict.findings.named)
    assert messages(tmp_path / 'new') == messages(bag, lambda damage: None)


def test_chunks_that_changed_places_stay_so_and_are_named(tmp_path):
    bag = ours(tmp_path / 'bag', RUN, chunk_bytes=1)
    path = bag / 'bag_0.mcap'
    data = path.read_bytes()
    places = [entry.place.offset for entry in Bag(bag).entries([Transitions])]
    ends = [entry.place.offset for entry in Bag(bag).entries([TrueRewards])]
    (a, b), (c, d) = zip(places[4:6], ends[4:6], strict=True)
    path.write_bytes(data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:])
    assert not verify(bag).sound
    found = recover(bag, tmp_path / 'new')
    assert len(messages(tmp_path / 'new')) == len(RUN)
    assert {f.kind for f in found.verdict.findings.named} >= {'gap', 'duplicate'}


def test_metadata_of_another_version_becomes_that_of_jazzy(tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    path = bag / 'metadata.yaml'
    path.write_text(path.read_text().replace('version: 9', 'version: 99'))
    assert recover(bag, tmp_path / 'new').verdict.sound
    assert 'version: 9\n' in (tmp_path / 'new' / 'metadata.yaml').read_text()


def test_bags_without_checksums_are_kept_too(tmp_path):
    bag = by_mcap(CompressionType.NONE, use_chunking=False)(tmp_path / 'bag', RUN)
    path = bag / 'a.mcap'
    whole = messages(bag)
    os.truncate(path, path.stat().st_size * 3 // 4)
    recover(bag, tmp_path / 'new')
    kept = messages(tmp_path / 'new')
    assert kept == whole[: len(kept)] and len(kept) > 10


def test_rows_behind_a_damaged_page_of_a_database_are_kept(tmp_path):
    bag = WRITERS['rosbags-sqlite-9'](tmp_path / 'bag', a_run(phases=60))
    path = bag / 'bag.db3'
    whole = messages(bag)
    data = bytearray(path.read_bytes())
    page = data.index(whole[len(whole) // 2][-1]) // 4096 * 4096
    data[page : page + 4096] = bytes(4096)
    path.write_bytes(data)
    found = recover(bag, tmp_path / 'new')
    kept = messages(tmp_path / 'new')
    assert len(whole) - 40 < len(kept) < len(whole)
    assert [m for m in whole if m in kept] == kept and kept[-1] == whole[-1]
    assert any('cannot be read' in damage.text for damage in found.losses)
    assert not found.verdict.sound


def test_a_row_with_a_time_before_1970_is_named_and_the_others_are_kept(tmp_path, capsys):
    bag = WRITERS['rosbags-sqlite-9'](tmp_path / 'bag', RUN)
    with sqlite3.connect(bag / 'bag.db3') as database:
        database.execute('UPDATE messages SET timestamp = -5 WHERE id = 7')
    database.close()
    assert main(['bag', 'recover', str(bag), '--out', str(tmp_path / 'new')]) == 1
    assert 'bag.db3 row 7: its time is -5 ns' in capsys.readouterr().out
    whole = messages(WRITERS['rosbags-sqlite-9'](tmp_path / 'whole', RUN))
    assert messages(tmp_path / 'new') == whole[:6] + whole[7:]


def test_a_damaged_first_chunk_whose_definitions_the_summary_does_not_repeat_is_said(tmp_path):
    write = by_mcap(CompressionType.NONE, repeat_schemas=False)
    bag = write(tmp_path / 'bag', RUN)
    flip(bag / 'a.mcap', 300)
    found = verify(bag).findings
    assert 'CRC' in found.named[0].text and found.counts['file'] > 1


@pytest.mark.parametrize('qos', ['- 2024-99-99', '- ' + '9' * 5000, '[' * 3000])
def test_qos_that_is_no_yaml_does_not_cost_the_bag(tmp_path, qos):
    record = RUN[0]
    kind = type_name(type(record))
    with (tmp_path / 'a.mcap').open('wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'somebody')
        schema = writer.register_schema(kind, 'ros2msg', schema_text(kind))
        said = {'offered_qos_profiles': qos}
        channel = writer.register_channel('/run/run', 'cdr', schema, said)
        writer.add_message(channel, 1000, encode(record), 500)
        writer.finish()
    assert recover(tmp_path / 'a.mcap', tmp_path / 'new').verdict.sound


def test_nothing_is_written_where_nothing_can_be_read_or_something_is(tmp_path):
    (tmp_path / 'bag.mcap').write_bytes(b'')
    with pytest.raises(BagError, match='no message of .* can be read.*is empty'):
        recover(tmp_path / 'bag.mcap', tmp_path / 'new')
    bag = ours(tmp_path / 'bag', RUN)
    with pytest.raises(BagError, match='exists and holds bag_0.mcap: choose another'):
        recover(bag, bag)


def test_a_full_disk_is_said(tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    program = """
        import resource, sys
        from codetr_ros.bags.recover import recover, BagError
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
        try:
            recover(*sys.argv[1:])
        except BagError as error:
            print(error)
    """
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(program), str(bag), str(tmp_path / 'new')],
        capture_output=True, text=True, check=False, timeout=180,
    )  # fmt: skip
    assert 'cannot be written: File too large' in done.stdout, done.stderr


def test_the_command_says_what_was_lost_and_up_to_where_the_run_is_whole(tmp_path, capsys):
    bag = ours(tmp_path / 'bag', RUN)
    commits = [entry.place for entry in Bag(bag).entries([Commit])]
    os.truncate(commits[2].file, commits[2].offset + 50)
    assert main(['bag', 'recover', str(bag), '--out', str(tmp_path / 'new')]) == 0
    said = capsys.readouterr().out
    assert 'whole up to phase 1, 2 phases were committed' in said
    assert f'50 bytes of {bag} could not be read' in said
    assert main(['bag', 'recover', str(bag), '--out', str(tmp_path / 'b'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['verdict']['runs'][0]['phases_whole'] == 2
    assert main(['bag', 'recover', str(tmp_path / 'no'), '--out', str(tmp_path / 'c')]) == 2
    assert verify(tmp_path / 'new').sound


def test_a_recovered_bag_is_read_as_the_run_that_it_was(tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    os.truncate(bag / 'bag_0.mcap', (bag / 'bag_0.mcap').stat().st_size - 10)
    recover(bag, tmp_path / 'new')
    (spec,) = Bag(tmp_path / 'new').entries([RunSpec])
    assert spec.record.settings == RUN[0].settings


def test_a_killed_recorders_file_is_kept_but_for_its_damaged_first_chunk(tmp_path):
    """The first chunk described the topics; a file without its end does not repeat them there."""
    bag = killed(tmp_path / 'bag', RUN)
    whole = messages(bag, ignored)
    first = [e.place for e in Bag(bag, ignored).entries()]
    lost = sum(place.offset == first[0].offset for place in first)
    flip(first[0].file, first[0].offset + 500)
    found = recover(bag, tmp_path / 'new')
    assert messages(tmp_path / 'new') == whole[lost:] and 0 < lost < 5
    assert 'its CRC is' in found.losses[0].text


def test_damaged_chunks_at_the_beginning_cost_no_more_than_as_much_again(tmp_path):
    bag = killed(tmp_path / 'bag', a_run(phases=40))
    whole = messages(bag, ignored)
    places = [entry.place.offset for entry in Bag(bag, ignored).entries()]
    damaged = [at for at in sorted(set(places)) if at < 40_000]
    for at in damaged:
        flip(bag / 'bag_0.mcap', at + 500)
    recover(bag, tmp_path / 'new')
    kept = messages(tmp_path / 'new')
    assert kept == whole[-len(kept) :]
    assert places[-len(kept)] < 100_000 < places[-1]


@pytest.mark.slow
def test_a_split_that_is_no_file_costs_only_itself(tmp_path):
    bag = ours(tmp_path / 'bag', a_run(phases=40), split_bytes=130_000)
    last = Bag(bag).files[-1]
    last.unlink()
    last.mkdir()
    assert main(['bag', 'recover', str(bag), '--out', str(tmp_path / 'new')]) == 1
    assert messages(tmp_path / 'new') == messages(bag, ignored) != []


@pytest.mark.slow
def test_a_last_split_that_is_missing_is_a_loss(tmp_path, capsys):
    bag = ours(tmp_path / 'bag', a_run(phases=40), split_bytes=130_000)
    last = Bag(bag).files[-1]
    last.unlink()
    assert main(['bag', 'recover', str(bag), '--out', str(tmp_path / 'new')]) == 1
    assert f'lacks {last.name}' in capsys.readouterr().out


CHUNK = b'\x06' + struct.pack('<Q32xQ', 32 + 8 + 5, 5) + b'12345'


@pytest.mark.parametrize('border', [1 << 20, 3 << 20])
def test_a_chunk_is_found_wherever_it_begins(border):
    for at in range(border - len(CHUNK) - 1, border + 3):
        data = b'\xff' * at + CHUNK + b'\xff' * 60
        assert next_chunk(io.BytesIO(data), 0, len(data)) == at
        assert next_chunk(io.BytesIO(data), at + 1, len(data)) == len(data)


@pytest.mark.parametrize('listed', ['bag_0.mcap', 'elsewhere/bag_0.mcap'])
def test_a_file_that_is_listed_twice_is_named_and_read_once(listed, tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    whole = messages(bag)
    path = bag / 'metadata.yaml'
    text = path.read_text()
    paths = '  relative_file_paths:\n  - bag_0.mcap\n'
    assert paths in text
    path.write_text(text.replace(paths, f'{paths}  - {listed}\n'))
    with pytest.raises(BagError, match=r'metadata.yaml lists bag_0.mcap 2 times, and its messag'):
        Bag(bag)
    said = []
    assert messages(bag, said.append) == whole and 'lists bag_0.mcap 2 times' in said[0].text
    assert not verify(bag).sound
    recover(bag, tmp_path / 'new')
    assert messages(tmp_path / 'new') == whole


def test_nothing_is_left_of_a_bag_that_could_not_be_made(tmp_path):
    (tmp_path / 'bag.mcap').write_bytes(b'')
    (tmp_path / 'there').mkdir()
    for new in ('new', 'there'):
        with pytest.raises(BagError, match=f'{new} is not made: is empty'):
            recover(tmp_path / 'bag.mcap', tmp_path / new)
    assert sorted(p.name for p in tmp_path.rglob('*')) == ['bag.mcap', 'there']


@pytest.mark.parametrize('there', [False, True])
def test_a_new_bag_appears_whole(there, tmp_path):
    bag = ours(tmp_path / 'bag', RUN)
    new = tmp_path / 'deep' / 'new'
    if there:
        new.mkdir(parents=True)
    recover(bag, new)
    assert sorted(p.name for p in new.iterdir()) == ['metadata.yaml', 'new_0.mcap']
    assert [p.name for p in new.parent.iterdir()] == ['new']
