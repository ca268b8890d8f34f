"""Processes forked from one that has imported everything: the nodes of a run start in a moment.

What runs in them is what the executables run, with ROS, its middleware and its discovery. They
share nothing with each other that separate processes would not: their memory is a copy.
"""

import json
import os
import secrets
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, BinaryIO

from codetr_ros.cli import train
from codetr_ros.processes import launcher
from helpers import holding

READ_AT_IMPORT = {'OMP_NUM_THREADS': '1'}
"""What the fork server has imported with: no child of it can have this otherwise."""
address: str | None = None
"""Where the fork server listens: started when first needed, inherited by its children."""
_server: subprocess.Popen[bytes] | None = None


def start_server() -> str:
    """Start the fork server of this process; where it listens."""
    name = f'codetr-tests-{os.getpid()}-{secrets.token_hex(4)}'
    server = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name('fork_server.py')), name],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | READ_AT_IMPORT | {'OMP_WAIT_POLICY': 'PASSIVE'},
        start_new_session=True,
    )
    assert server.stdout
    assert server.stdout.readline() == b'ready\n', 'the fork server has not started'
    global _server  # noqa: PLW0603
    _server = server
    return '\0' + name  # an abstract address: no file


def end_server() -> None:
    """End the fork server, if there is one, and its children with it."""
    global address, _server  # noqa: PLW0603
    if _server is not None:
        assert _server.stdin
        _server.stdin.close()
        _server.wait(60)
        address = _server = None


class Forked:
    """A process, with what the tests use of `subprocess.Popen`.

    Args:
        arguments: the path of the program's script (in `bin`, or in `lib/<package>`) and its
            arguments.
        environment: all of it.
        output: where its standard output and its standard error go; None: into the pipe `stdout`.
        function: `module:name` of the main function, where no script has it.
        folder: where it starts.
        death: the signal that it gets when this process ends before it.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        output: BinaryIO | None = None,
        function: str | None = None,
        folder: Path | None = None,
        death: signal.Signals = signal.SIGKILL,
    ) -> None:
        for name, value in READ_AT_IMPORT.items():
            if environment.get(name, value) != value:
                raise ValueError(
                    f'{name} = {environment[name]}: a fork has {value} for good; start this one '
                    'as an executable'
                )
        global address  # noqa: PLW0603 - one server for all tests of a worker
        if address is None:
            address = start_server()
        self.args = list(arguments)
        self.returncode: int | None = None
        self.stdout: IO[str] | None = None
        wish = {
            'arguments': self.args,
            'environment': dict(environment),
            'folder': str(folder or Path.cwd()),
            'death': int(death),
        } | ({'function': function} if function else {})
        text = json.dumps(wish).encode()
        if output is None:
            read, write = os.pipe()
            self.stdout = open(read, encoding='utf-8')  # noqa: SIM115
        else:
            write = os.dup(output.fileno())
        self._server = socket.socket(socket.AF_UNIX)
        self._server.connect(address)
        socket.send_fds(self._server, [len(text).to_bytes(8, 'big')], [write])
        os.close(write)
        self._server.sendall(text)
        self._lines = self._server.makefile('rb', buffering=0)
        self.pid = int(self._lines.readline())
        self._reader: threading.Thread | None = None
        self._read: list[str] = []

    def poll(self) -> int | None:
        """Exit code (negative: the signal that ended it), None while it runs."""
        try:
            return self.wait(0)
        except subprocess.TimeoutExpired:
            return None

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it has ended; its exit code."""
        if self.returncode is None:
            if not select.select([self._server], [], [], timeout)[0]:
                assert timeout is not None
                raise subprocess.TimeoutExpired(self.args, timeout)
            self.returncode = int(self._lines.readline())
            self._lines.close()
            self._server.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, if it has not ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[str, None]:
        """Read its output to the end and wait for it; the output, and nothing beside it."""
        assert self.stdout is not None
        if self._reader is None:
            self._reader = threading.Thread(
                target=lambda: self._read.append(self.stdout.read()), daemon=True
            )
            self._reader.start()
        end = None if timeout is None else time.monotonic() + timeout
        self._reader.join(timeout)
        if self._reader.is_alive():
            assert timeout is not None
            raise subprocess.TimeoutExpired(self.args, timeout)
        self.wait(None if end is None else max(0.0, end - time.monotonic()))
        self.stdout.close()
        return self._read[0], None


def start_program(
    arguments: Sequence[str], environment: Mapping[str, str], log: BinaryIO
) -> launcher.Process:
    """Fork what the launcher would start, with the same death: see `launcher.start_program`. The
    learner of a run that is held by a test is the one that can be held.
    """
    held = holding.VARIABLE in environment and Path(arguments[0]).name == 'learner'
    function = 'helpers.holding:learner' if held else None
    return Forked(arguments, environment, log, function, death=signal.SIGINT)


def codetr(*arguments: str, environment: Mapping[str, str], **options: Any) -> Forked:
    """Fork the command `codetr`; the nodes of `codetr train` are forked as well."""
    function = {'function': 'helpers.forked:_train'} if arguments[0] == 'train' else {}
    script = str(Path(sys.prefix) / 'bin' / 'codetr')
    return Forked((script, *arguments), environment, **function, **options)


def _train() -> int:
    return train.main(sys.argv[2:], start_program)
