"""Starts, watches and ends the processes of a run over topics. No ROS in here.

However the parent ends, no process outlives it. Each is asked to end (SIGINT) and killed after a
deadline. If the parent itself is killed, the kernel sends them SIGINT.
"""

import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Protocol

from codetr_ros.config import Settings
from codetr_ros.processes import middleware
from codetr_ros.processes.openmp import threading_environment
from codetr_ros.records import roles
from codetr_ros.runs import folder as run_folder
from codetr_ros.system import modules

STOP_DEADLINE = 20.0
"""Seconds from SIGINT to SIGKILL, in which a node ends its slice and writes a checkpoint."""
HURRIED_DEADLINE = 2.0
"""The same after a second Ctrl-C."""
ROBOT_NODE = 'robot'
"""The executable, and the node, that drives a robot in place of a simulator."""
_POLL = 0.02  # seconds between checks of processes that are to end


class LaunchError(RuntimeError):
    """A process that cannot be started: the message names it and the remedy."""


@dataclass(frozen=True)
class Command:
    """One process to start.

    Attributes:
        name: its name for people; its log is `<name>.log`.
        role: one of `records.ROLES`.
        arguments: the path of the executable and its arguments.
    """

    name: str
    role: str
    arguments: tuple[str, ...]


def executable(
    role: str, environ: Mapping[str, str] = os.environ, program: str | None = None
) -> Path:
    """Find a node's executable: in this environment's prefix, else through AMENT_PREFIX_PATH.

    Raises:
        LaunchError: it is in none of them; names the places, and how to build or source the
            workspace.
    """
    package, name = roles.TABLE[role].package, program or roles.TABLE[role].executable
    prefixes = [sys.prefix, *filter(None, environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))]
    for prefix in prefixes:
        path = Path(prefix) / 'lib' / package / name
        if os.access(path, os.X_OK) and path.is_file():
            return path
    raise LaunchError(
        f'the node executable {package}/{name} is in none of {", ".join(dict.fromkeys(prefixes))} '
        f'(as lib/{package}/{name}). Nodes need ROS 2 and the built workspace: `make setup` '
        'brings both (on a ROS installation, `colcon build` and `. install/setup.bash`), '
        'or train without nodes with --in-process'
    )


def namespace_of(run_id: str) -> str:
    """The namespace of a run unless the user names another."""
    return f'/run_{run_id}'


def commands(
    settings: Settings,
    run_id: str,
    folder: Path,
    environ: Mapping[str, str] = os.environ,
    *,
    namespace: str | None = None,
    peer_deadline: float | None = None,
    leave_out_after: float | None = None,
    robot: Mapping[str, str | bool] | None = None,
) -> list[Command]:
    """The processes of a run, in the order in which they start; any order would do.

    Args:
        settings: the run's settings.
        run_id: its name.
        folder: its folder.
        environ: the environment in which the executables are looked for.
        namespace: that of the run; None: `namespace_of(run_id)`.
        peer_deadline: seconds that nodes wait for each other, 0 for ever; None: as they do by
            themselves.
        leave_out_after: seconds of silence after which the recorder leaves a simulator of several
            out, 0 never; None: as it does by itself.
        robot: parameters of the robot node, where the task is that of a robot.

    Raises:
        LaunchError: an executable is missing.
    """
    names = (ROBOT_NODE,) if settings.on_robot else settings.simulator_names
    nodes = [(name, 'sim') for name in names]
    nodes += [(role, role) for role in settings.roles if role != 'sim']
    processes = []
    for name, role in nodes:
        program = ROBOT_NODE if name == ROBOT_NODE else None
        arguments = [str(executable(role, environ, program)), '--ros-args']
        arguments += ['-r', f'__ns:={namespace or namespace_of(run_id)}']
        if role == 'sim' and name not in ('sim', ROBOT_NODE):
            arguments += ['-r', f'__node:={name}']
        parameters: dict[str, str | bool] = {'folder': str(folder)}
        if name == ROBOT_NODE:
            parameters |= robot or {}
        if role == 'learner':
            parameters |= {'config': str(folder / run_folder.CONFIG), 'run_id': run_id}
        for parameter, value in parameters.items():
            # ROS reads the value as YAML: without quotes, blanks and colons in a path break it.
            arguments += ['-p', f'{parameter}:={json.dumps(value, ensure_ascii=False)}']
        if peer_deadline is not None:
            arguments += ['-p', f'peer_deadline:={float(peer_deadline)}']
        if leave_out_after is not None and role == 'record':
            arguments += ['-p', f'leave_out_after:={float(leave_out_after)}']
        processes.append(Command(name, role, tuple(arguments)))
    return processes


