"""Memory that is freed and taken again at once, step after step: where the C library is glibc."""

import torch

KEPT_BYTES = 31 << 20
"""Just below 32 MB, from where on glibc draws no conclusions from a block."""


def keep() -> None:
    """Have freed blocks of up to `KEPT_BYTES` kept for what comes next.

    After the free of a block of this size glibc serves blocks up to it from the heap, and gives
    back to the system only what exceeds twice of it. Otherwise each step of learning would take
    its memory anew, at the price of a page fault for every 4 KB.
    """
    torch.empty(KEPT_BYTES, dtype=torch.uint8)  # never written to: it takes no memory
