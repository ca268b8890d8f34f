"""Files that are written to the disk whole or not at all.

Every file is written under a temporary name, synced to the disk and renamed. A reader, or a
machine that has lost its power, then sees the whole old file or the whole new one, never a part.
"""

import errno
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_PARTIAL = '.partial'

_REMEDIES = {
    errno.ENOSPC: 'make room',
    errno.EDQUOT: 'make room within the quota',
    errno.EACCES: 'change the permissions',
    errno.EPERM: 'change the permissions',
    errno.EROFS: 'mount the disk so that it can be written',
    errno.EIO: 'mend the disk',
    errno.EMFILE: 'raise the limit of open files (ulimit -n)',
    errno.EFBIG: 'raise the limit of file sizes (ulimit -f)',
}


class FileError(OSError):
    """A file that cannot be written: names the file, the reason and the remedy."""

    def __str__(self) -> str:
        return (
            f'{self.filename} cannot be written: {self.strerror}. {remedy(self).capitalize()}, or '
            'choose another folder'
        )


def remedy(error: OSError) -> str:
    """What lets a file be written that could not be, as the beginning of a sentence."""
    return _REMEDIES.get(error.errno or 0, 'remove the cause')


@contextmanager
def named_errors(folder: Path) -> Iterator[None]:
    """Let every error of the disk name the folder in which something is written or removed.

    Raises:
        FileError: there was one.
    """
    try:
        yield
    except FileError:
        raise
    except OSError as error:
        raise FileError(error.errno, error.strerror, str(folder)) from error


def check_writable(folder: Path) -> None:
    """Check that files can be written in a folder; leaves nothing in it.

    The permissions alone do not decide: a disk may be mounted to be read only, and root is denied
    nothing but that.

    Raises:
        FileError: there is no such folder, or it cannot be written.
    """
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise FileError(error.errno, error.strerror, str(folder)) from error


def check_makeable(folder: Path) -> None:
    """Check that files can be written in a folder, or that it can be made; leaves nothing behind.

    Raises:
        FileError: the folder, or the nearest above it that exists, cannot be written.
    """
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    check_writable(there)


def make_folder(folder: Path) -> None:
    """Make a folder, with all above it, where there is none.

    Raises:
        FileError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(error.errno, error.strerror, str(folder)) from error


def sync_folder(folder: Path) -> None:
    """Make renames and new names in a folder survive a power loss.

    Raises:
        FileError: the folder is not there any more, or the disk fails.
    """
    with named_errors(folder):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_synced(path: Path, data: bytes, wait: bool = True) -> None:
    """Write a file and wait until it is on the disk.

    Args:
        path: the file.
        data: its content.
        wait: False: do not wait for the disk.

    Raises:
        FileError: the disk is full or the folder cannot be written.
    """
    try:
        with path.open('wb') as file:
            file.write(data)
            file.flush()
            if wait:
                os.fsync(file.fileno())
    except OSError as error:
        raise FileError(error.errno, error.strerror, str(path)) from error


def _remove(partial: Path) -> None:
    """Remove what was written of a file, after an error that is worth more than another one."""
    with suppress(OSError):
        partial.unlink(missing_ok=True)


def is_partial(path: Path, name: str) -> bool:
    """Whether a file is what `atomic_write` leaves of a file of this name when it is killed."""
    return bool(re.fullmatch(rf'\.{re.escape(name)}\.\d+{re.escape(_PARTIAL)}', path.name))


def atomic_write(path: Path, data: bytes | str, wait: bool = True) -> None:
    """Write a file whole or not at all: temporary name in the same folder, fsync, rename.

    Args:
        path: the file; an existing one is replaced.
        data: its content; text becomes UTF-8.
        wait: False for what is soon written again: other processes see the whole old file or the
            whole new one, and a machine that loses its power may have neither.

    Raises:
        FileError: the disk is full or the folder cannot be written; `path` is then unchanged.
    """
    content = data.encode() if isinstance(data, str) else data
    partial = path.with_name(f'.{path.name}.{os.getpid()}{_PARTIAL}')
    try:
        write_synced(partial, content, wait)
        os.replace(partial, path)
    except OSError as error:
        _remove(partial)
        raise FileError(error.errno, error.strerror, str(path)) from None
    except BaseException:
        _remove(partial)
        raise
    if wait:
        sync_folder(path.parent)
