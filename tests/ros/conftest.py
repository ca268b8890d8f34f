import pytest
import rclpy
from rclpy.signals import SignalHandlerOptions

from helpers.builders import tiny
from helpers.playing import NAMESPACE, Play


@pytest.fixture
def play(ros_domain):
    made = []
    rclpy.init(
        args=['test', '--ros-args', '-r', f'__ns:={NAMESPACE}'],
        signal_handler_options=SignalHandlerOptions.NO,
    )

    def start(**options):
        settings = options.pop(
            'settings', tiny(steps=5, phase_steps=5, warmup_steps=5, evaluate_every=0)
        )
        made.append(Play(settings, **options))
        return made[-1]

    yield start
    for one in made:
        one.close()
    rclpy.try_shutdown()
