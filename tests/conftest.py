"""Every test session has a ROS domain of its own, on this host only, before rclpy is imported."""

import os

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'

import pytest


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A ROS domain that no other test uses at the same time, for this test and its processes."""
    coordinator = pytest.importorskip('domain_coordinator', reason='needs ROS')
    with coordinator.domain_id() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        yield int(domain)


@pytest.fixture(autouse=True)
def _own_ros_domain(request: pytest.FixtureRequest) -> None:
    """Tests of the ROS layer and of whole runs get their domain without asking."""
    if {'ros', 'system'} & set(request.path.parent.parts):
        request.getfixturevalue('ros_domain')
