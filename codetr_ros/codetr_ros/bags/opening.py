"""Opens the files of a bag; a compressed one is unpacked first."""

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import zstandard

from codetr_ros.bags.errors import BagError, Damage, Place
from codetr_ros.bags.files import COMPRESSED
from codetr_ros.bags.mcap_channels import McapChannels
from codetr_ros.bags.mcap_file import McapFile
from codetr_ros.bags.raw import OnDamage
from codetr_ros.bags.sqlite_file import SqliteFile
from codetr_ros.system.files import remedy

_KINDS: dict[str, Callable[..., McapFile | SqliteFile]] = {
    '.mcap': McapFile,
    '.db3': SqliteFile,
}


def report(damage: Damage, on_damage: OnDamage | None) -> None:
    """Give a fault to whoever receives faults.

    Raises:
        BagError: nobody does.
    """
    if on_damage is None:
        raise damage.error()
    on_damage(damage)


def open_file(
    path: Path,
    stack: ExitStack,
    on_damage: OnDamage | None = None,
    thorough: bool = False,
    known: McapChannels | None = None,
) -> McapFile | SqliteFile:
    """One file of a bag; a compressed one is first unpacked beside other temporary files, until
    the stack is closed. `known` are the topics of an MCAP file from an earlier reading.

    Raises:
        BagError: it cannot be read or unpacked.
    """
    if path.suffix != COMPRESSED:
        return _KINDS[path.suffix](path, on_damage, path, thorough, known)
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix='codetr-bag-'))
    unpacked = Path(folder) / path.stem
    try:
        with path.open('rb') as packed:
            _write(zstandard.ZstdDecompressor().read_to_iter(packed), unpacked)
    except zstandard.ZstdError as error:
        report(Damage(Place(path, 0), f'its zstd data is damaged ({error})', 0), on_damage)
    except OSError as error:
        text = f'cannot be read: {error.strerror}'
        report(Damage(Place(path, 0), text, 0, unread=True), on_damage)
    return _KINDS[unpacked.suffix](unpacked, on_damage, path, thorough, known)


def _write(pieces: Iterable[bytes], path: Path) -> None:
    """Write what is read to a file.

    Raises:
        BagError: it cannot be written; errors of what is read pass through.
    """
    with _writing(path):
        file = path.open('wb')
    with file:
        for piece in pieces:
            with _writing(path):
                file.write(piece)
                file.flush()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BagError(
            f'{path}, to which a bag is unpacked, cannot be written: {error.strerror}: '
            f'{remedy(error)}, or set TMPDIR to another folder'
        ) from error