def environment(settings: Settings, environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """The environment of a run's processes: that of this process, and what the run needs."""
    return {
        **middleware.DEFAULTS,
        'PYTHONUNBUFFERED': '1',
        **environ,
        **threading_environment(settings, environ),
        **module_environment(settings, environ),
    }


def module_environment(
    settings: Settings, environ: Mapping[str, str] = os.environ
) -> dict[str, str]:
    """The variable with which another process finds the module of a task `module:id`, as this one
    did.
    """
    module = modules.of_task(settings.task)
    path = '' if module is None else modules.search_path(module, environ.get('PYTHONPATH', ''))
    return {'PYTHONPATH': path} if path else {}


def end_with_parent(number: signal.Signals = signal.SIGINT) -> Callable[[], None] | None:
    """The function that a child calls between fork and exec, so as not to outlive its parent.

    Linux only (elsewhere None): prctl(PR_SET_PDEATHSIG) makes the kernel send the signal when the
    parent dies (to be exact: the thread that started the child), also by SIGKILL. Everything is
    looked up here, because between fork and exec only the call itself is safe.

    Args:
        number: the signal; after SIGINT the child can still save its state.
    """
    if not sys.platform.startswith('linux'):
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    set_parent_death_signal = 1  # linux/prctl.h
    parent = os.getpid()

    def call() -> None:
        prctl(set_parent_death_signal, int(number), 0, 0, 0)
        if os.getppid() != parent:  # it died before the call: the signal will never come
            os._exit(1)

    return call


class Process(Protocol):
    """A started process: the part of `subprocess.Popen` that is needed."""

    @property
    def pid(self) -> int:
        """Its process id."""

    def poll(self) -> int | None:
        """Exit code (negative: the signal that ended it); None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it has ended; returns its exit code."""


Start = Callable[[Sequence[str], Mapping[str, str], BinaryIO], Process]
"""Starts a process from its path and arguments, its environment and its log."""


def start_program(
    arguments: Sequence[str],
    environment: Mapping[str, str],
    log: BinaryIO,
    keep_open: Sequence[int] = (),
) -> Process:
    """Start a program that ends when we do, in a session of its own (Ctrl-C reaches only us).

    Args:
        arguments: its path, and its arguments.
        environment: its environment.
        log: takes what it prints.
        keep_open: descriptors of files that stay open as long as it runs.

    Raises:
        OSError: it cannot be started.
    """
    return subprocess.Popen(
        arguments,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        env=dict(environment),
        start_new_session=True,
        pass_fds=keep_open,
        # One system call, looked up before: safe beside ROS's threads.
        preexec_fn=end_with_parent(),  # noqa: PLW1509
    )


@dataclass
class Node:
    """A process that was started."""

    command: Command
    process: Process
    log: Path
    asked: bool = False  # we sent it a signal to end
    killed: bool = False  # we killed it, because it did not end when asked
    excused: bool = False  # its end is no failure: it had done everything, or is not needed

    @property
    def name(self) -> str:
        """Its name for people."""
        return self.command.name

    @property
    def role(self) -> str:
        """One of `records.ROLES`."""
        return self.command.role

    @property
    def code(self) -> int | None:
        """Exit code (negative: the signal that ended it); None while it runs."""
        return self.process.poll()

    @property
    def unasked_failure(self) -> bool:
        """Whether it ended with an error without being asked to end."""
        return self.code not in (None, 0) and not self.asked and not self.excused

    def how_it_ended(self) -> str:
        """How it ended, for people."""
        code = self.code
        if code is None:
            return f'{self.name} is running'
        if code >= 0:
            return f'{self.name} ended with exit code {code}'
        try:
            return f'{self.name} was ended by {signal.Signals(-code).name}'
        except ValueError:
            return f'{self.name} was ended by signal {-code}'

    def interrupt(self) -> None:
        """Ask it to end."""
        self.asked = True
        if self.code is None:  # not waited for yet, so no other process can have its id
            os.kill(self.process.pid, signal.SIGINT)


def end_of_log(path: Path, lines: int = 15) -> str:
    """The last lines of a log, for people; empty if there are none."""
    try:
        with path.open('rb') as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - 20_000))
            text = file.read().decode(errors='replace')
    except OSError as error:
        return f'({path} cannot be read: {error.strerror})'
    return '\n'.join(text.rstrip().splitlines()[-lines:])


