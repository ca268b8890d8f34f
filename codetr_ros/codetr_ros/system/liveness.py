"""Whether another process of this machine still lives.

A process that was killed sends no farewell, and the middleware notices its end only after 20 s.
But a process of the same machine can be looked up, by a name that it has given itself. The name
holds the time at which it started, since ids of processes are used again. Linux only; elsewhere,
and of processes of other machines and containers, nothing is known.
"""

import hashlib
import os
from functools import cache
from pathlib import Path

_STATE, _STARTED = 0, 19  # fields after the command in /proc/PID/stat, see proc(5)


@cache
def _place() -> str:
    """Names the machine since its last start, and the space in which its process ids count."""
    boot = Path('/proc/sys/kernel/random/boot_id').read_text().strip()
    space = os.readlink('/proc/self/ns/pid')
    return hashlib.sha256(f'{boot} {space}'.encode()).hexdigest()[:12]


def _stat(pid: int) -> list[str] | None:
    """State and times of a process; None if there is no such process."""
    try:
        text = Path(f'/proc/{pid}/stat').read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return text.rpartition(')')[2].split()  # the command may hold blanks and brackets


def own_name() -> str:
    """The name by which others on this machine can look up this process; empty if they cannot."""
    try:
        stat = _stat(os.getpid())
        return f'{_place()}-{os.getpid()}-{stat[_STARTED]}' if stat else ''
    except OSError:
        return ''


def has_ended(name: str) -> bool:
    """Whether a process is known to have ended.

    Args:
        name: what `own_name` returned in it; may be of another machine, or anything else.
    """
    place, _, rest = name.partition('-')
    pid, _, started = rest.partition('-')
    try:
        if not pid.isdecimal() or place != _place():
            return False
        stat = _stat(int(pid))
    except OSError:
        return False
    return stat is None or stat[_STARTED] != started or stat[_STATE] in 'ZX'
