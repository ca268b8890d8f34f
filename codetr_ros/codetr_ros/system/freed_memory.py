"""Keeps memory that is freed and soon taken again, step after step, if the C library is glibc."""

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h
KEPT_BLOCK = 32 << 20
"""Blocks up to this size are served from the heap: the largest size that glibc accepts."""
KEPT_BYTES = 512 << 20
"""Freed memory beyond this goes back to the system."""


def keep() -> None:
    """Make this process keep freed memory for its next use; without glibc it does nothing.

    Otherwise each step of learning would take its memory anew, with a page fault for every 4 KB: a
    twelfth of the time of a gradient step of CoDeTr.
    """
    # musl and macOS have no such function
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, KEPT_BLOCK)
        mallopt(_TRIM_THRESHOLD, KEPT_BYTES)
