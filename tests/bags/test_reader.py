import shutil
import subprocess
import sys
import tempfile
import textwrap
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from codetr_ros.bags.definitions import encode, own_types
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import TOPICS, Commit, RunSpec, Transitions
from codetr_ros.records.fields import type_name
from helpers.bags import WRITERS, a_run, ours, topic_of
from helpers.builders import same
from helpers.disks import fill, small_disk


def read(path, kinds=None):
    return [entry.record for entry in Bag(path).entries(kinds)]


def all_same(found, expected):
    return len(found) == len(expected) and all(map(same, found, expected))


@pytest.mark.parametrize('writer', WRITERS)
def test_every_record_comes_back_with_the_same_bits_whoever_wrote_the_bag(writer, tmp_path):
    records = a_run()
    assert all_same(read(WRITERS[writer](tmp_path / 'bag', records)), records)


@pytest.mark.parametrize('writer', WRITERS)
def test_a_bag_is_read_without_its_metadata(writer, tmp_path):
    records = a_run()
    bag = WRITERS[writer](tmp_path / 'bag', records)
    (bag / 'metadata.yaml').unlink(missing_ok=True)
    assert all_same(read(bag), records)


@pytest.mark.parametrize('writer', WRITERS)
def test_a_single_file_is_a_bag(writer, tmp_path):
    records = a_run()
    bag = WRITERS[writer](tmp_path / 'bag', records)
    (file,) = [path for path in bag.iterdir() if path.name != 'metadata.yaml']
    assert all_same(read(file), records)


def test_an_entry_says_what_it_is_where_it_lies_and_when_it_was_written(tmp_path):
    records = a_run()
    entries = list(Bag(ours(tmp_path / 'bag', records, '/a/run')).entries())
    for i, (entry, record) in enumerate(zip(entries, records, strict=True)):
        assert entry.kind is type(record)
        assert entry.topic == topic_of(record, '/a/run')
        assert (entry.log_time, entry.publish_time) == (1000 + i, 500 + i)
        data = entry.place.file.read_bytes()
        assert data[entry.place.offset] == 6, 'a chunk begins there'
    assert 'bag_0.mcap byte' in str(entries[-1].place)


def test_a_message_said_to_be_from_before_1970_is_as_published_when_received(
    tmp_path,
):
    record = a_run()[0]
    writer = McapWriter(tmp_path / 'bag', [BagTopic('/a/run', type_name(RunSpec), 1, False)])
    writer.write('/a/run', encode(record, -(10**9)), 1000, -(10**9))
    writer.close()
    (entry,) = Bag(tmp_path / 'bag').entries()
    assert (entry.log_time, entry.publish_time) == (1000, 1000)
    assert same(entry.record, record)


def test_only_the_kinds_asked_for_are_given_out(tmp_path):
    bag = ours(tmp_path / 'bag', a_run(phases=3))
    assert [record.phase for record in read(bag, [Commit])] == [0, 1, 2]


def test_topics_are_counted_and_runs_told_apart_by_namespace(tmp_path):
    records = a_run(phases=2)
    bag = Bag(ours(tmp_path / 'bag', records, '/cell_3/run'))
    assert bag.topics['/cell_3/run/transitions'].count == 8
    assert bag.topics['/cell_3/run/transitions'].type == 'codetr_msgs/msg/Transitions'
    assert bag.topics['/cell_3/run/presence'].count == 0
    assert bag.namespaces == ('/cell_3/run',)


@pytest.mark.slow
def test_splits_are_read_as_one_in_the_order_of_their_numbers(tmp_path):
    records = a_run(phases=8)
    bag = ours(tmp_path / 'bag', records, split_bytes=110_000)
    assert (bag / 'bag_10.mcap').exists()
    assert all_same(read(bag), records)
    (bag / 'metadata.yaml').unlink()
    assert all_same(read(bag), records)


def test_a_split_that_is_missing_is_named(tmp_path):
    bag = ours(tmp_path / 'bag', a_run(phases=9), split_bytes=110_000)
    (bag / 'bag_1.mcap').unlink()
    with pytest.raises(BagError, match='lacks bag_1.mcap, which its metadata.yaml lists'):
        Bag(bag)


