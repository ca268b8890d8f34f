"""Random streams that depend only on the run's seed and on their purpose.

Neither interleaving nor a restart changes what a part of the run draws: each slice of work seeds
its generators from (seed, core, phase, slice), and no generator state is ever saved.
"""

import hashlib

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
    torch.manual_seed(entropy(seed, *names) & (2**63 - 1))
