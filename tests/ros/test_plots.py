"""Each number of a run on a topic of its own, as plotting tools subscribe to it: by name."""

import time

import pytest
import rclpy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64

from codetr_ros.config import load
from codetr_ros.cores import in_process
from codetr_ros.records import EpisodeResult, Metrics, metrics
from codetr_ros.ros.link import Link
from codetr_ros.ros.plots import OF_EPISODES, topic
from helpers.builders import tiny
from helpers.layout import layout, plotted
from helpers.summaries import episode

DEADLINE = 120.0  # [s]


@pytest.fixture
def links():
    arguments = ['test', '--ros-args', '-r', '__ns:=/run_x']
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    made = [Link('learner'), Link('rqt_plot')]
    for link in made:
        link.advertise(['metrics', 'episodes'], load('quick'))
    yield made
    for link in made:
        link.close()
    rclpy.shutdown()


def until(links, found) -> None:
    end = time.monotonic() + DEADLINE
    while not found():
        assert time.monotonic() < end
        for link in links:
            link.handle(0.01)


def test_a_tool_that_knows_nothing_of_this_project_receives_the_numbers_by_name(links):
    learner, tool = links
    learner.publish(metrics('x', 'learner', '/run_x/learner', 0, 1000, {'critic_loss': 9.0}))
    learner.publish(episode(purpose='training', true_return=7.0))
    received = []
    for name in ('critic_loss', 'true_return'):
        tool.node.create_subscription(
            Float64,
            f'/run_x/plot/learner/{name}',
            lambda message: tool.store(received.append, message.data),
            10,
        )

    def send() -> bool:  # again and again: that both have met is not known at once
        learner.publish(metrics('x', 'learner', 'l', 1, 2000, {'critic_loss': 0.1, 'q.mean': 2.0}))
        learner.publish(episode(true_return=-7.25))
        return {0.1, -7.25} <= set(received)

    until(links, send)
    types = dict(tool.node.get_topic_names_and_types())
    assert types['/run_x/plot/learner/critic_loss'] == ['std_msgs/msg/Float64']
    assert '/run_x/plot/learner/q_mean' in types
    for name in OF_EPISODES:
        assert f'/run_x/plot/learner/{name}' in types


@pytest.mark.slow
def test_what_the_layout_for_foxglove_plots_is_published_by_a_run():
    published = set()

    def observe(record) -> None:
        if isinstance(record, Metrics):
            node = record.node.rsplit('/', 1)[-1]
            published.update(f'/codetr/{topic(node, name)}' for name in record.names)
        elif isinstance(record, EpisodeResult):
            published.update(f'/codetr/{topic(record.source, name)}' for name in OF_EPISODES)

    in_process.run(tiny(steps=600), 'r', None, observe)
    assert len(plotted()) >= 6
    assert plotted() <= published


def test_every_panel_of_the_layout_is_placed():
    shipped = layout()

    def placed(place) -> set[str]:
        if isinstance(place, str):
            return {place}
        return placed(place['first']) | placed(place['second'])

    assert placed(shipped['layout']) == set(shipped['configById'])
