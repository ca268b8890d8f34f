"""Checkpoints: folders of two files, written whole or not at all, hashed, without pickle.

    <folder>/<name>-<phase>/tensors.safetensors    weights, optimiser moments, labels: all tensors
    <folder>/<name>-<phase>/checkpoint.json        everything else, with the sha256 of both files

A checkpoint is written under a hidden temporary name, synced and renamed. Only then are older ones
removed, so there is always a whole one to return to. A missing or damaged checkpoint is refused,
never silently replaced by a fresh start.
"""

import hashlib
import json
import logging
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors
import safetensors.torch
import torch

from codetr_ros.runs import checkpoint_names
from codetr_ros.system.disk import Disk
from codetr_ros.system.files import make_folder, named_errors, sync_folder
from codetr_ros.system.parsing import brief, parse_json, shortened
from codetr_ros.system.tensors import Part
from codetr_ros.system.tensors import digest as digest_of

_log = logging.getLogger(__name__)
every, latest, phase_of = (
    checkpoint_names.every,
    checkpoint_names.latest,
    checkpoint_names.phase_of,
)

TENSORS = 'tensors.safetensors'
DESCRIPTION = 'checkpoint.json'
MOST_VALUES = 1_000_000
"""The most numbers of an observation or action of a checkpoint."""
OF_MEMORY = ('labels/', 'versions/', 'progress/', 'given/')
"""What the names of tensors begin with that are of the memory D, not of what is trained."""
FORMAT = 1
"""Increased whenever the layout of a checkpoint changes its meaning."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be written or must not be read: the message names file, hashes and
    remedy.
    """


class Checkpoint(NamedTuple):
    """A checkpoint whose digests are right."""

    path: Path
    phase: int
    tensors: dict[str, torch.Tensor]
    meta: dict[str, Any]


def digest(tensors: Mapping[str, torch.Tensor]) -> str:
    """sha256 over names (sorted), dtypes, shapes and bytes: equal weights give equal digests."""
    held = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    return digest_of(
        Part(name, str(tensor.dtype), tensor.shape, _bytes(tensor))
        for name, tensor in held.items()
    )


def _bytes(tensor: torch.Tensor) -> bytes:
    # Through uint8, since numpy has no bfloat16. Reshaped, since a 0-dimensional tensor has no
    # byte view.
    flat = tensor.reshape(-1).view(torch.uint8).numpy()
    return bytes(np.ascontiguousarray(flat).data)


def save(
    folder: Path,
    name: str,
    phase: int,
    tensors: Mapping[str, torch.Tensor],
    meta: Mapping[str, Any],
    keep: int = 3,
    disk: Disk | None = None,
) -> Path:
    """Write a checkpoint, then remove all but the newest `keep` of this name.

    Args:
        folder: the folder of the checkpoints; made if it is missing.
        name: the name of its owner: letters, digits, `_`, `.`, `-`.
        phase: the last phase before it; an existing checkpoint of this phase is replaced.
        tensors: the state that consists of tensors, on any device.
        meta: all other state: JSON-able, numbers finite.
        keep: how many checkpoints to keep, at least 1.
        disk: where it lies; None: the disk of this machine.

    Returns:
        The checkpoint's folder.

    Raises:
        CheckpointError: the name, phase, `keep` or `meta` is refused; nothing has changed then.
        FileError: the disk is full or not writable, or an old checkpoint cannot be removed.
    """
    if not re.fullmatch(r'[A-Za-z0-9_][A-Za-z0-9_.-]*', name):
        raise CheckpointError(f'checkpoint name {name!r}: use letters, digits, "_", "." and "-"')
    if phase < 0 or keep < 1:
        raise CheckpointError(
            f'checkpoint {name}: phase={phase} must be >= 0 and keep={keep} must be >= 1'
        )
    # Own copies: safetensors refuses tensors that share memory, as views of one flat parameter do.
    copies = {
        key: value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for key, value in tensors.items()
    }
    data = safetensors.torch.save(copies)
    body = {
        'format': FORMAT,
        'name': name,
        'phase': phase,
        'digest': digest(copies),
        'tensors_sha256': hashlib.sha256(data).hexdigest(),
        'meta': dict(meta),
    }
    try:
        description = _describe(body)
    except (TypeError, ValueError) as error:
        raise CheckpointError(
            f'checkpoint {name}, phase {phase}: meta cannot be written as JSON: {error}'
        ) from None

    with named_errors(folder):
        return _write(folder, f'{name}-{phase:06d}', data, description, keep, disk or Disk())


def _write(
    folder: Path, made: str, data: bytes, description: bytes, keep: int, disk: Disk
) -> Path:
    """Write a checkpoint and remove old ones."""
    name = made.rpartition('-')[0]
    make_folder(folder)
    _remove_partial(folder, name)
    path, partial = folder / made, folder / f'.{made}.partial'
    make_folder(partial)
    disk.write(partial / TENSORS, data)
    disk.write(partial / DESCRIPTION, description)
    sync_folder(partial)
    if path.exists():
        # A rename cannot replace a folder that is not empty. The name counts as partial: if the
        # machine stops between the two renames, the next older checkpoint is the latest.
        disk.replace(path, folder / f'.{made}.replaced.partial')
    disk.replace(partial, path)
    sync_folder(folder)
    _remove_partial(folder, name)
    for old in every(folder, name)[:-keep]:
        if old != path:  # after a return to an earlier phase the newest need not be the highest
            shutil.rmtree(old)
    return path


