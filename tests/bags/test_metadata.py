"""`metadata.yaml` and the topics' descriptions as rosbag2 of Jazzy decodes them.

What it asks for, field by field and with its types, is in its sources: `yaml.hpp` and `qos.cpp` of
`rosbag2_storage`, `mcap_storage.cpp` of `rosbag2_storage_mcap` (branch `jazzy`).
"""

import pytest
import yaml
from mcap.reader import make_reader

from codetr_ros.bags.metadata import read
from codetr_ros.bags.recover import recover
from helpers.bags import WRITERS, a_run, ours

POLICIES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': ('system_default', 'automatic', 'manual_by_topic', 'unknown', 'best_available'),
}
DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')


def check_number(value):
    assert type(value) is int and 0 <= value < 2**64


def check_text(*values):
    assert all(type(value) is str for value in values)


def check_qos(profiles):
    assert isinstance(profiles, list)
    for profile in profiles:
        for policy, known in POLICIES.items():
            assert profile[policy] in known
        for duration in DURATIONS:
            assert profile[duration].keys() == {'sec', 'nsec'}
            for value in profile[duration].values():
                check_number(value)
        check_number(profile['depth'])
        assert type(profile['avoid_ros_namespace_conventions']) is bool


def check_span(said):
    check_number(said['starting_time']['nanoseconds_since_epoch'])
    check_number(said['duration']['nanoseconds'])
    check_number(said['message_count'])


def check(folder):
    said = read(folder)
    assert said['version'] == 9 and said['storage_identifier'] == 'mcap'
    check_span(said)
    check_text(said['compression_format'], said['compression_mode'], said['ros_distro'])
    assert said['custom_data'] is None or isinstance(said['custom_data'], dict)
    formats = set()
    for topic in said['topics_with_message_count']:
        check_number(topic['message_count'])
        about = topic['topic_metadata']
        check_text(about['name'], about['type'], about['type_description_hash'])
        formats.add(about['serialization_format'])
        check_qos(about['offered_qos_profiles'])
    assert formats == {'cdr'}, 'it opens no bag of several formats'
    assert [file['path'] for file in said['files']] == said['relative_file_paths']
    for file in said['files']:
        check_span(file)
        check_file(folder / file['path'], file['message_count'])
    return said


def check_file(path, count):
    """What is asked of a file: profile, statistics, an index, a definition for each topic."""
    with path.open('rb') as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == 'ros2'
    assert summary.statistics.message_count == count
    assert all(index.message_index_offsets for index in summary.chunk_indexes)
    for channel in summary.channels.values():
        assert channel.message_encoding == 'cdr'
        assert summary.schemas[channel.schema_id].encoding == 'ros2msg'
        check_text(channel.metadata.get('topic_type_hash', ''))
        if text := channel.metadata['offered_qos_profiles']:
            check_qos(yaml.safe_load(text))


def test_a_recorded_bag_is_as_jazzy_asks(tmp_path):
    said = check(ours(tmp_path / 'bag', a_run(phases=12), split_bytes=130_000))
    assert len(said['files']) > 2
    topics = said['topics_with_message_count']
    assert all(t['topic_metadata']['type_description_hash'].startswith('RIHS01_') for t in topics)


@pytest.mark.parametrize('writer', ['ours', 'rosbags-sqlite-8', 'rosbags-mcap', 'mcap-zstd'])
def test_a_recovered_bag_is_as_jazzy_asks_whoever_wrote_the_old_one(writer, tmp_path):
    recover(WRITERS[writer](tmp_path / 'bag', a_run()), tmp_path / 'new')
    check(tmp_path / 'new')
