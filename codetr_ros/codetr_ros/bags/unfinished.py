"""A new bag appears once it is whole, not before."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from codetr_ros.bags.errors import BagError, BagWriteError
from codetr_ros.bags.metadata import METADATA
from codetr_ros.system.files import remedy, sync_folder


@contextmanager
def unfinished(folder: Path, again: str) -> Iterator[Path]:
    """A temporary folder of the same name to write a bag in. At the end its content is moved to
    where it belongs, or removed after an error. A killed process leaves `.NAME.*.unfinished`.

    Args:
        folder: where the bag belongs: does not exist, or is empty.
        again: what to do once there is room, such as 'label again'.

    Raises:
        BagError: the folder holds something, or cannot be made or written.
    """
    try:
        with _moved_when_whole(folder) as new:
            yield new
    except (BagWriteError, OSError) as error:
        reason = error.__cause__ if isinstance(error, BagWriteError) else error
        assert isinstance(reason, OSError)
        raise BagError(
            f'{folder} cannot be written: {reason.strerror}. Nothing of it is left: '
            f'{remedy(reason)} or choose another folder, and {again}'
        ) from error


@contextmanager
def _moved_when_whole(folder: Path) -> Iterator[Path]:
    target = Path(os.path.realpath(folder))
    if target.exists() and (there := sorted(path.name for path in target.iterdir())):
        raise BagError(
            f'{folder} exists and holds {there[0]}: choose another folder, or remove it'
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    # inside the target if that exists: it may be a disk of its own
    room = target if target.exists() else target.parent
    place = Path(tempfile.mkdtemp(prefix=f'.{target.name}.', suffix='.unfinished', dir=room))
    try:
        made = place / target.name
        made.mkdir()
        yield made
        files = sorted(made.iterdir(), key=lambda path: path.name == METADATA)
        try:
            if room == target:  # the metadata, which makes it whole, comes last
                for path in files:
                    os.rename(path, target / path.name)
            else:
                os.rename(made, target)
            sync_folder(target)
            sync_folder(target.parent)
        except OSError:
            for path in files:
                (target / path.name).unlink(missing_ok=True)
            raise
    finally:
        shutil.rmtree(place, ignore_errors=True)
