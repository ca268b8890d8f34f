"""The names of checkpoints, by which they are found without reading them. No torch."""

import re
from pathlib import Path


def every(folder: Path, name: str) -> list[Path]:
    """All whole checkpoints of exactly this name, lowest phase first."""
    if not folder.is_dir():
        return []
    pattern = re.compile(re.escape(name) + r'-\d{6,}')
    return sorted((p for p in folder.iterdir() if pattern.fullmatch(p.name)), key=phase_of)


def latest(folder: Path, name: str) -> Path | None:
    """The whole checkpoint of this name with the highest phase, or None; its digests are checked
    by whoever reads it.
    """
    checkpoints = every(folder, name)
    return checkpoints[-1] if checkpoints else None


def phase_of(path: Path) -> int:
    """The phase after which the checkpoint in this folder was written."""
    return int(path.name.rsplit('-', 1)[1])
