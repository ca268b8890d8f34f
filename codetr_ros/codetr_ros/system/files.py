"""Files that are written to the disk whole or not at all.

Every file is written under a temporary name, synced to the disk and renamed. A reader, or a
machine that has lost its power, then sees the whole old file or the whole new one, never a part.
"""

import os
from pathlib import Path


class FileError(OSError):
    """A file that cannot be written: names the file, the reason and the remedy."""

    def __str__(self) -> str:
        return (
            f'{self.filename} cannot be written: {self.strerror}. Make room, or choose another '
            'folder'
        )


def sync_folder(folder: Path) -> None:
    """Make renames and new names in a folder survive a power loss."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_synced(path: Path, data: bytes) -> None:
    """Write a file and wait until it is on the disk.

    Raises:
        FileError: the disk is full or the folder cannot be written.
    """
    try:
        with path.open('wb') as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise FileError(error.errno, error.strerror, str(path)) from error


def atomic_write(path: Path, data: bytes | str) -> None:
    """Write a file whole or not at all: temporary name in the same folder, fsync, rename.

    Args:
        path: the file; an existing one is replaced.
        data: its content; text becomes UTF-8.

    Raises:
        OSError: the disk is full or the folder cannot be written; `path` is then unchanged.
    """
    content = data.encode() if isinstance(data, str) else data
    partial = path.with_name(f'.{path.name}.{os.getpid()}.partial')
    try:
        write_synced(partial, content)
        os.replace(partial, path)
    except FileError as error:
        partial.unlink(missing_ok=True)
        raise FileError(error.errno, error.strerror, str(path)) from error
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)
