"""Random streams that depend only on the run's seed and on their purpose.

Neither interleaving nor a restart changes what a part of the run draws: each slice of work seeds
its generators from (seed, core, phase, slice), and no generator state is ever saved.
"""

import hashlib
import random
from functools import cache

import numpy as np
import torch


def entropy(seed: int, *names: str | int) -> int:
    """A 128-bit number for (seed, names): the same on every machine and Python version."""
    text = '\x1f'.join([str(seed), *(str(name) for name in names)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], 'big')


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """A numpy generator of its own for the purpose that `names` describe."""
    return np.random.Generator(np.random.PCG64(entropy(seed, *names)))


def seed_torch(seed: int, *names: str | int) -> None:
    """Seed torch's global generators, from which dropout and `torch.randn` draw."""
    number = entropy(seed, *names) & (2**63 - 1)
    if _accelerated():
        torch.manual_seed(number)
    else:  # else each call is also noted for accelerators that may still come, with its stack
        torch.default_generator.manual_seed(number)


@cache
def _accelerated() -> bool:
    """Whether torch may compute on anything but processors."""
    return torch.accelerator.is_available()


def seed_global(seed: int, *names: str | int) -> None:
    """Seed every global generator: those of Python, numpy and torch.

    For code that is not ours, such as an environment, which may draw from any of them. Our own
    draws come from `generator`, and from torch's after `seed_torch`.
    """
    number = entropy(seed, *names)
    random.seed(number)
    np.random.seed(np.frombuffer(number.to_bytes(16, 'big'), '>u4').astype(np.uint32))  # noqa: NPY002
    seed_torch(seed, *names)
