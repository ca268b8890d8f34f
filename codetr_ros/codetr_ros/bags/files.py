"""Which files a bag consists of."""

import os
import re
import stat
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePath

from codetr_ros.bags import metadata
from codetr_ros.bags.errors import BagError, Damage, Place
from codetr_ros.bags.metadata import METADATA
from codetr_ros.system.parsing import ParseError

_SPLIT = re.compile(r'_(\d+)\.[a-z0-9.]+$')
_LFS_POINTER = b'version https://git-lfs'
STORAGES = ('.mcap', '.db3')
COMPRESSED = '.zstd'
"""The further suffix of a file that is compressed as a whole."""


def storage_of(name: str) -> str:
    """How a file of this name stores messages: its suffix, without that of a compression."""
    return PurePath(name.removesuffix(COMPRESSED)).suffix


def _number(name: str) -> tuple[int, str]:
    """Splits are numbered; 10 comes after 9."""
    match = _SPLIT.search(name)
    return (int(match[1]) if match else -1, name)


def _numbered_alike(names: list[str]) -> bool:
    """Whether all names are of one stem, with a number."""
    return len({re.sub(_SPLIT, '', name) for name in names}) == 1 and all(
        _number(name)[0] >= 0 for name in names
    )


def listed_files(folder: Path) -> list[str]:
    """Names of the files that a folder's metadata lists; none if it has no metadata.

    Raises:
        BagError: the metadata cannot be read.
    """
    path = folder / METADATA
    try:
        _check_no_pointer(path)
        return metadata.listed(folder)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
    except ParseError as error:
        raise BagError(
            f'{path} is damaged: it {error}. The messages do not need it: '
            'remove it, or make a new one with `codetr bag recover`'
        ) from error


def bag_files(path: Path, on_damage: Callable[[Damage], None] | None) -> list[Path]:
    """The files of a bag, in order: as its metadata lists them, then by number. Splits of one name
    are ordered by number, however they are listed: recorders number them as they write.

    Raises:
        BagError: there are none. Or one is missing, is no file or is listed twice: `on_damage`, if
            given, receives that instead, and the others are returned.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):
            if storage_of(path.name) not in STORAGES:
                raise BagError(f'{path} is no bag: a bag is a folder, or a file of {_named()}')
            _check_no_pointer(path)
            return [path]
        if not stat.S_ISDIR(mode):
            raise BagError(f'{path} is neither file nor folder')
        there = {name for name in os.listdir(path) if storage_of(name) in STORAGES}
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error

    def report(where: Path, error: BagError, unread: bool) -> None:
        if on_damage is None:
            raise error
        on_damage(Damage(Place(where, 0), str(error), 0, unread=unread))

    listed: list[str] = []
    try:
        listed = listed_files(path)
    except BagError as error:
        report(path / METADATA, error, False)
    for name, times in Counter(listed).items():
        if name not in there:
            report(path / METADATA, _lacking(path, name), True)
        elif times > 1:
            report(path / METADATA, _listed_again(path, name, times), False)
    known = [name for name in dict.fromkeys(listed) if name in there]
    if _numbered_alike(known):
        known.sort(key=_number)
    names = [*known, *sorted(there - set(known), key=_number)]
    if not names:
        raise BagError(f'{path} is no bag: it holds no file of {_named()}')
    return _files(path, names, report)


def _listed_again(path: Path, name: str, times: int) -> BagError:
    return BagError(
        f'{path / METADATA} lists {name} {times} times, and its messages are there once: remove '
        'the repetition, or make a whole bag with `codetr bag recover`'
    )


def _lacking(path: Path, name: str) -> BagError:
    return BagError(
        f'bag {path} lacks {name}, which its {METADATA} lists: put it back, or make a whole bag '
        'of the rest with `codetr bag recover`'
    )


def _files(
    path: Path, names: list[str], report: Callable[[Path, BagError, bool], None]
) -> list[Path]:
    """Those of the names that are files; at least one."""
    files: list[Path] = []
    for name in names:
        try:
            _check_file(path / name)
        except BagError as error:
            if not files and name == names[-1]:
                raise
            report(path / name, error, True)
        else:
            files.append(path / name)
    return files


def _named() -> str:
    return ' or '.join(STORAGES)


def _check_file(path: Path) -> None:
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise BagError(f'{path} is no file')
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
    with suppress(OSError):  # of the disk: reported where the file is read
        _check_no_pointer(path)


def _check_no_pointer(path: Path) -> None:
    """Refuse what Git leaves in place of a large file.

    Raises:
        BagError: it is such a pointer.
        OSError: the file cannot be read.
    """
    with path.open('rb') as file:
        if file.read(len(_LFS_POINTER)) == _LFS_POINTER:
            raise BagError(
                f'{path} is a Git LFS pointer, not the file itself: run `git lfs pull` in its '
                'repository'
            )
