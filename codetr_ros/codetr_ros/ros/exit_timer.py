"""End the process at a given time with a given exit code, even if the interpreter hangs then.

A signal that ends a process gives it no exit code, and handlers and threads written in Python wait
for the interpreter. A POSIX timer runs a C function in a thread of its own: here libc's `_exit`,
which takes the timer's value as the exit code. See timer_create(2) and sigevent(7).
"""

import ctypes
import os
import sys
import time

_SIGEV_THREAD = 2


class _SigEvent(ctypes.Structure):
    """`struct sigevent` of Linux: 64 bytes; those after the attributes are unused."""

    _fields_ = [
        ('value', ctypes.c_ssize_t),  # union sigval: the function's only argument
        ('signal', ctypes.c_int),
        ('notify', ctypes.c_int),
        ('function', ctypes.c_void_p),
        ('attributes', ctypes.c_void_p),
        ('unused', ctypes.c_char * 32),
    ]


class _TimerSpec(ctypes.Structure):
    """`struct itimerspec`: the interval (0: once) and the time until it first fires."""

    _fields_ = [(name, ctypes.c_long) for name in ('again_s', 'again_ns', 'first_s', 'first_ns')]


def start(seconds: int, code: int) -> None:
    """End this process with `_exit(code)` after some seconds. Only an earlier end stops the timer.

    Raises:
        OSError: the system has no timer left.
    """
    for stream in (sys.stdout, sys.stderr):  # `_exit` does not flush
        stream.flush()
    c = ctypes.CDLL('librt.so.1', use_errno=True)  # part of libc itself since glibc 2.34
    c_exit = ctypes.cast(ctypes.CDLL(None)['_exit'], ctypes.c_void_p)
    event = _SigEvent(value=code, notify=_SIGEV_THREAD, function=c_exit)
    timer = ctypes.c_void_p()
    if c.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    if c.timer_settime(timer, 0, ctypes.byref(_TimerSpec(0, 0, seconds, 0)), None):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
