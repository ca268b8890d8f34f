"""The reward node, whose imports never end."""

import sys
import time
from collections.abc import Callable
from typing import Any

from codetr_ros.ros.signals import Stop


def load() -> Callable[..., Any]:
    print('imports', file=sys.stderr, flush=True)
    while True:  # in pieces, as the import of many modules is
        time.sleep(0.01)


def main() -> int:
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('reward', 'reward', load, stop=stop)
