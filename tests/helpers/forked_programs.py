"""What `tests/project/test_forked.py` lets forked processes do."""

import atexit
import os
import random
import sys
import time

import numpy as np

from helpers.forked import Forked


def shows() -> int:
    print(sys.argv, os.environ['CODETR_SEEN'])
    print(os.getcwd())
    print(os.getsid(0), os.getpgid(0))
    print('threads', len(os.listdir('/proc/self/task')))
    return 0


def ends() -> int:
    atexit.register(print, 'at its exit')
    match sys.argv[1]:
        case 'exits':
            sys.exit(4)
        case 'complains':
            sys.exit('no such thing')
        case 'fails':
            raise ZeroDivisionError
    return 3


def waits() -> None:
    print('ready')
    sys.stdout.flush()
    time.sleep(600)


def interrupted() -> None:
    try:
        print(os.getpid())
        time.sleep(600)
    except KeyboardInterrupt:
        print('interrupted')


def asks() -> None:
    """Fork another, which writes where this one does, and wait."""
    import signal

    Forked(
        ('program',),
        os.environ,
        sys.stdout.buffer,
        'helpers.forked_programs:interrupted',
        death=signal.SIGINT,
    ).wait()


def draws() -> None:
    print(random.random(), np.random.random())  # noqa: NPY002 - the shared one is what is asked
