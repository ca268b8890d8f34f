"""What a node that is asked to end takes for the reason of others' ends."""

import threading
from dataclasses import replace

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.records import Presence
from codetr_ros.ros import membership
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.signals import Stop
from codetr_ros.system.liveness import own_name


@pytest.fixture
def member(play):
    play(roles=())
    made = Membership('reward', 'reward', Stop())
    made.link.subscribe(Presence, made.take)
    yield made
    made.close()


@pytest.fixture
def ended(member, play):
    """The presence of a simulator whose process is gone, and who publishes for it."""
    play = play(roles=('sim',))
    name = f'{own_name()}0'  # of this process, had it begun at another time
    there = replace(play.presence_now('sim'), node='/r/ended', instance_id=f'its {name}')
    publisher = play.links['sim']
    play.until(lambda: not publisher.unmatched(['presence'], lambda _: {'/r/reward'}, True))
    member.peers.note(there, 0.0)
    assert member.peers.failed() == ['sim /r/ended has died']
    return there, publisher


def test_a_last_presence_that_is_on_its_way_is_waited_for(member, ended):
    there, publisher = ended
    on_its_way = threading.Timer(0.3, publisher.publish, [replace(there, finished=True)])
    on_its_way.start()
    member.hear_out()
    on_its_way.join()
    assert member.peers.failed() == []


def test_a_node_that_leaves_no_last_presence_has_died(member, ended, monkeypatch):
    monkeypatch.setattr(membership, 'HEARS_OUT', 3)
    member.hear_out()
    assert member.peers.failed() == ['sim /r/ended has died']
