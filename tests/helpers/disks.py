"""Disks that are full, for tests."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def small_disk(at: Path, megabytes: int) -> Iterator[Path]:
    """A file system of a few megabytes. Skips the test where none may be mounted."""
    at.mkdir()
    mounted = subprocess.run(
        ['mount', '-t', 'tmpfs', '-o', f'size={megabytes}m', 'tmpfs', str(at)],
        capture_output=True,
        text=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f'no small disk may be mounted here: {mounted.stderr.strip()}')
    try:
        yield at
    finally:
        subprocess.run(['umount', '--lazy', str(at)], check=True)


def fill(disk: Path, leave: int = 0) -> Path:
    """Fill a disk with a file, up to some bytes; the file."""
    path = disk / 'filler'
    with path.open('ab') as file:
        file.truncate(0)
    room = shutil.disk_usage(disk).free - leave
    with path.open('wb', buffering=0) as file:
        while room > 0 and (done := file.write(bytes(min(room, 1 << 20)))):
            room -= done
    return path
