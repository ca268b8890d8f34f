"""Tensors and arrays: whether states are equal, and arrays that lie askew in memory."""

import numpy as np
import torch


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


def crooked(array: np.ndarray) -> np.ndarray:
    """The same numbers, 4 bytes off a 64-byte boundary."""
    memory = np.empty(array.nbytes + 128, np.uint8)
    start = -memory.ctypes.data % 64 + 4
    copy = memory[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy
