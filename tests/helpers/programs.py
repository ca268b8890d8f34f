"""Small programs that a launcher starts: they end when asked, or do not."""

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from codetr_ros.processes.launcher import Command, Processes

PATIENCE = 120.0  # seconds after which a test gives up; nothing waits for it to pass


READY = 'import signal, sys, time\n'


ENDS_WHEN_ASKED = """
def end(*_):
    with open(sys.argv[1], 'a') as file:
        print(sys.argv[2], file=file)
    sys.exit(0)
signal.signal(signal.SIGINT, end)
"""


DEAF = 'signal.signal(signal.SIGINT, signal.SIG_IGN)\n'


WAIT = "print('ready', flush=True)\nwhile True: time.sleep(60)\n"


class Said(list[str]):
    """What people are told."""

    def __call__(self, text: str) -> None:
        self.append(text)


def python(name: str, program: str, *arguments: object, role: str | None = None) -> Command:
    # -S -E: without site-packages a child starts in a fraction of the time.
    call = (sys.executable, '-S', '-E', '-c', program, *map(str, arguments))
    return Command(name, role or name, call)


def wait_until(true: Callable[[], bool], what: str) -> None:
    give_up = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < give_up, f'waited {PATIENCE} s for {what}'
        threading.Event().wait(0.005)


def start(processes: Processes, logs: Path, *commands: Command) -> None:
    """Start them and wait until each that says so is ready for signals."""
    processes.start(commands, logs, os.environ)
    for node in processes.nodes:
        if 'ready' in node.command.arguments[4]:
            wait_until(lambda n=node: 'ready\n' in n.log.read_text(), f'{node.name} to be ready')


def exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def poll(processes: Processes) -> Callable[[], None]:
    """For `supervise`: hands nothing on, and fails rather than hang."""
    give_up = time.monotonic() + PATIENCE

    def look() -> None:
        assert time.monotonic() < give_up, [node.how_it_ended() for node in processes.nodes]
        threading.Event().wait(0.005)

    return look
