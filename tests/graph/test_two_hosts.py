"""A run on two hosts that share no memory, over a network that loses, doubles and is cut."""

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.nodes.signing import new_key
from helpers import hosts, slow_robots
from helpers.builders import tiny
from helpers.hosts import Hosts, Weather
from helpers.nodes import Nodes, domain
from helpers.runs import finish, start, write

pytestmark = pytest.mark.slow

LOST, DOUBLED, DELAY = 0.05, 0.05, 0.01
CUT_SECONDS = 5.0


def test_a_run_on_two_hosts_over_a_bad_network_ends_with_the_same_weights(tmp_path, monkeypatch):
    if why := hosts.why_not():
        pytest.skip(why)
    settings = tiny(steps=1000, evaluate_every=0, task=slow_robots.POINT)
    alone = start(write(settings, tmp_path / 'alone'), tmp_path / 'alone', '--in-process')
    expected, _ = finish(alone, tmp_path / 'alone')
    # slow from the midst of the second phase on, until the network was cut
    held = slow_robots.Held(tmp_path, 0.05, after=300)
    for name, value in held.variables.items():
        monkeypatch.setenv(name, value)
    with (
        domain(),
        Hosts(Weather(LOST, DOUBLED, DELAY)) as both,
        Nodes(settings, tmp_path / 'run', both.starter({'sim': 0}), new_key()) as nodes,
    ):
        for name in nodes.names:
            nodes.start(name)
        both.cut_amid_a_phase(nodes, 1, CUT_SECONDS)
        held.let_go()
        codes = nodes.wait()
    assert set(codes.values()) == {0}, [nodes.log(name) for name in nodes.names]
    assert both.lost > 0
    assert nodes.report('learner')['policy_sha256'] == expected['policy_sha256']
    assert nodes.report('reward')['reward_model_sha256'] == expected['reward_model_sha256']
