"""The QoS that `ros2 bag record` and `ros2 bag play` are to be given for our topics."""

from pathlib import Path

import pytest
import yaml
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)

from codetr_ros.config import Settings
from codetr_ros.ros import qos

FILE = Path(__file__).parents[2] / 'codetr_ros' / 'config' / 'bag_qos.yaml'
OVERRIDES = yaml.safe_load(FILE.read_text())
POLICIES = {
    'history': HistoryPolicy,
    'reliability': ReliabilityPolicy,
    'durability': DurabilityPolicy,
}


def test_every_topic_that_is_recorded_has_its_qos():
    assert set(OVERRIDES) == {f'/run_1/{topic}' for topic in qos.QUALITIES if topic != 'presence'}


@pytest.mark.parametrize('topic', [topic for topic in qos.QUALITIES if topic != 'presence'])
@pytest.mark.parametrize('overlap', [False, True])
def test_it_fits_the_topic_at_both_ends_and_holds_what_may_be_under_way(topic, overlap):
    given = {
        key: POLICIES[key].get_from_short_key(value) if key in POLICIES else value
        for key, value in OVERRIDES[f'/run_1/{topic}'].items()
    }
    theirs = QoSProfile(**given)
    ours = qos.profile(topic, Settings(overlap=overlap))
    assert theirs.depth >= ours.depth
    assert theirs.durability == ours.durability
    for publisher, reader in ((ours, theirs), (theirs, ours)):
        assert qos_check_compatible(publisher, reader)[0] != QoSCompatibility.ERROR
