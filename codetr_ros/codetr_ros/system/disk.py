"""The calls by which bags and checkpoints reach their disk, so that it can be simulated."""

import os
import shutil
from pathlib import Path
from typing import BinaryIO

from codetr_ros.system.files import write_synced


class Disk:
    """The disk of this machine."""

    def create(self, path: Path) -> BinaryIO:
        """Open a new file.

        Raises:
            OSError: it exists, or cannot be made.
        """
        return path.open('xb')

    def write(self, path: Path, data: bytes) -> None:
        """Write a whole file, and wait until it is on the disk.

        Raises:
            OSError: it cannot be written.
        """
        write_synced(path, data)

    def sync(self, file: BinaryIO) -> None:
        """Wait until all that was written to a file is on the disk.

        Raises:
            OSError: it cannot be written.
        """
        file.flush()
        os.fsync(file.fileno())

    def replace(self, old: Path, new: Path) -> None:
        """Let a file or folder take the place of another one.

        Raises:
            OSError: it cannot.
        """
        os.replace(old, new)

    def free(self, folder: Path) -> int:
        """The bytes that are left on the disk of a folder.

        Raises:
            OSError: they are not known.
        """
        return shutil.disk_usage(folder).free
