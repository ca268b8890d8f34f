import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from codetr_ros.runs import checkpoints
from codetr_ros.runs.checkpoints import CheckpointError
from codetr_ros.system.disk import Disk
from codetr_ros.system.files import FileError


def state() -> dict[str, torch.Tensor]:
    return {
        'actor.weight': torch.arange(12, dtype=torch.float32).reshape(3, 4),
        'log_temperature': torch.tensor(-0.5, dtype=torch.float64),
        'updates': torch.tensor(7),
        'empty': torch.zeros(0, 3),
        'half': torch.tensor([1.5, -2.0], dtype=torch.bfloat16),
    }


META = {'phase': 4, 'scale': 0.1, 'names': ['a', 'b'], 'note': 'Größe'}


def test_what_was_saved_is_loaded_again_bit_for_bit(tmp_path: Path) -> None:
    path = checkpoints.save(tmp_path / 'checkpoints', 'learner', 4, state(), META)

    tensors, meta = checkpoints.load(path)

    assert path.name == 'learner-000004'
    assert sorted(p.name for p in path.iterdir()) == ['checkpoint.json', 'tensors.safetensors']
    assert meta == META
    assert tensors.keys() == state().keys()
    for name, tensor in state().items():
        assert tensors[name].dtype == tensor.dtype
        assert torch.equal(tensors[name], tensor)
    assert checkpoints.digest(tensors) == checkpoints.digest(state())


def test_tensors_that_share_memory_or_are_not_contiguous_are_saved_as_they_read(
    tmp_path: Path,
) -> None:
    flat = torch.arange(6, dtype=torch.float32)
    views = {'a': flat[:4].view(2, 2).t(), 'b': flat[2:], 'c': flat.requires_grad_()}

    tensors, _ = checkpoints.load(checkpoints.save(tmp_path, 'learner', 0, views, {}))

    assert tensors['a'].tolist() == [[0, 2], [1, 3]]
    assert tensors['b'].tolist() == [2, 3, 4, 5]
    assert tensors['c'].tolist() == [0, 1, 2, 3, 4, 5]


def test_the_digest_depends_on_names_types_shapes_and_values_only() -> None:
    tensors = state()
    known = checkpoints.digest({'w': torch.tensor([[1.0, 2.0]])})

    assert checkpoints.digest(dict(reversed(tensors.items()))) == checkpoints.digest(tensors)
    # Written down once: it must be the same on every machine and in every later version.
    assert known == 'f3057063be05d6841bfd37c557b844434bf8fe3bc3f62c3d824a9716420a0270'
    assert checkpoints.digest({'v': torch.tensor([[1.0, 2.0]])}) != known
    assert checkpoints.digest({'w': torch.tensor([1.0, 2.0])}) != known
    assert checkpoints.digest({'w': torch.tensor([[1.0, 2.0]]).double()}) != known
    assert checkpoints.digest({'w': torch.tensor([[1.0, 2.0000002]])}) != known


def test_three_checkpoints_are_kept_and_the_newest_is_the_latest(tmp_path: Path) -> None:
    for phase in range(6):
        checkpoints.save(tmp_path, 'learner', phase, state(), {'phase': phase})
    checkpoints.save(tmp_path, 'learner-2', 0, state(), {})

    kept = sorted(p.name for p in tmp_path.iterdir())

    assert kept == ['learner-000003', 'learner-000004', 'learner-000005', 'learner-2-000000']
    assert checkpoints.latest(tmp_path, 'learner') == tmp_path / 'learner-000005'
    assert checkpoints.latest(tmp_path, 'learner-2') == tmp_path / 'learner-2-000000'
    assert checkpoints.latest(tmp_path, 'reward') is None
    assert checkpoints.latest(tmp_path / 'nowhere', 'reward') is None


def test_a_checkpoint_written_after_a_return_to_an_earlier_phase_is_not_removed(
    tmp_path: Path,
) -> None:
    for phase in (5, 6, 7):
        checkpoints.save(tmp_path, 'learner', phase, state(), {})

    path = checkpoints.save(tmp_path, 'learner', 4, state(), {'again': True})

    assert checkpoints.load(path)[1] == {'again': True}


def test_a_second_checkpoint_of_a_phase_replaces_the_first(tmp_path: Path) -> None:
    checkpoints.save(tmp_path, 'learner', 3, state(), {'attempt': 1})

    path = checkpoints.save(tmp_path, 'learner', 3, {'w': torch.ones(2)}, {'attempt': 2})

    tensors, meta = checkpoints.load(path)
    assert meta == {'attempt': 2}
    assert list(tensors) == ['w']
    assert [p.name for p in tmp_path.iterdir()] == ['learner-000003']


DIES_WHILE_SAVING = """
import os, sys
from pathlib import Path
import torch
from codetr_ros.runs import checkpoints
from codetr_ros.system import disk

def die_at(step, original):
    def wrapped(*args):
        calls.append(original)
        if len(calls) == step:
            os._exit(9)
        return original(*args)
    return wrapped

for phase in (1, 2):
    for step in range(1, 7):
        folder = Path(sys.argv[1]) / f'{phase}-{step}'
        for old in (0, 1):
            checkpoints.save(folder, 'learner', old, {'w': torch.zeros(3)}, {'new': False})
        child = os.fork()
        if child == 0:
            calls = []
            disk.write_synced = die_at(step, disk.write_synced)
            checkpoints.sync_folder = die_at(step, checkpoints.sync_folder)
            os.replace = die_at(step, os.replace)
            checkpoints.save(folder, 'learner', phase, {'w': torch.ones(3)}, {'new': True})
            os._exit(0)
        _, status = os.waitpid(child, 0)
        print(phase, step, os.waitstatus_to_exitcode(status))
"""


