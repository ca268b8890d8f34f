"""A disk that is full, fails to sync, or loses what was not synced."""

import errno
import io
import os
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from codetr_ros.system.disk import Disk
from codetr_ros.system.files import FileError

ROOM = 1 << 30  # bytes free on a disk that is not full


@dataclass
class Trouble:
    """What is wrong with a disk.

    Attributes:
        room: bytes that can be written before it is full; None: any number.
        syncs: how many times it syncs before that fails; None: always.
        kills_in: after how many calls the process that calls is killed within one, once; None:
            never.
        power: whether its machine then loses its power, too.
    """

    room: int | None = None
    syncs: int | None = None
    kills_in: int | None = None
    power: bool = False

    @property
    def mends(self) -> bool:
        """Whether a run ends as if nothing had happened all the same."""
        return self.room is None and self.syncs is None

    def kill(self) -> None:
        """Kill the process that calls, if it is time."""
        if self.kills_in is not None:
            self.kills_in -= 1
            if self.kills_in < 0:
                self.kills_in = None
                raise KilledError


class KilledError(BaseException):
    """A process was killed within a call."""


class _File(io.FileIO):
    """A file on such a disk: writes what there is room for, even a part of what it is given."""

    def __init__(self, path: Path, trouble: Trouble) -> None:
        super().__init__(path, 'xb')
        self._trouble = trouble
        self.abandoned = False  # its process was killed, with all that it had not handed over

    def write(self, data: bytes) -> int:  # type: ignore[override]
        if self.abandoned:
            return len(data)
        try:
            self._trouble.kill()
        except KilledError:
            super().write(memoryview(data)[: len(data) // 2])  # so far it had come
            raise
        room = self._trouble.room
        if room is None:
            return super().write(data)
        done = super().write(memoryview(data)[:room]) if room else 0
        self._trouble.room = room - done
        if done < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return done


@dataclass
class TroubledDisk(Disk):
    """A disk whose troubles are foreseen.

    Attributes:
        trouble: what is wrong with it.
        synced: bytes of each file that would outlast a loss of power.
    """

    trouble: Trouble = field(default_factory=Trouble)
    synced: dict[Path, int] = field(default_factory=dict)
    _paths: dict[int, Path] = field(default_factory=dict)
    _files: list[_File] = field(default_factory=list)

    def create(self, path: Path) -> BinaryIO:
        """Open a new file."""
        self.trouble.kill()
        raw = _File(path, self.trouble)
        self._files.append(raw)
        file = io.BufferedWriter(raw)  # type: ignore[type-var]
        self.synced[path] = 0
        self._paths[id(file)] = path
        return file

    def sync(self, file: BinaryIO) -> None:
        """Make what was written so far outlast a loss of power."""
        file.flush()
        self.trouble.kill()
        if self.trouble.syncs is not None:
            if self.trouble.syncs <= 0:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            self.trouble.syncs -= 1
        self.synced[self._paths[id(file)]] = file.tell()

    def replace(self, old: Path, new: Path) -> None:
        """Let a file or folder take the place of another one."""
        self.trouble.kill()
        super().replace(old, new)
        for path in [path for path in self.synced if path.is_relative_to(old)]:
            self.synced[new / path.relative_to(old)] = self.synced.pop(path)

    def write(self, path: Path, data: bytes) -> None:
        """Write a whole file, and wait until it is on the disk."""
        path.unlink(missing_ok=True)  # what a process that was killed had begun
        try:
            with self.create(path) as file:
                file.write(data)
                self.sync(file)
        except OSError as error:
            raise FileError(error.errno, error.strerror, str(path)) from error

    def abandon(self) -> None:
        """Lose what a process that was killed had not handed to the system."""
        for file in self._files:
            file.abandoned = True
        self._files.clear()

    def free(self, folder: Path) -> int:
        """The bytes left."""
        return ROOM if self.trouble.room is None else self.trouble.room

    def holds(self, data: bytes) -> bool:
        """Whether these bytes would outlast a loss of power."""
        return any(
            data in path.read_bytes()[:size] for path, size in self.synced.items() if path.exists()
        )

    def lose_power(self, rng: random.Random) -> None:
        """Cut what was not synced: all of it, none, or anywhere between."""
        for path, size in self.synced.items():
            if path.exists() and (there := path.stat().st_size) > size:
                os.truncate(path, rng.choice((size, there, rng.randint(size, there))))
