"""Goes on with a bag whose recorder was killed or stopped.

All that can be read of it up to the first fault is kept. Only the last file can lack its end,
since a recorder finishes a file before it begins the next: that file is written anew, with its
index, under a temporary name, and then takes the place of the old one. So a recorder that is
killed meanwhile leaves the bag as it was. A fault before the last commit is no matter of a killed
recorder, and is refused: nodes have learnt from what lies there.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

from codetr_ros.bags.copying import NewFile
from codetr_ros.bags.errors import BagError, BagWriteError, Damage
from codetr_ros.bags.files import bag_files
from codetr_ros.bags.mcap_file import McapFile
from codetr_ros.bags.metadata import BagFile
from codetr_ros.bags.raw import LIBRARY, RawMessage
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.writer import Written
from codetr_ros.records import Commit
from codetr_ros.records.fields import type_name
from codetr_ros.records.names import full_name
from codetr_ros.system.disk import Disk
from codetr_ros.system.files import remedy, sync_folder

PARTIAL = '.partial'
_COMMIT = type_name(Commit)


def holds_messages(folder: Path) -> bool:
    """Whether a folder has files of a bag, so that there is something to go on with."""
    return folder.is_dir() and any(path.suffix == '.mcap' for path in folder.iterdir())


def reopen(
    folder: Path, receive: Callable[[RawMessage], None], disk: Disk | None = None
) -> Written:
    """Make all files of a bag whole and read them.

    Args:
        folder: the bag.
        receive: takes each message, in order.
        disk: where it lies; None: the disk of this machine.

    Returns:
        What `McapWriter` needs to go on with the bag.

    Raises:
        BagError: the bag cannot be read, is damaged before its last commit, or cannot be written.
    """
    try:
        mend(folder, disk)
    except OSError as error:
        raise BagWriteError(
            f'bag {folder} cannot be made whole: {error.strerror}. {remedy(error).capitalize()}, '
            'and start the recorder again'
        ) from error
    written = Written()
    if not holds_messages(folder):
        return written
    file = None
    for message in Bag(folder).raw():
        if file is None or message.place.file.name != file.name:
            file = BagFile(message.place.file.name)
            written.files.append(file)
            written.bytes += message.place.file.stat().st_size
        file.add(full_name(message.channel.topic), message.log_time)
        receive(message)
    return written


def mend(folder: Path, disk: Disk | None = None) -> None:
    """Give the last file of a bag its end if it lacks it, or remove it if it holds nothing.

    Raises:
        BagError: a commit lies behind a fault.
        OSError: the file cannot be written.
    """
    for path in folder.iterdir():
        if path.suffix == PARTIAL:  # of a recorder that was killed when it was here
            path.unlink()
    while holds_messages(folder):
        path = bag_files(folder, lambda damage: None)[-1]
        faults: list[Damage] = []
        count = sum(1 for _ in _sound(path, faults))
        if not count:
            path.unlink()
            continue
        if faults:
            _write_anew(path, disk or Disk())
        sync_folder(folder)
        return


def _write_anew(path: Path, disk: Disk) -> None:
    """Replace a file by one of its sound messages, with an end."""
    partial = path.with_name(f'.{path.name}{PARTIAL}')
    new = NewFile(partial, LIBRARY, disk)
    try:
        for message in _sound(path, []):
            new.add(message)
        new.finish()
    finally:
        new.close()
    disk.replace(partial, path)


def _sound(path: Path, faults: list[Damage]) -> Iterator[RawMessage]:
    """The messages before the first fault, which is put into `faults`.

    Raises:
        BagError: a commit lies behind a fault.
    """

    def note(damage: Damage) -> None:
        if not damage.harmless:
            faults.append(damage)

    for message in McapFile(path, note).messages():
        if not faults:
            yield message
        elif message.channel.type == _COMMIT:
            raise BagError(
                f'{faults[0].place}: {faults[0].text}, and a commit lies behind it at '
                f'{message.place}: the bag is damaged, not merely unfinished. Restore it from a '
                'copy, or start a new run; `codetr bag recover` keeps what can be read'
            )