def load(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Verify the sha256 of both files of a checkpoint and read it.

    Returns:
        The tensors (on the CPU, in memory of their own) and the `meta` that were saved.

    Raises:
        CheckpointError: a file is missing, damaged or of another format; names the file, both
            hashes and the remedy.
    """
    remedy = f'remove {path} to continue from an older checkpoint, or restore it from a copy'
    content = {}
    for file in (DESCRIPTION, TENSORS):
        try:
            content[file] = (path / file).read_bytes()
        except OSError as error:
            raise CheckpointError(
                f'checkpoint file {path / file} cannot be read ({error.strerror}): {remedy}'
            ) from error

    try:
        description = parse_json(content[DESCRIPTION])
        stored = description.pop('sha256')
        actual = hashlib.sha256(_canonical(description)).hexdigest()
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        actual = hashlib.sha256(content[DESCRIPTION]).hexdigest()
        raise CheckpointError(
            f'checkpoint file {path / DESCRIPTION} is damaged: not a description with its sha256 '
            f'({type(error).__name__}: {brief(error)}; the file has sha256 {actual}): {remedy}'
        ) from None
    if stored != actual:
        raise CheckpointError(_damaged(path / DESCRIPTION, actual, stored, remedy))
    if description.get('format') != FORMAT:
        raise CheckpointError(
            f'checkpoint {path} has format {description.get("format")!r}, but this version reads '
            f'{FORMAT}: read it with the version that wrote it'
        )
    for name, kind in (('tensors_sha256', str), ('digest', str), ('meta', dict)):
        if not isinstance(description.get(name), kind):
            raise CheckpointError(
                f'checkpoint file {path / DESCRIPTION} is damaged although its sha256 is right: '
                f'{name} = {shortened(repr(description.get(name)))} must be of type '
                f'{kind.__name__}: {remedy}'
            )
    actual, stored = hashlib.sha256(content[TENSORS]).hexdigest(), description['tensors_sha256']
    if stored != actual:
        raise CheckpointError(_damaged(path / TENSORS, actual, stored, remedy))
    tensors = _tensors(content[TENSORS], path / TENSORS, remedy)
    if (actual := digest(tensors)) != (stored := description['digest']):
        raise CheckpointError(
            f'checkpoint file {path / TENSORS} is damaged although its sha256 is right: the '
            f'digest of its tensors is {actual}, should be {stored}: {remedy}'
        )
    return tensors, description['meta']


def sizes_of(meta: Mapping[str, Any], path: Path) -> tuple[int, int]:
    """The sizes of observations and actions, by the `meta` of a checkpoint.

    Raises:
        CheckpointError: it has none, or no whole numbers of 1 to `MOST_VALUES`.
    """
    sizes = []
    for name in ('observation_size', 'action_size'):
        size = meta.get(name)
        if type(size) is not int or not 1 <= size <= MOST_VALUES:
            raise CheckpointError(
                f'checkpoint {path}: {name} = {shortened(repr(size))} must be a whole number from '
                f'1 to {MOST_VALUES}: it is damaged, or not that of a reward model or learner'
            )
        sizes.append(size)
    return sizes[0], sizes[1]


def _tensors(data: bytes, file: Path, remedy: str) -> dict[str, torch.Tensor]:
    try:
        return safetensors.torch.load(data)
    except (safetensors.SafetensorError, ValueError, LookupError, TypeError) as error:
        raise CheckpointError(
            f'checkpoint file {file} is damaged although its sha256 is right: it holds no tensors '
            f'({type(error).__name__}: {brief(error)}): {remedy}'
        ) from None


def _damaged(file: Path, actual: str, stored: str, remedy: str) -> str:
    return f'checkpoint file {file} is damaged: sha256 is {actual}, should be {stored}: {remedy}'


def sound(
    folder: Path,
    name: str,
    newest: int | None = None,
    log: Callable[[str], None] = _log.error,
) -> Iterator[Checkpoint]:
    """The checkpoints of this name whose digests are right, newest first. A damaged one is logged
    and passed over.

    Args:
        folder: the folder of the checkpoints.
        name: the name of their owner.
        newest: the highest phase to look at; None: any.
        log: takes what is wrong with one.
    """
    for path in reversed(every(folder, name)):
        if newest is not None and phase_of(path) > newest:
            continue
        try:
            tensors, meta = load(path)
        except CheckpointError as error:
            log(f'{error}. The one before it is looked at')
            continue
        yield Checkpoint(path, phase_of(path), tensors, meta)


def remove_after(folder: Path, name: str, phase: int) -> list[Path]:
    """Remove the checkpoints of later phases than this one, and return what they were: a run that
    has gone back to it makes them again.
    """
    later = [path for path in every(folder, name) if phase_of(path) > phase]
    with named_errors(folder):
        for path in later:
            shutil.rmtree(path)
    return later


def of_model(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Of a checkpoint's tensors those of what is trained, without those of the memory D."""
    return {name: value for name, value in tensors.items() if not name.startswith(OF_MEMORY)}


def _remove_partial(folder: Path, name: str) -> None:
    """Remove what a process left behind that was killed during a save."""
    pattern = re.compile(r'\.' + re.escape(name) + r'-\d{6,}(\.replaced)?\.partial')
    for path in folder.iterdir():
        if pattern.fullmatch(path.name):
            shutil.rmtree(path)


def _canonical(body: Mapping[str, Any]) -> bytes:
    return json.dumps(body, sort_keys=True, allow_nan=False, separators=(',', ':')).encode()


def _describe(body: Mapping[str, Any]) -> bytes:
    canonical = _canonical(body)
    complete = {**json.loads(canonical), 'sha256': hashlib.sha256(canonical).hexdigest()}
    return (json.dumps(complete, indent=2) + '\n').encode()
