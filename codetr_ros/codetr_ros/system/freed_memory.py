"""Memory that is freed and taken again at once, step after step: where the C library is glibc."""

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h
KEPT_BLOCK = 32 << 20
"""Blocks up to this size are served from the heap: glibc takes no larger number."""
KEPT_BYTES = 512 << 20
"""Freed memory beyond this goes back to the system."""


def keep() -> None:
    """Have this process keep freed memory for what comes next; elsewhere than on glibc nothing.

    Otherwise each step of learning would take its memory anew, at the price of a page fault for
    every 4 KB: a twelfth of the time of a gradient step of CoDeTr.
    """
    # musl and macOS have no such function
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, KEPT_BLOCK)
        mallopt(_TRIM_THRESHOLD, KEPT_BYTES)
