"""The processors that this process may use."""

import os
import platform
from pathlib import Path

CONTROL_GROUPS = Path('/sys/fs/cgroup')
"""Where Linux shows the limits of the container that this process is in."""


def count() -> int:
    """How many there are: fewer than the machine has, if the system restricts the process."""
    if hasattr(os, 'sched_getaffinity'):  # Linux
        there = len(os.sched_getaffinity(0))
    else:
        there = os.cpu_count() or 1
    return max(1, min(there, int(quota() or there)))


def quota(groups: Path = CONTROL_GROUPS) -> float | None:
    """Processors' worth of time that a container grants; None where nothing is limited.

    Args:
        groups: folder of the control groups, of version 2 or 1.
    """
    for words in (
        _words(groups / 'cpu.max'),
        _words(groups / 'cpu/cpu.cfs_quota_us') + _words(groups / 'cpu/cpu.cfs_period_us'),
    ):
        # 'max' and -1: no limit
        if len(words) == 2 and all(word.isdecimal() for word in words) and int(words[1]):
            return int(words[0]) / int(words[1])
    return None


def model(information: Path = Path('/proc/cpuinfo')) -> str:
    """What the processor calls itself; the kind of machine where it does not.

    Args:
        information: where Linux shows it.
    """
    if information.is_file():
        for line in information.read_text(errors='replace').splitlines():
            name, _, value = line.partition(':')
            if name.strip() == 'model name' and value.strip():
                return value.strip()
    return platform.machine()


def _words(path: Path) -> list[str]:
    return path.read_text().split() if os.access(path, os.R_OK) and path.is_file() else []
