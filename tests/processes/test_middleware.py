"""The middleware's settings of a process that must not wait for others where it sends."""

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from codetr_ros.processes import middleware

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'


def test_on_this_host_alone_a_profile_stands_in_place_of_shared_memory():
    environ = {RANGE: 'LOCALHOST'}
    middleware.avoid_shared_memory('rmw_fastrtps_cpp', environ)
    assert environ[RANGE] == 'SYSTEM_DEFAULT', 'else shared memory is added'
    profile = ET.parse(Path(environ[middleware.PROFILE]))
    kinds = [e.text for e in profile.iter() if e.tag.endswith('}type')]
    addresses = {e.text for e in profile.iter() if e.tag.endswith('}address')}
    assert kinds == ['UDPv4']
    assert addresses == {'127.0.0.1'}, 'else other hosts could reach it'


def test_beyond_this_host_the_range_stays():
    environ = {RANGE: 'SUBNET'}
    middleware.avoid_shared_memory('rmw_fastrtps_cpp', environ)
    assert environ == {RANGE: 'SUBNET', 'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'}


@pytest.mark.parametrize(
    ('implementation', 'chosen'),
    [
        ('rmw_cyclonedds_cpp', {}),  # would look beyond this host, and read no profile
        ('rmw_fastrtps_cpp', {'FASTDDS_BUILTIN_TRANSPORTS': 'LARGE_DATA'}),
        ('rmw_fastrtps_cpp', {'FASTRTPS_DEFAULT_PROFILES_FILE': '/my.xml'}),
        ('rmw_fastrtps_cpp', {'ROS_STATIC_PEERS': '10.0.0.2'}),
    ],
)
def test_another_middleware_and_what_the_user_has_chosen_are_left_alone(implementation, chosen):
    environ = {RANGE: 'LOCALHOST'} | chosen
    middleware.avoid_shared_memory(implementation, environ)
    assert environ == {RANGE: 'LOCALHOST'} | chosen
