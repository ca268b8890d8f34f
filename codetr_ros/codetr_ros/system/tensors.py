"""The digest of tensors, whatever library holds them."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Part(NamedTuple):
    """A tensor.

    Attributes:
        name: its name.
        dtype: such as torch.float32.
        shape: its shape.
        data: its bytes, row-major.
    """

    name: str
    dtype: str
    shape: Sequence[int]
    data: bytes


def digest(parts: Iterable[Part]) -> str:
    """sha256 over names (sorted), dtypes, shapes and bytes: equal weights give equal digests."""
    total = hashlib.sha256()
    for part in sorted(parts, key=lambda part: part.name):
        # A JSON line before the bytes keeps names, shapes and values apart.
        total.update(json.dumps([part.name, part.dtype, list(part.shape)]).encode() + b'\n')
        total.update(part.data)
    return total.hexdigest()
