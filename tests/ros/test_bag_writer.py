import os
import signal
import zlib

import pytest
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.topics import schema_text, type_hash
from codetr_ros.bags.writer import McapWriter
from helpers.bag_writing import COMMITS, TRANSITIONS, child, raw, sequences
from helpers.builders import transitions


def written(folder, n=20):
    writer = McapWriter(folder, [TRANSITIONS, COMMITS], chunk_bytes=2000)
    for i in range(n):
        writer.write(TRANSITIONS.name, raw(i), 1000 + i, 500 + i)
    writer.close()
    return writer


@pytest.mark.parametrize('store', [None, Stores.ROS2_JAZZY], ids=['without', 'with'])
def test_rosbags_reads_back_every_bit_with_and_without_a_typestore(tmp_path, store):
    written(tmp_path / 'bag')
    with AnyReader([tmp_path / 'bag'], default_typestore=store and get_typestore(store)) as bag:
        read = list(bag.messages())
        assert [bytes(data) for _, _, data in read] == [raw(i) for i in range(20)]
        assert [time for _, time, _ in read] == [1000 + i for i in range(20)]
        last = bag.deserialize(read[-1][2], read[-1][0].msgtype)
        assert last.observations.tobytes() == transitions(sequence=19).observations.tobytes()
        assert bag.topics['/r/commits'].msgcount == 0


def test_qos_and_type_hashes_are_those_that_rosbags_finds(tmp_path):
    written(tmp_path / 'bag')
    with AnyReader([tmp_path / 'bag']) as bag:
        by_topic = {c.topic: c for c in bag.connections}
        for topic in (TRANSITIONS, COMMITS):
            found = by_topic[topic.name]
            assert found.digest == type_hash(topic.type)
            assert found.ext.offered_qos_profiles[0].depth == topic.depth
        durabilities = [
            by_topic[t.name].ext.offered_qos_profiles[0].durability.name
            for t in (TRANSITIONS, COMMITS)
        ]
        assert durabilities == ['VOLATILE', 'TRANSIENT_LOCAL']


def test_type_hashes_agree_with_what_rosbags_computes_from_the_schema():
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in ('Transitions', 'Commit', 'StepRewards', 'Presence'):
        kind = f'codetr_msgs/msg/{name}'
        text = schema_text(kind).decode().split('=' * 80)[0]
        store.register(get_types_from_msg(text, kind))
        assert store.hash_rihs01(kind) == type_hash(kind)


def test_a_schema_holds_all_that_the_type_contains_once():
    text = schema_text('diagnostic_msgs/msg/DiagnosticArray').decode()
    contained = [
        line.removeprefix('MSG: ') for line in text.splitlines() if line.startswith('MSG: ')
    ]
    assert contained == [
        'std_msgs/Header', 'builtin_interfaces/Time',
        'diagnostic_msgs/DiagnosticStatus', 'diagnostic_msgs/KeyValue',
    ]  # fmt: skip


def test_a_type_that_is_not_installed_is_refused_with_where_it_was_looked_for():
    with pytest.raises(BagError, match='no msg file of nowhere/msg/Nothing in .*share'):
        schema_text('nowhere/msg/Nothing')


def test_one_flipped_bit_is_refused(tmp_path):
    writer = written(tmp_path / 'bag')
    path = tmp_path / 'bag' / 'bag_0.mcap'
    data = bytearray(path.read_bytes())
    at = data.index(transitions().observations.tobytes())
    data[at + 5] ^= 1
    path.write_bytes(data)
    with pytest.raises(Exception, match='checksum'), AnyReader([writer.folder]) as bag:
        list(bag.messages())


def test_a_bag_is_not_written_over_another(tmp_path):
    written(tmp_path / 'bag')
    with pytest.raises(BagError, match='bag .* exists and holds bag_0.mcap: choose another'):
        McapWriter(tmp_path / 'bag', [TRANSITIONS])


def test_closing_twice_changes_nothing(tmp_path):
    writer = written(tmp_path / 'bag')
    before = {p.name: p.read_bytes() for p in writer.folder.iterdir()}
    writer.close()
    assert {p.name: p.read_bytes() for p in writer.folder.iterdir()} == before
    assert set(before) == {'bag_0.mcap', 'metadata.yaml'}


def test_all_that_was_flushed_survives_sigkill(tmp_path):
    process = child(
        tmp_path / 'bag',
        """
        for i in range(30):
            writer.write(TRANSITIONS.name, raw(i), i)
        writer.flush()
        writer.write(TRANSITIONS.name, raw(30), 30)
        print('flushed', flush=True)
        sys.stdin.read()
        import time; time.sleep(60)
        """,
    )
    assert process.stdout.readline() == 'flushed\n'
    process.send_signal(signal.SIGKILL)
    process.wait(120)
    assert sequences(tmp_path / 'bag' / 'bag_0.mcap')[:30] == list(range(30))


def test_every_chunk_has_the_checksum_of_its_content(tmp_path):
    written(tmp_path / 'bag')
    with (tmp_path / 'bag' / 'bag_0.mcap').open('rb') as file:
        records = list(StreamReader(file, emit_chunks=True).records)
    chunks = [record for record in records if type(record).__name__ == 'Chunk']
    assert len(chunks) > 2
    assert all(chunk.uncompressed_crc == zlib.crc32(chunk.data) != 0 for chunk in chunks)


def test_flushing_ends_the_chunk_and_syncs_all_of_the_file(tmp_path, monkeypatch):
    synced = []
    fsync = os.fsync

    def watched(descriptor):
        fsync(descriptor)
        synced.append(os.fstat(descriptor).st_size)

    writer = McapWriter(tmp_path / 'bag', [TRANSITIONS])
    path = tmp_path / 'bag' / 'bag_0.mcap'
    monkeypatch.setattr(os, 'fsync', watched)
    for i in range(3):
        writer.write(TRANSITIONS.name, raw(i), i)
        assert not synced
    writer.flush()
    assert synced == [path.stat().st_size]
    assert sequences(path) == [0, 1, 2]
    writer.close()


def test_counts_and_size_are_those_of_the_finished_file(tmp_path):
    writer = written(tmp_path / 'bag')
    assert writer.counts == {TRANSITIONS.name: 20}
    assert writer.size == (tmp_path / 'bag' / 'bag_0.mcap').stat().st_size