def test_a_chunk_that_is_gone_without_a_trace_is_missed_at_the_files_end(tmp_path):
    bag = ours(tmp_path / 'bag', a_run())
    path = bag / 'bag_0.mcap'
    data = path.read_bytes()
    a, b = sorted({entry.place.offset for entry in Bag(bag).entries()})[1:3]
    path.write_bytes(data[:a] + data[b:])
    with pytest.raises(BagError, match='the file counts 44 messages, .* were read'):
        read(bag)


def test_a_bag_becomes_the_memory_that_the_run_had(tmp_path):
    records = a_run()
    live, again = (Trajectories(3, 2, 5, 1000, 100) for _ in range(2))
    bag = ours(tmp_path / 'bag', records)
    for memory, source in ((live, records), (again, read(bag, [Transitions]))):
        for record in source:
            if isinstance(record, Transitions):
                memory.append(record)
    assert all(
        map(np.array_equal, live.store.observation_moments(), again.store.observation_moments())
    )


def test_arrays_are_writeable_memory_of_our_own(tmp_path):
    chunk = read(ours(tmp_path / 'bag', a_run()), [Transitions])[0]
    assert chunk.observations.flags.writeable and chunk.observations.flags.aligned


def test_a_bag_is_read_in_the_memory_of_a_chunk(tmp_path):
    steps = 2000
    chunk = Transitions(
        run_id='run',
        source='sim',
        sequence=0,
        phase=0,
        episode=0,
        first_step=0,
        steps=steps,
        observations=np.zeros((steps + 1, 100), np.float32),
        actions=np.zeros((steps, 1), np.float32),
        terminated=False,
        truncated=False,
        phase_end=False,
        scores_due=0,
    )
    bag = ours(tmp_path / 'bag', [chunk] * 40)
    assert sum(path.stat().st_size for path in bag.iterdir()) > 30e6
    next(Bag(bag).entries())  # what is kept for good: definitions
    tracemalloc.start()
    try:
        assert sum(1 for _ in Bag(bag).entries()) == 40
        assert tracemalloc.get_traced_memory()[1] < 6e6
    finally:
        tracemalloc.stop()


def test_the_library_reads_bags_where_ros_is_absent(tmp_path):
    bag = ours(tmp_path / 'bag', a_run())
    program = """
        import sys
        from importlib.abc import MetaPathFinder

        class Absent(MetaPathFinder):
            def find_spec(self, name, path, target=None):
                if name.split('.')[0] in ('rclpy', 'codetr_msgs', 'builtin_interfaces'):
                    raise ModuleNotFoundError(name)

        sys.meta_path.insert(0, Absent())
        from codetr_ros.bags.reader import Bag
        print(sum(1 for _ in Bag(sys.argv[1]).entries()))
    """
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(program), str(bag)],
        capture_output=True, text=True, check=False, timeout=180,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == len(a_run())


def test_the_definitions_that_come_with_the_library_are_those_that_ros_installed():
    from codetr_ros.bags.topics import type_hash

    for kind in TOPICS:
        name = type_name(kind)
        assert own_types().hash_rihs01(name) == type_hash(name)


JOINTS = 'sensor_msgs/msg/JointState'


@pytest.mark.parametrize('version', [8, 9])
def test_messages_of_others_are_decoded_by_the_definition_in_the_bag(tmp_path, version):
    store = get_typestore(Stores.ROS2_HUMBLE)
    own = 'strange_msgs/msg/Thing'
    store.register(get_types_from_msg('float64[3] x\nstd_msgs/Header[] stamps\n', own))
    types = store.types
    header = types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](1, 2), 'base')
    joints = types[JOINTS](header, ['a', 'b'], np.array([0.5, -1]), np.array([]), np.array([]))
    thing = types[own](np.arange(3.0), [header, header])
    with RosbagsWriter(tmp_path / 'bag', version=version) as writer:
        for name, message in ((JOINTS, joints), (own, thing)):
            topic = writer.add_connection(f'/{name}', name, typestore=store)
            writer.write(topic, 7, store.serialize_cdr(message, name))
    bag = Bag(tmp_path / 'bag')
    (found,) = bag.messages(types=[JOINTS])
    assert found.topic == f'/{JOINTS}' and found.log_time == 7
    assert found.message.name == ['a', 'b'] and found.message.position.tolist() == [0.5, -1]
    (found,) = bag.messages(topics=[f'/{own}'])
    assert found.message.x.tolist() == [0, 1, 2]
    assert found.message.stamps[1].frame_id == 'base'
    assert len(list(bag.messages())) == 2
    assert list(bag.entries()) == []


