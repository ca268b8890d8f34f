"""Topics without a leading slash, and types without `/msg/`, as other writers have them."""

import sqlite3

import pytest
from rosbags.rosbag2 import StoragePlugin

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.recover import recover
from codetr_ros.bags.verify import verify
from helpers.arm import attempt, bag, files_of

STORAGES = (StoragePlugin.MCAP, StoragePlugin.SQLITE3)


@pytest.mark.parametrize('storage', STORAGES)
def test_a_topic_is_found_with_and_without_its_leading_slash(tmp_path, storage):
    sent = [one._replace(topic=one.topic[1:]) for one in attempt(3)]
    there = Bag(bag(tmp_path / 'bag', sent, storage))

    for asked in ('joint_states', '/joint_states'):
        found = list(there.messages(topics=[asked]))
        assert [message.topic for message in found] == ['/joint_states'] * 4
    assert there.topics['/cmd'].count == 3


def test_a_topic_written_with_and_without_its_slash_is_one(tmp_path):
    sent = attempt(3)
    sent[0] = sent[0]._replace(topic='joint_states')
    there = Bag(bag(tmp_path / 'bag', sent))
    assert len(list(there.messages(['/joint_states']))) == 4
    assert there.topics['/joint_states'].count == 4


@pytest.mark.parametrize('storage', STORAGES)
def test_a_bag_of_topics_without_a_slash_is_sound(tmp_path, storage):
    sent = [one._replace(topic=one.topic[1:]) for one in attempt(3)]
    verdict = verify(bag(tmp_path / 'bag', sent, storage))
    assert verdict.sound, verdict.findings.named


def test_types_of_before_eloquent_are_read_verified_and_recovered(tmp_path):
    there = bag(tmp_path / 'bag', attempt(3))
    (file,) = files_of(there)
    with sqlite3.connect(file) as database:
        database.execute("UPDATE topics SET type = replace(type, '/msg/', '/')")
        database.execute('DELETE FROM message_definitions')
    database.close()
    (there / 'metadata.yaml').write_text(
        (there / 'metadata.yaml').read_text().replace('_msgs/msg/', '_msgs/')
    )

    positions = [m.message.position.tolist() for m in Bag(there).messages(['/joint_states'])]
    assert positions == [[i, -i] for i in range(4)]
    verdict = verify(there)
    assert verdict.sound, verdict.findings.named
    assert recover(there, tmp_path / 'new').whole
    assert Bag(tmp_path / 'new').topics['/joint_states'].type == 'sensor_msgs/msg/JointState'
