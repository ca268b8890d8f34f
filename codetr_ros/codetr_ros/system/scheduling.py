"""Real-time scheduling, for what must not be late beside programs that compute."""

import os

PRIORITY = 10
"""Above every ordinary program, below what a system reserves for itself (from 50 on)."""


def real_time(priority: int = PRIORITY) -> str | None:
    """Let each thread of this process run before those of ordinary programs.

    Returns:
        Why the system does not let it; None where it does.
    """
    if not hasattr(os, 'sched_setscheduler'):
        return 'this system has no real-time scheduling for processes'
    try:
        for thread in os.listdir('/proc/self/task'):
            os.sched_setscheduler(int(thread), os.SCHED_RR, os.sched_param(priority))
    except OSError as error:
        return (
            f'the system does not allow it ({error.strerror}): allow the user rtprio {priority} '
            'in /etc/security/limits.conf'
        )
    return None
