"""Bags that were recorded before messages grew are read as they are, by their own definitions."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from codetr_ros.bags.definitions import bundled_text, decode, encode, is_own, own_types
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.info import survey
from codetr_ros.bags.playback import items, recorded_run
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.recover import recover
from codetr_ros.bags.schemas import Definition
from codetr_ros.bags.verify import verify
from codetr_ros.offline.labelling import label
from codetr_ros.offline.phases import fold
from codetr_ros.records import PROTOCOL_VERSION, Commit, RunSpec, StepRewards
from codetr_ros.records.fields import type_name
from codetr_ros.rewards import saved
from helpers.bags import messages
from helpers.old_bags import protocol_1

COMMIT = type_name(Commit)


@pytest.fixture
def old(tmp_path):
    return protocol_1(tmp_path / 'old')


def cut(name: str, first_that_is_missing: str) -> str:
    """The definition of one of our types as it was before a field and all behind it."""
    text = bundled_text(name)
    lines = text.splitlines()
    end = next(i for i, line in enumerate(lines) if f' {first_that_is_missing} ' in f'{line} ')
    return '\n'.join(lines[:end])


def older(name: str, first_that_is_missing: str) -> tuple[object, Definition]:
    """The types by which an older version wrote, and how its bag defines them."""
    text = cut(name, first_that_is_missing)
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(text, name))
    return store, Definition('ros2msg', text, store.hash_rihs01(name))


def an_old_commit() -> tuple[bytes, Definition]:
    store, definition = older(COMMIT, 'transition_digests')
    kinds = store.types
    time = kinds['builtin_interfaces/msg/Time'](1, 2)
    last = np.array([7], np.int64)
    message = kinds[COMMIT](time, 'r', 3, ['sim'], last, ['me'], last + 1, [])
    return bytes(store.serialize_cdr(message, COMMIT)), definition


def test_the_recorded_bag_is_what_rosbags_reads_by_its_own_definitions(old):
    """Independent: rosbags takes the definitions from the file."""
    store = get_typestore(Stores.EMPTY)
    with Reader(old) as reader:
        by_type = Counter(connection.msgtype for connection, _, _ in reader.messages())
        for connection in reader.connections:
            types = get_types_from_msg(connection.msgdef.data, connection.msgtype)
            store.register({k: v for k, v in types.items() if k not in store.fielddefs})
        commits = [
            store.deserialize_cdr(data, COMMIT)
            for connection, _, data in reader.messages()
            if connection.msgtype == COMMIT
        ]
    assert not hasattr(commits[0], 'previous'), 'recorded before commits had digests'
    entries = list(Bag(old).entries())
    assert Counter(type_name(entry.kind) for entry in entries) == by_type
    ours = [entry.record for entry in entries if entry.kind is Commit]
    for mine, theirs in zip(ours, commits, strict=True):
        assert mine.phase == theirs.phase and mine.sources == tuple(theirs.sources)
        assert mine.transitions.tolist() == theirs.transitions.tolist()
        assert mine.scores.tolist() == theirs.scores.tolist()
        assert mine.transition_digests == mine.score_digests == () and mine.previous == ''


def test_an_old_bag_is_sound_and_recovered_and_copied_byte_for_byte(old, tmp_path):
    assert verify(old).sound
    assert survey(old)['faults'] == 0
    recovered = recover(old, tmp_path / 'new')
    assert recovered.whole and messages(tmp_path / 'new') == messages(old)


def test_what_is_played_of_an_old_bag_are_messages_of_this_version(old):
    bag = Bag(old)
    recorded = recorded_run(bag)
    assert recorded.run.protocol_version == PROTOCOL_VERSION and recorded.phases == 4
    played = list(items(bag, recorded.run.run_id))
    assert len(played) == sum(1 for e in Bag(old).entries() if e.kind is not RunSpec)
    stamps = {type(i.record): i.log_time for i in played}
    assert set(stamps) == {e.kind for e in Bag(old).entries()} - {RunSpec}
    for item in played:
        kind = type(item.record)
        message = own_types().deserialize_cdr(item.data, type_name(kind))
        assert message.run_id == recorded.run.run_id
        assert message.stamp.sec > 1_700_000_000, 'with the stamp that it had'


def test_an_old_bag_is_folded_and_labelled_anew(old, tmp_path):
    bag = Bag(old)
    recorded = recorded_run(bag)
    refused = []
    folded = fold(
        bag, recorded.run, recorded.settings, tmp_path / 'fit/checkpoints', refused.append
    )
    assert folded.phases == 4 and not refused and folded.recorded.same > 0
    label(Bag(old), saved.read(tmp_path / 'fit'), tmp_path / 'labelled', 1000)
    before, after = (sum(1 for _ in Bag(b).entries()) for b in (old, tmp_path / 'labelled'))
    assert after > before
    added = [e.record for e in Bag(tmp_path / 'labelled').entries() if e.kind is StepRewards][4:]
    assert sum(len(record.labels) for record in added) == 240, 'readable beside the older ones'


def test_fields_that_an_older_definition_lacks_have_their_defaults():
    data, definition = an_old_commit()
    record = decode(Commit, data, definition)
    assert (record.phase, record.scores.tolist(), record.labels_digest) == (3, [8], '')
    assert encode(record, 10**9 + 2, definition) == data, 'and it is written as it was'
    assert not is_own(COMMIT, definition)


def test_an_older_definition_is_known_by_its_hash_alone():
    data, definition = an_old_commit()
    by_hash = Definition('', '', definition.digest)
    assert decode(Commit, data, by_hash).phase == 3
    with pytest.raises(BagError, match='has the hash RIHS01_0, this version reads RIHS01_'):
        decode(Commit, data, Definition('', '', 'RIHS01_0'))


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (lambda text: text + '\nstring policy_digest', "'string policy_digest' there"),
        (lambda text: text.replace('uint32 phase', 'int32 phase'), "'int32 phase' there"),
        (lambda text: text.partition('string[] dropped')[0], "'nothing' there"),
    ],
)
def test_a_definition_that_is_no_beginning_of_ours_is_refused(change, said):
    text = change(cut(COMMIT, 'transition_digests'))
    with pytest.raises(BagError, match=f'{COMMIT} is defined otherwise: field . is {said}'):
        decode(Commit, b'', Definition('ros2msg', text))


def test_what_is_decoded_by_the_wrong_definition_is_no_record():
    data, _ = an_old_commit()
    with pytest.raises(ValueError, match='Commit cannot be decoded'):
        decode(Commit, data)
    now = encode(replace(decode(Commit, *an_old_commit()), previous='ab' * 32))
    with pytest.raises(ValueError, match='Commit cannot be decoded'):
        decode(Commit, now, an_old_commit()[1])
