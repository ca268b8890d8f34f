"""The processors that this process may use."""

import os


def count() -> int:
    """How many there are: fewer than the machine has, if the system restricts the process."""
    if hasattr(os, 'sched_getaffinity'):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