@pytest.mark.slow
def test_a_process_killed_while_saving_leaves_a_whole_checkpoint_behind(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, '-c', DIES_WHILE_SAVING, tmp_path],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )

    codes = [tuple(map(int, line.split())) for line in run.stdout.splitlines()]
    # Replacing a phase takes one rename more: the sixth operation is reached, and fatal, only
    # there.
    assert codes == [(phase, step, 9 if step <= 7 - phase else 0) for phase, step, _ in codes]
    assert len(codes) == 12
    for phase, step, _ in codes:
        folder = tmp_path / f'{phase}-{step}'
        latest = checkpoints.latest(folder, 'learner')
        assert latest is not None
        tensors, meta = checkpoints.load(latest)
        assert tensors['w'].tolist() == [float(meta['new'])] * 3

        checkpoints.save(folder, 'learner', 3, state(), {})
        left = [p.name for p in folder.iterdir() if p.name.startswith('.')]
        assert left == [], 'the next save clears away what the killed one left'


def refusal(path: Path) -> str | None:
    try:
        checkpoints.load(path)
    except CheckpointError as error:
        return str(error)
    return None


def test_every_flipped_byte_is_refused_or_harmless(tmp_path: Path) -> None:
    path = checkpoints.save(tmp_path, 'learner', 1, {'w': torch.ones(2)}, {'a': 1.5, 'b': 'text'})
    for name in ('checkpoint.json', 'tensors.safetensors'):
        file = path / name
        original = file.read_bytes()
        for i in range(len(original)):
            damaged = bytearray(original)
            damaged[i] ^= 0x01
            file.write_bytes(damaged)
            said = refusal(path)
            if said is None:
                assert name == 'checkpoint.json', f'byte {i} of the tensors may not change'
                assert chr(original[i]).isspace(), 'nothing but white space may change'
                tensors, meta = checkpoints.load(path)
                assert meta == {'a': 1.5, 'b': 'text'}
                assert tensors['w'].tolist() == [1, 1]
            else:
                assert f'{file} is damaged' in said
        file.write_bytes(original)


def test_damage_is_named_with_both_hashes_and_what_to_do(tmp_path: Path) -> None:
    path = checkpoints.save(tmp_path, 'learner', 1, state(), {})
    said = json.loads((path / 'checkpoint.json').read_text())['tensors_sha256']
    with (path / 'tensors.safetensors').open('r+b') as file:
        file.seek(-1, os.SEEK_END)
        file.write(b'\x55')

    with pytest.raises(CheckpointError) as refused:
        checkpoints.load(path)

    text = str(refused.value)
    assert str(path / 'tensors.safetensors') in text
    assert f'should be {said}' in text
    assert text.count(said[:8]) == 1, 'the other hash is that of the damaged file'
    assert f'remove {path} to continue from an older checkpoint' in text


@pytest.mark.parametrize('missing', ['checkpoint.json', 'tensors.safetensors'])
def test_a_missing_file_is_refused_by_name(tmp_path: Path, missing: str) -> None:
    path = checkpoints.save(tmp_path, 'learner', 1, state(), {})
    (path / missing).unlink()

    with pytest.raises(CheckpointError, match=rf'{missing} cannot be read \(No such file'):
        checkpoints.load(path)


def test_a_checkpoint_of_another_format_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoints, 'FORMAT', 99)
    path = checkpoints.save(tmp_path, 'learner', 1, state(), {})
    monkeypatch.undo()

    with pytest.raises(CheckpointError, match='has format 99, but this version reads 1'):
        checkpoints.load(path)


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'name': '../learner'}, r"checkpoint name '\.\./learner'"),
        ({'phase': -1}, 'phase=-1 must be >= 0'),
        ({'keep': 0}, 'keep=0 must be >= 1'),
        ({'meta': {'loss': float('nan')}}, 'meta cannot be written as JSON: Out of range float'),
        ({'meta': {'array': object()}}, 'meta cannot be written as JSON: .*object'),
    ],
)
def test_what_cannot_be_saved_is_refused_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    arguments: dict[str, Any] = {'name': 'learner', 'phase': 1, 'tensors': state(), 'meta': {}}

    with pytest.raises(CheckpointError, match=said):
        checkpoints.save(tmp_path, **(arguments | changes))

    assert list(tmp_path.iterdir()) == []


class Vanishes(Disk):
    """A disk whose folder is a file all of a sudden, right behind a rename."""

    def replace(self, old: Path, new: Path) -> None:
        super().replace(old, new)
        new.parent.rename(new.parent.with_name('away'))
        new.parent.touch()


def test_a_folder_that_vanishes_during_a_save_is_named_with_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / 'checkpoints'
    with pytest.raises(FileError, match='Not a directory') as error:
        checkpoints.save(folder, 'm', 0, {'w': torch.zeros(2)}, {}, disk=Vanishes())
    assert str(error.value).startswith(f'{folder} cannot be written: ')


def test_a_folder_that_was_copied_elsewhere_still_loads(tmp_path: Path) -> None:
    path = checkpoints.save(tmp_path / 'a', 'learner', 1, state(), META)
    shutil.copytree(path, tmp_path / 'b' / 'learner-000001')

    assert checkpoints.load(tmp_path / 'b' / 'learner-000001')[1] == META
