"""The reward node, whose imports never end, or whose first slice does not."""

import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from codetr_ros.cores.core import Silent
from codetr_ros.records.roles import subscribed
from codetr_ros.ros.signals import Stop


def load() -> Callable[..., Any]:
    print('imports', file=sys.stderr, flush=True)
    while True:  # in pieces, as the import of many modules is
        time.sleep(0.01)


class Compiles(Silent):
    """A core whose first slice never ends."""

    subscribes = subscribed('reward')
    finished = False

    def work(self) -> Iterator[None]:
        load()
        yield


def compiling() -> int:
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('reward', 'reward', lambda: lambda *_, **__: Compiles(), stop=stop)


def main() -> int:
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('reward', 'reward', load, stop=stop)
