"""A process that has imported torch and the library, and forks others that start at once.

It serves one worker of the tests (see `forked`) and ends with it. It imports nothing of ROS, whose
libraries start threads when they are loaded: it has one thread only, so what it forks is whole,
and each of its children loads ROS for itself. In a child the call stack unwinds to the end of this
file: the child then does what the program's own script does.
"""

import atexit
import contextlib
import ctypes
import gc
import importlib
import io
import json
import os
import random
import selectors
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, NoReturn

IMPORTED = (
    'torch._dynamo',  # by the first optimiser
    'torch.utils._device',
    'gymnasium.envs.mujoco',
    'lark',
    'matplotlib.backends.backend_agg',
    'matplotlib.figure',
    'scipy.stats',
    'tyro',
    'codetr_ros.benchmark.run',
    'codetr_ros.cli.bag_play',
    'codetr_ros.cli.train',
    'codetr_ros.cores.in_process',
    'codetr_ros.bags.verify',
    'learner_node.learner',
    'reward_node.reward',
    'sim_node.evaluate',
    'sim_node.robot',
    'sim_node.sim',
)
"""What takes long and is of no ROS."""
MIB = 1 << 20


class Child:
    """One forked process, and the socket of who asked for it."""

    def __init__(self, pid: int, asked: socket.socket, death: int) -> None:
        self.pid = pid
        self.asked = asked
        self.death = death  # the signal that it gets when who asked for it is gone
        self.ending = os.pidfd_open(pid)
        self.ended = self.abandoned = self.gone = False

    def send_status(self) -> None:
        """Send its exit code. Until `release` it is a zombie, whose number is nobody else's."""
        self.ended = True
        if self.abandoned:
            self.release()
            return
        status = os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)
        assert status is not None
        exited = status.si_code == os.CLD_EXITED
        with contextlib.suppress(OSError):  # who asked for it has gone
            self.asked.sendall(f'{status.si_status if exited else -status.si_status}\n'.encode())

    def let_go(self) -> None:
        """Who asked for it has its exit code, or has ended: then it ends as well."""
        self.asked.close()
        if self.ended:
            self.release()
        else:
            self.abandoned = True
            os.kill(self.pid, self.death)

    def release(self) -> None:
        """Wait for it: nobody will ask any more."""
        os.waitpid(self.pid, 0)
        os.close(self.ending)
        self.gone = True


def request(asked: socket.socket) -> tuple[dict[str, Any], int]:
    """Receive what is to be started: its description and the descriptor of its output."""
    head, (output,), _, _ = socket.recv_fds(asked, 8, 1)
    size = int.from_bytes(head, 'big')
    text = b''
    while len(text) < size:
        text += asked.recv(min(MIB, size - len(text)))
    return json.loads(text), output


def serve(listener: socket.socket) -> tuple[dict[str, Any], int] | None:
    """Fork whatever is asked for.

    Returns:
        In a child, what it is to do and the descriptor of its output; None once the worker of the
        tests has closed the standard input.
    """
    selector = selectors.DefaultSelector()
    selector.register(listener, selectors.EVENT_READ)
    selector.register(sys.stdin, selectors.EVENT_READ)
    children: set[Child] = set()
    while True:
        for key, _ in selector.select():
            if key.fileobj is sys.stdin:
                return None  # and so do the children: see `become`
            if key.fileobj is listener:
                asked, _ = listener.accept()
                wish, output = request(asked)
                pid = os.fork()
                if pid == 0:
                    selector.close()
                    listener.close()
                    asked.close()
                    for child in children:
                        child.asked.close()
                        os.close(child.ending)
                    return wish, output
                os.close(output)
                asked.sendall(f'{pid}\n'.encode())
                child = Child(pid, asked, wish['death'])
                children.add(child)
                selector.register(child.ending, selectors.EVENT_READ, child)
                selector.register(asked, selectors.EVENT_READ, child)
            elif key.fileobj == key.data.ending:
                selector.unregister(key.fileobj)
                key.data.send_status()
            else:  # nothing is ever sent: the other end was closed
                selector.unregister(key.fileobj)
                key.data.let_go()
            children = {child for child in children if not child.gone}


def become(wish: dict[str, Any], output: int) -> Callable[[], int | None]:
    """Make this child what a new process would be, and return its main function."""
    ctypes.CDLL(None).prctl(1, int(signal.SIGKILL), 0, 0, 0)  # PR_SET_PDEATHSIG: no orphans
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    os.environ.clear()
    os.environ.update(wish['environment'])
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = sys.__stdout__ = stream(1, line_buffering=False)
    sys.stderr = sys.__stderr__ = stream(2, line_buffering=True)
    os.chdir(wish['folder'])
    random.seed()
    importlib.import_module('numpy').random.seed()
    sys.argv = wish['arguments']
    if 'function' in wish:
        module, name = wish['function'].split(':')
        return getattr(importlib.import_module(module), name)
    script = Path(sys.argv[0])
    package = script.parent.name
    scripts = distribution('codetr_ros' if package == 'bin' else package).entry_points.select(
        group='console_scripts'
    )
    return scripts[script.name].load()


def end(program: Callable[[], int | None]) -> NoReturn:
    """Run a program and end as an interpreter does, except that its modules are not taken down.

    That would copy all the pages that it shares with the others: 0.3 s for each process.
    """
    code: object = 1
    try:
        code = program()
    except SystemExit as left:
        code = left.code
    except BaseException:  # noqa: BLE001 - there is nobody above
        traceback.print_exc()
    if code is not None and not isinstance(code, int):
        print(code, file=sys.stderr)
        code = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code or 0)


def stream(descriptor: int, line_buffering: bool) -> io.TextIOWrapper:
    """Standard output or standard error, as the interpreter opens them where no terminal is."""
    unbuffered = bool(os.environ.get('PYTHONUNBUFFERED'))
    return io.TextIOWrapper(
        open(descriptor, 'wb', 0 if unbuffered else -1, closefd=False),
        'utf-8',
        'strict' if descriptor == 1 else 'backslashreplace',
        line_buffering=line_buffering,
        write_through=unbuffered,
    )


def main(address: str) -> int:
    """Import everything, then serve; in a child, run what was asked for."""
    sys.path[0] = str(Path(__file__).parents[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the tests, which then end this
    for name in IMPORTED:
        importlib.import_module(name)
    threads = os.listdir('/proc/self/task')
    assert len(threads) == 1, f'threads would not live on in a fork: {len(threads)}'
    gc.collect()
    gc.freeze()  # nothing writes into the pages that all share
    forked = importlib.import_module('helpers.forked')
    forked.address = address
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen()
        print('ready', flush=True)
        started = serve(listener)
    if started is None:
        return 0
    end(become(*started))


if __name__ == '__main__':
    sys.exit(main('\0' + sys.argv[1]))