@dataclass
class Processes:
    """All processes of a run. A context manager: on leaving it, no process is left.

    Attributes:
        log: prints a line for people, such as that a process did not end.
        hurry: whether the user has asked again; deadlines are then short.
        start_program: starts each process.
    """

    log: Callable[[str], None]
    hurry: Callable[[], bool] = lambda: False
    stop_deadline: float = STOP_DEADLINE
    start_program: Start = start_program
    nodes: list[Node] = field(default_factory=list)
    _environment: dict[str, str] = field(default_factory=dict)

    def start(self, commands: Iterable[Command], logs: Path, env: Mapping[str, str]) -> None:
        """Start processes, each with a log, to which it appends.

        Raises:
            LaunchError: one cannot be started; those started before it still run (see `stop`).
        """
        self._environment = dict(env)
        for command in commands:
            log = logs / f'{command.name}.log'
            self.nodes.append(Node(command, self._begin(command, log), log))

    def start_again(self, node: Node) -> None:
        """Start a process again that has ended; its log goes on.

        Raises:
            LaunchError: it cannot be started.
        """
        assert node.code is not None
        node.process = self._begin(node.command, node.log)

    def _begin(self, command: Command, log: Path) -> Process:
        with log.open('ab') as file:
            file.write(f'$ {shlex.join(command.arguments)}\n'.encode())
            file.flush()
            try:
                return self.start_program(command.arguments, self._environment, file)
            except OSError as error:
                what = f'{command.name} ({command.arguments[0]})'
                raise LaunchError(f'{what} cannot be started: {error.strerror}') from error

    def running(self) -> list[Node]:
        """The processes that have not ended."""
        return [node for node in self.nodes if node.code is None]

    def stop(self) -> None:
        """Ask all that run to end, the recorder last so that it misses nothing."""
        self._end([node for node in self.running() if node.role != 'record'])
        self._end(self.running())

    def kill(self, nodes: Sequence[Node]) -> None:
        """End processes at once, with all that they have started."""
        for node in nodes:
            if node.code is None:
                node.killed = node.asked = True
                # Not waited for yet, so no other process can have its id.
                os.killpg(node.process.pid, signal.SIGKILL)
                node.process.wait()

    def _end(self, nodes: Sequence[Node]) -> None:
        for node in nodes:
            node.interrupt()
        began = time.monotonic()
        while waiting := [node for node in nodes if node.code is None]:
            limit = (
                min(self.stop_deadline, HURRIED_DEADLINE) if self.hurry() else self.stop_deadline
            )
            if time.monotonic() - began > limit:
                for node in waiting:
                    self.log(f'{node.name} did not end {limit:g} s after SIGINT: killing it')
                self.kill(waiting)
                return
            time.sleep(_POLL)

    def __enter__(self) -> 'Processes':
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self.running():
                self.stop()
        finally:
            self.kill(self.running())
