"""Two hosts on one machine: namespaces with a network, process ids and a `/dev/shm` of their own,
and a cable between them that loses, delays, doubles and is cut. The kernel need not help with
that: the cable is a thread of this process, which carries frames from one end to the other.

Processes on two hosts cannot look each other up, share no memory, and find each other by
multicast, as those on two machines do.
"""

import heapq
import os
import random
import re
import select
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO

from codetr_ros.processes import launcher
from helpers.nodes import PATIENCE, Nodes

SPACES = ('--net', '--mount', '--pid')
LARGEST_FRAME = 70_000
DISCOVERY = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}


def _unshared() -> list[str]:
    """The command that makes namespaces; who is not root makes one of users, too."""
    user = [] if os.geteuid() == 0 else ['--user', '--map-root-user']
    return ['unshare', *user, *SPACES, '--fork', '--kill-child', '--mount-proc']


@cache
def why_not() -> str:
    """Why there can be no two hosts here; empty if there can be."""
    if lacking := [name for name in ('unshare', 'nsenter', 'ip') if not shutil.which(name)]:
        return f'there is no command {lacking[0]}'
    try:
        with Hosts():
            return ''
    except (OSError, subprocess.SubprocessError) as error:
        return f'namespaces or network devices are not permitted: {error}'


@dataclass
class Weather:
    """What the cable does to frames.

    Attributes:
        lost: share of the frames that never arrive.
        doubled: share of those that arrive twice.
        delay: seconds until one arrives; drawn from half to one and a half of it, so that frames
            overtake each other.
        cut: whether none arrives.
    """

    lost: float = 0.0
    doubled: float = 0.0
    delay: float = 0.0
    cut: bool = False


class Hosts:
    """Two hosts, 0 and 1. A context manager: on leaving it, all their processes are killed.

    Attributes:
        weather: what the cable does; may be changed at any time.
        carried: frames that have arrived.
        lost: frames that have not.

    Args:
        weather: what the cable does.
        seed: of the chances.

    Raises:
        OSError: the system does not permit it; upon entering.
    """

    def __init__(self, weather: Weather | None = None, seed: int = 0) -> None:
        self.weather = weather or Weather()
        self.carried = self.lost = 0
        self._rng = random.Random(seed)
        self._hosts: list[subprocess.Popen[str]] = []
        self._ends: list[int] = []
        self._over = threading.Event()
        self._cable = threading.Thread(target=self._carry, daemon=True)

    def __enter__(self) -> 'Hosts':
        try:
            for number in (1, 2):
                self._make(f'10.77.0.{number}')
        except BaseException:
            self._end()
            raise
        self._cable.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._cable.join()
        self._end()

    def _make(self, address: str) -> None:
        ours, theirs = socket.socketpair()
        program = [sys.executable, str(Path(__file__).with_name('host.py'))]
        with ours:
            self._hosts.append(
                subprocess.Popen(
                    [*_unshared(), *program, address, str(theirs.fileno())],
                    stdin=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    pass_fds=[theirs.fileno()],
                    # the interpreter is started bare: no ROS, nothing of it is needed
                    env={'PATH': os.environ['PATH']},
                )
            )
            theirs.close()
            _, ends, _, _ = socket.recv_fds(ours, 16, 1)
        if not ends:
            self._hosts[-1].kill()
            raise OSError(self._hosts[-1].communicate()[1].strip() or 'a host did not start')
        self._ends += ends

    def _end(self) -> None:
        for host in self._hosts:
            host.kill()
            host.communicate()
        for end in self._ends:
            os.close(end)

    # ---- the cable

    def _carry(self) -> None:
        """Carry frames until it is over."""
        under_way: list[tuple[float, int, int, bytes]] = []  # due, number, end, frame
        number = 0
        while not self._over.is_set():
            wait = min(0.05, max(0.0, under_way[0][0] - time.monotonic())) if under_way else 0.05
            for end in select.select(self._ends, [], [], wait)[0]:
                frame = os.read(end, LARGEST_FRAME)
                other = self._ends[1 - self._ends.index(end)]
                for seconds in self._fate():
                    number += 1
                    heapq.heappush(under_way, (time.monotonic() + seconds, number, other, frame))
            while under_way and under_way[0][0] <= time.monotonic():
                _, _, other, frame = heapq.heappop(under_way)
                self._arrive(other, frame)

    def _fate(self) -> list[float]:
        """After how many seconds a frame arrives: once, twice or not at all."""
        weather, rng = self.weather, self._rng
        if weather.cut or rng.random() < weather.lost:
            self.lost += 1
            return []
        times = 2 if rng.random() < weather.doubled else 1
        return [weather.delay * rng.uniform(0.5, 1.5) for _ in range(times)]

    def _arrive(self, end: int, frame: bytes) -> None:
        if self.weather.cut:
            self.lost += 1
            return
        try:
            os.write(end, frame)
            self.carried += 1
        except OSError:  # the host is gone
            self.lost += 1

    # ---- their processes

    def starter(self, of: Mapping[str, int]) -> launcher.Start:
        """Starts programs on one of the hosts, as `launcher.start_program` does here.

        Args:
            of: host of each program, by the name of its file; others are on host 1.
        """

        def start(
            arguments: Sequence[str], environment: Mapping[str, str], log: BinaryIO
        ) -> launcher.Process:
            enter = self._entering(of.get(Path(arguments[0]).name, 1))
            return launcher.start_program([*enter, *arguments], {**environment, **DISCOVERY}, log)

        return start

    def _entering(self, number: int) -> list[str]:
        """The command before one that is to run on a host."""
        pid = self._hosts[number].pid
        (first,) = Path(f'/proc/{pid}/task/{pid}/children').read_text().split()
        user = [] if os.geteuid() == 0 else ['--user', '--preserve-credentials']
        return ['nsenter', '--target', first, *user, *SPACES, '--']

    def cut_amid_a_phase(self, nodes: Nodes, phase: int, seconds: float) -> None:
        """Cut the cable amid a phase, and mend it later.

        Args:
            nodes: those of the run.
            phase: so many phases are recorded before, at least.
            seconds: how long it stays cut.
        """
        self._wait(lambda: phases_done(nodes) >= phase, nodes)
        self.weather.cut = True
        end = time.monotonic() + seconds
        self._wait(lambda: time.monotonic() > end, nodes)
        self.weather.cut = False

    def _wait(self, found: Callable[[], bool], nodes: Nodes) -> None:
        """Wait until something is so, as long as no node has ended."""
        end = time.monotonic() + PATIENCE
        while not found():
            ended = [name for name, code in nodes.codes().items() if code is not None]
            late = time.monotonic() > end
            assert not ended and not late, f'ended: {ended}; {nodes.log("record")[-2000:]}'
            self._over.wait(0.05)


def phases_done(nodes: Nodes) -> int:
    """Phases that are recorded so far, by the recorder's log."""
    return max(map(int, re.findall(r'phase (\d+) of', nodes.log('record'))), default=-1)
