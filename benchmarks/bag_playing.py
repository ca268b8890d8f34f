"""Measure `codetr bag play` with a live reward node whose method learns nothing, for `bags.py`."""

import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import machine
from codetr_ros.config import Settings
from codetr_ros.processes import launcher

BEGUN, LEARNT = 'phase 0 is played', 'everything is played and learnt from'
"""The player prints these at the first commit, and when its last phase has been handled."""


def available() -> bool:
    """Whether ROS is there."""
    return importlib.util.find_spec('rclpy') is not None


def play(bag: Path, settings: Settings, logs: Path) -> tuple[float, float]:
    """Play a bag to a reward node of its own.

    Args:
        bag: the bag.
        settings: of its run.
        logs: folder for the reward node's log.

    Returns:
        Seconds, and CPU seconds of both processes, from the first commit played to the last phase
        handled, without the start.
    """
    namespace = f'/bench_{os.getpid()}'
    environment = launcher.environment(settings)
    reward = launcher.Command(
        'reward',
        'reward',
        (str(launcher.executable('reward')), '--ros-args', '-r', f'__ns:={namespace}'),
    )
    command = [sys.executable, '-m', 'codetr_ros.cli', 'bag', 'play', str(bag)]
    with launcher.Processes(print) as processes:
        processes.start([reward], logs, environment)
        with subprocess.Popen(
            [*command, '--namespace', namespace],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        ) as player:
            both = player.pid, processes.nodes[0].process.pid
            spent, output = _watch(player, both)
            code = player.wait()
        log = (logs / 'reward.log').read_text()
        if code or len(spent) != 2 or 'refused' in log or 'incomplete' in log:
            raise SystemExit(f'not everything was played and received:\n{"".join(output)}{log}')
        processes.nodes[0].process.wait(launcher.STOP_DEADLINE)
    (began, cpu), (ended, cpu_then) = spent
    return ended - began, cpu_then - cpu


def _watch(
    player: 'subprocess.Popen[str]', both: tuple[int, int]
) -> tuple[list[tuple[float, float]], list[str]]:
    """The clock and the CPU seconds when the player prints BEGUN or LEARNT, and its output."""
    spent, output = [], []
    assert player.stdout
    for line in player.stdout:
        output.append(line)
        if BEGUN in line or LEARNT in line:
            spent.append((time.perf_counter(), sum(map(machine.cpu_seconds, both))))
    return spent, output
