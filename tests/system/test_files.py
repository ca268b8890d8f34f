"""What is advised where a file cannot be written, and checks that leave nothing behind."""

import errno
import os
import subprocess
from pathlib import Path

import pytest

from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.folder import RunFolderError
from codetr_ros.system.files import FileError, atomic_write, check_writable
from helpers.disks import fill, small_disk


def test_a_disk_that_is_mounted_to_be_read_is_not_to_be_made_room_on(tmp_path: Path) -> None:
    with small_disk(tmp_path / 'disk', 1) as disk:
        subprocess.run(['mount', '-o', 'remount,ro', str(disk)], check=True)
        with pytest.raises(FileError) as refused:
            atomic_write(disk / 'file', 'text')
        with pytest.raises(RunFolderError) as refused_folder:
            run_folder.create(disk / 'run')
    for text in str(refused.value), str(refused_folder.value):
        assert 'Read-only file system. Mount the disk so that it can be written, or choose' in text
        assert 'room' not in text
    assert 'choose another folder with --out' in str(refused_folder.value)


def test_on_a_full_disk_room_is_to_be_made(tmp_path: Path) -> None:
    with small_disk(tmp_path / 'disk', 1) as disk:
        fill(disk)
        with pytest.raises(FileError, match='No space left on device. Make room, or choose'):
            atomic_write(disk / 'file', bytes(100_000))


@pytest.mark.parametrize('number', [errno.EMFILE, errno.EIO, errno.EACCES, errno.ENOTDIR])
def test_room_is_not_advised_where_there_is_another_cause(number: int) -> None:
    text = str(FileError(number, os.strerror(number), 'file'))
    assert text.startswith(f'file cannot be written: {os.strerror(number)}. ')
    assert 'room' not in text


def test_a_folder_is_checked_without_a_trace(tmp_path: Path) -> None:
    check_writable(tmp_path)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileError, match='No such file or directory'):
        check_writable(tmp_path / 'none')
    with pytest.raises(FileError, match='/proc cannot be written'):
        check_writable(Path('/proc'))
