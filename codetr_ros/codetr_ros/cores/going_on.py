"""What a consumer's checkpoint holds beside weights and optimisers, and how it is checked.

A consumer that goes on from a checkpoint takes the phases up to it into its memory D as before,
without learning from them: transitions, scores and evictions come out as they were. Labels are not
inferred again: the checkpoint has them, with the versions of the model that gave them.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from codetr_ros.config import Settings, SettingsError, from_canonical
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import RunSpec
from codetr_ros.runs.checkpoints import Checkpoint, CheckpointError

KEY = 'going_on'
"""The entry of a checkpoint's `meta` that holds counts and metrics."""
MAY_CHANGE = ('steps',)
"""Settings that may be others when a run goes on."""


def memory_tensors(memory: Trajectories) -> dict[str, Tensor]:
    """What is known of the steps held beside what the records say: labels above all."""
    tensors = {}
    for column, by_source in memory.labelled.columns().items():
        for source, values in by_source.items():
            signed = values.view(np.int32) if values.dtype == np.uint32 else values
            tensors[f'{column}/{source}'] = torch.from_numpy(signed)
    return tensors


def restore_labels(memory: Trajectories, checkpoint: Checkpoint) -> None:
    """Give the steps of a memory the labels of a checkpoint.

    Args:
        memory: holds the phases up to the checkpoint's.
        checkpoint: of the same run.

    Raises:
        CheckpointError: it is of other steps than the memory holds.
    """
    restored: dict[str, dict[str, NDArray[Any]]] = {}
    for column, by_source in memory.labelled.columns().items():
        restored[column] = {}
        for source, values in by_source.items():
            saved = checkpoint.tensors.get(f'{column}/{source}')
            if saved is None or saved.shape != values.shape:
                raise CheckpointError(
                    f'checkpoint {checkpoint.path} has {column} of '
                    f'{0 if saved is None else len(saved)} steps of {source!r}, of which the '
                    f'records up to phase {checkpoint.phase} leave {len(values)} in memory: it is '
                    'of other records. Remove it, and the phases are learnt from again'
                )
            restored[column][source] = saved.numpy().view(values.dtype)
    memory.labelled.restore(restored)


def check(checkpoint: Checkpoint, run: RunSpec, settings: Settings) -> None:
    """Refuse a checkpoint from which a run cannot go on to the bit.

    Raises:
        CheckpointError: it is of another run, of other settings, or lacks what is needed.
    """
    meta, path = checkpoint.meta, checkpoint.path
    if meta.get('run_id') != run.run_id:
        raise CheckpointError(
            f'checkpoint {path} is of run {meta.get("run_id")!r}, this is run {run.run_id!r}: '
            'give each run a folder of its own'
        )
    if not isinstance(meta.get(KEY), Mapping):
        raise CheckpointError(
            f'checkpoint {path} was saved by a version from whose checkpoints no run can go on: '
            'start the run again, or finish it with the version that began it'
        )
    if changed := other_settings(str(meta.get('settings')), settings, f'checkpoint {path}'):
        raise CheckpointError(
            f'checkpoint {path} was saved with {changed}: a run goes on with the settings that it '
            f'began with, only {", ".join(MAY_CHANGE)} may change'
        )


def other_settings(before: str, settings: Settings, source: str) -> str:
    """In what settings differ from those of before, in words; empty if in nothing that matters.

    Args:
        before: the settings as JSON.
        settings: those of now.
        source: where the former are from.
    """
    try:
        theirs = from_canonical(before, source).flat()
    except SettingsError as error:
        return str(error)
    ours = settings.flat()
    return ', '.join(
        f'{name} = {theirs[name]!r} (here {value!r})'
        for name, value in ours.items()
        if name not in MAY_CHANGE and theirs[name] != value
    )


def counted(meta: Mapping[str, Any], name: str) -> 'Counter[str]':
    """Counts in a checkpoint's `meta`, by name."""
    return Counter({str(key): int(value) for key, value in meta[KEY].get(name, {}).items()})


def as_text(values: Mapping[str, float]) -> dict[str, str]:
    """Numbers as JSON can hold them, whatever they are: exactly."""
    return {name: repr(float(value)) for name, value in values.items()}


def from_text(values: Mapping[str, str]) -> dict[str, float]:
    """The numbers that `as_text` was given."""
    return {name: float(value) for name, value in values.items()}
