"""Nodes of others in the domain of a run: they start, and end, are killed, or are held and killed.

    .venv/bin/python benchmarks/strangers.py SECONDS [SECONDS BEFORE]

Three at a time, each with five topics. Every few seconds one of them leaves, by turns in each way
that a node can leave. What is held counts as alive for the middleware of others.
"""

import random
import signal
import subprocess
import sys
import time

AT_A_TIME = 3
HELD = 4.0  # [s] before it is killed
APART = 3.0  # [s] between two starts
WAYS = ('ended', 'killed', 'held and killed')
NODE = """
import os, rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node(f'stranger_{os.getpid()}')
topics = [f'strangers/topic_{number}' for number in range(5)]
publishers = [node.create_publisher(String, topic, 10) for topic in topics]
kept = [node.create_subscription(String, topic, lambda m: None, 10) for topic in topics]
node.create_timer(0.1, lambda: [p.publish(String(data=100 * 'x')) for p in publishers])
try:
    rclpy.spin(node)
except (ExternalShutdownException, KeyboardInterrupt):
    pass
"""


def main() -> int:
    """Let nodes come and go."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # none of them stays
    time.sleep(float(sys.argv[2]) if len(sys.argv) > 2 else 0.0)
    end, draw = time.monotonic() + float(sys.argv[1]), random.Random(0)
    there: list[subprocess.Popen[bytes]] = []
    try:
        while time.monotonic() < end:
            there.append(subprocess.Popen([sys.executable, '-c', NODE]))
            time.sleep(APART)
            if len(there) > AT_A_TIME:
                leave(there.pop(draw.randrange(len(there))), draw.choice(WAYS))
    finally:
        for process in there:
            process.kill()
    return 0


def leave(process: 'subprocess.Popen[bytes]', way: str) -> None:
    """Let one of them leave."""
    print(f'{way}: {process.pid}', flush=True)
    if way == 'ended':
        process.send_signal(signal.SIGINT)
    else:
        if way != 'killed':
            process.send_signal(signal.SIGSTOP)
            time.sleep(HELD)
        process.kill()
    process.wait()


if __name__ == '__main__':
    sys.exit(main())