def with_definition(tmp_path, text):
    """A bag whose Commit is defined otherwise."""
    kind = 'codetr_msgs/msg/Commit'
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, kind))
    with RosbagsWriter(tmp_path / 'bag', version=9) as writer:
        topic = writer.add_connection('/run/commits', kind, typestore=store)
        writer.write(topic, 7, encode(next(r for r in a_run() if isinstance(r, Commit))))
    return tmp_path / 'bag'


@pytest.mark.parametrize(
    ('old', 'new', 'said'),
    [
        ('uint32 phase', 'uint64 phase', "field 3 is 'uint64 phase' there, 'uint32 phase'"),
        ('uint32 phase', 'uint32 stage', "field 3 is 'uint32 stage' there, 'uint32 phase'"),
        ('string[] dropped', '', "field 8 is 'string\\[\\] transition_digests' there"),
        ('string[] sources', 'string[2] sources', "field 4 is 'string\\[2\\] sources' there"),
    ],
)
def test_a_definition_that_is_not_ours_is_refused_by_name(tmp_path, old, new, said):
    from codetr_ros.bags.definitions import bundled_text

    text = bundled_text('codetr_msgs/msg/Commit')
    assert old in text
    bag = with_definition(tmp_path, text.replace(old, new))
    with pytest.raises(BagError, match=f'codetr_msgs/msg/Commit is defined otherwise: {said}'):
        read(bag)


def test_a_definition_that_differs_in_comments_and_constants_only_is_the_same(tmp_path):
    from codetr_ros.bags.definitions import bundled_text

    text = bundled_text('codetr_msgs/msg/Commit')
    assert len(read(with_definition(tmp_path, f'# a comment\nint64 MORE=3\n{text}'))) == 1


def test_numbers_that_do_not_fit_are_not_encoded():
    record = next(r for r in a_run() if isinstance(r, Transitions))
    with pytest.raises(ValueError, match='Transitions cannot be written'):
        encode(replace(record, phase=-1))


def test_what_is_no_bag_is_refused_with_the_reason(tmp_path):
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'notes.txt').write_text('no bag')
    (tmp_path / 'loop').symlink_to('loop')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'folder' / 'a.mcap').mkdir()
    for name, said in (
        ('nowhere', 'nowhere cannot be read: No such file or directory'),
        ('empty', 'empty is no bag: it holds no file of .mcap or .db3'),
        ('notes.txt', 'notes.txt is no bag: a bag is a folder, or a file of .mcap or .db3'),
        ('loop', 'loop cannot be read: Too many levels of symbolic links'),
        ('folder', 'a.mcap is no file'),
    ):
        with pytest.raises(BagError, match=said):
            Bag(tmp_path / name)


def test_a_bag_in_a_folder_with_a_strange_name_is_read(tmp_path):
    made = WRITERS['rosbags-sqlite-9'](tmp_path / 'bag', a_run())
    strange = tmp_path / 'what? #1 50%'
    shutil.move(made, strange)
    assert len(read(strange)) == len(a_run())


def test_a_full_temporary_disk_is_no_damage_of_the_bag(tmp_path, monkeypatch):
    bag = WRITERS['rosbags-mcap-zstd-file'](tmp_path / 'bag', a_run())
    with small_disk(tmp_path / 'disk', 1) as disk:
        fill(disk)
        monkeypatch.setattr(tempfile, 'tempdir', str(disk))
        damage = []
        with pytest.raises(BagError, match=r'unpacked, cannot be written: No space.*set TMPDIR'):
            list(Bag(bag, damage.append).raw())
    assert not damage
