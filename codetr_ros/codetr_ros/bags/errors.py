"""What can be wrong with a bag, and where."""

from pathlib import Path
from typing import NamedTuple


class BagError(RuntimeError):
    """A bag that cannot be read, written or set up: names the file or the type, the place, the
    reason and the remedy.
    """


class BagWriteError(BagError):
    """A bag that cannot be written to its disk; the cause is the system's error."""


class Place(NamedTuple):
    """Where in a bag something lies."""

    file: Path
    offset: int  # MCAP: byte at which the record or its chunk begins; SQLite: row of `messages`
    inside: int | None = None  # byte within the chunk's uncompressed records

    def __str__(self) -> str:
        if '.db3' in self.file.suffixes[-2:]:  # also where the file is compressed
            return f'{self.file} row {self.offset}'
        inside = '' if self.inside is None else f', byte {self.inside} of that chunk'
        return f'{self.file} byte {self.offset}{inside}'


class Damage(NamedTuple):
    """A fault met while reading."""

    place: Place
    text: str
    lost: int  # bytes that could not be read; 0 where nothing is known to be missing
    harmless: bool = False  # only an index or a summary is wrong: no message is
    unread: bool = False  # the disk cannot be read there: what is lost is unknown

    def error(self) -> BagError:
        """The fault as an error, with the remedy."""
        return BagError(
            f'{self.place}: {self.text}. `codetr bag verify` lists all that is wrong with the '
            'bag, `codetr bag recover` makes a whole one from what can be read'
        )
