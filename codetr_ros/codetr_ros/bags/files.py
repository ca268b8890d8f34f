"""Which files a bag consists of."""

import os
import re
import stat
from collections.abc import Callable
from pathlib import Path, PurePath

import yaml

from codetr_ros.bags import metadata
from codetr_ros.bags.errors import BagError, Damage, Place
from codetr_ros.bags.metadata import METADATA

STORAGES = ('.mcap', '.db3')
COMPRESSED = '.zstd'
"""What follows such an ending where a whole file is compressed."""


def storage_of(name: str) -> str:
    """How a file of this name stores messages: its ending, that of a compression left out."""
    return PurePath(name.removesuffix(COMPRESSED)).suffix


def _number(name: str) -> tuple[int, str]:
    """Splits are numbered; 10 comes after 9."""
    found = re.search(r'_(\d+)\.[a-z0-9.]+$', name)
    return (int(found[1]) if found else -1, name)


def listed_files(folder: Path) -> list[str]:
    """Names of the files that a folder's metadata lists; none if it has no metadata.

    Raises:
        BagError: the metadata cannot be read.
    """
    path = folder / METADATA
    try:
        said = metadata.read(folder)['relative_file_paths']
        return [PurePath(name).name for name in said]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
    except (yaml.YAMLError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise BagError(
            f'{path} is damaged ({str(error).splitlines()[0]}). The messages do not need it: '
            'remove it, or make a new one with `codetr bag recover`'
        ) from error


def bag_files(path: Path, on_damage: Callable[[Damage], None] | None) -> list[Path]:
    """The files of a bag, in order: as its metadata lists them, then by number.

    Raises:
        BagError: there are none, or one is missing (unless that is told to `on_damage`).
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):
            if storage_of(path.name) not in STORAGES:
                raise BagError(f'{path} is no bag: a bag is a folder, or a file of {_named()}')
            return [path]
        if not stat.S_ISDIR(mode):
            raise BagError(f'{path} is neither file nor folder')
        there = {name for name in os.listdir(path) if storage_of(name) in STORAGES}
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
    try:
        listed = listed_files(path)
        if missing := [name for name in listed if name not in there]:
            raise BagError(
                f'bag {path} lacks {missing[0]}, which its {METADATA} lists: put it back, or make '
                'a whole bag of the rest with `codetr bag recover`'
            )
    except BagError as error:
        if on_damage is None:
            raise
        on_damage(Damage(Place(path / METADATA, 0), str(error), 0))
        listed = []
    names = [*listed, *sorted(there - set(listed), key=_number)]
    if not names:
        raise BagError(f'{path} is no bag: it holds no file of {_named()}')
    for name in names:
        _check_file(path / name)
    return [path / name for name in names]


def _named() -> str:
    return ' or '.join(STORAGES)


def _check_file(path: Path) -> None:
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise BagError(f'{path} is no file')
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
