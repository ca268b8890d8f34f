"""The calls by which a recording reaches its disk: one place, where a disk can be simulated."""

import os
import shutil
from pathlib import Path
from typing import BinaryIO


class Disk:
    """The disk of this machine."""

    def create(self, path: Path) -> BinaryIO:
        """Open a new file.

        Raises:
            OSError: it exists, or cannot be made.
        """
        return path.open('xb')

    def sync(self, file: BinaryIO) -> None:
        """Wait until all that was written to a file is on the disk.

        Raises:
            OSError: it cannot be written.
        """
        file.flush()
        os.fsync(file.fileno())

    def replace(self, old: Path, new: Path) -> None:
        """Let a file take the place of another one.

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
