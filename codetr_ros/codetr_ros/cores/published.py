"""The labels of a phase as they are published: in parts, and once more from a checkpoint."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codetr_ros.memory.labelled import LabelledSteps
from codetr_ros.records import MESSAGE_BYTES, StepRewards
from codetr_ros.runs.checkpoints import Checkpoint

GIVEN = 'given/'
"""What the names of the tensors begin with that a checkpoint has of them."""
_SPANS = ('episodes', 'first_steps', 'lengths')


def numbered(
    run_id: str, phase: int, version: int, pieces: Sequence[StepRewards], commit: str
) -> list[StepRewards]:
    """Join small pieces, source by source, into parts as large as allowed, and number them. If
    there are none, one empty part.

    Args:
        run_id: of the run.
        phase: of which they are.
        version: of the model that made them.
        pieces: the labels.
        commit: digest of the commit that they were made of.
    """
    parts: list[list[StepRewards]] = []
    size = MESSAGE_BYTES
    for piece in sorted(pieces, key=lambda piece: piece.source):
        weight = len(piece.labels) * 4 + len(piece.lengths) * 12
        if size + weight > MESSAGE_BYTES or parts[-1][0].source != piece.source:
            parts.append([])
            size = 0
        parts[-1].append(piece)
        size += weight
    if not parts:
        return [_empty(run_id, phase, version, commit)]
    return [
        StepRewards(
            run_id=run_id,
            phase=phase,
            version=version,
            part=i,
            parts=len(parts),
            source=part[0].source,
            episodes=np.concatenate([piece.episodes for piece in part]),
            first_steps=np.concatenate([piece.first_steps for piece in part]),
            lengths=np.concatenate([piece.lengths for piece in part]),
            labels=np.concatenate([piece.labels for piece in part]),
            commit=commit,
        )
        for i, part in enumerate(parts)
    ]


def _empty(run_id: str, phase: int, version: int, commit: str) -> StepRewards:
    nothing = np.empty(0, np.uint32)
    return StepRewards(
        run_id=run_id,
        phase=phase,
        version=version,
        part=0,
        parts=1,
        source='',
        episodes=nothing,
        first_steps=nothing,
        lengths=nothing,
        labels=np.empty(0, np.float32),
        commit=commit,
    )


def described(parts: Sequence[StepRewards]) -> dict[str, Any]:
    """What a checkpoint holds of published labels as JSON: phase, version and sources of parts."""
    return {
        'phase': parts[0].phase if parts else 0,
        'version': parts[0].version if parts else 0,
        'sources': [part.source for part in parts],
    }


def spans(parts: Sequence[StepRewards]) -> dict[str, Tensor]:
    """What it holds as tensors: where the labels lie. The labels themselves are the memory's."""
    return {
        f'{GIVEN}{i}/{name}': torch.from_numpy(getattr(part, name).view(np.int32))
        for i, part in enumerate(parts)
        for name in _SPANS
    }


def again(
    facts: Mapping[str, Any],
    checkpoint: Checkpoint,
    labelled: LabelledSteps,
    run_id: str,
    commit: str,
) -> list[StepRewards]:
    """The parts that were published before a checkpoint was saved.

    Args:
        facts: what `described` made of them.
        checkpoint: holds what `spans` made of them.
        labelled: the labels of the memory, as they were then.
        run_id: of the run.
        commit: digest of the commit that they were made of.
    """
    parts = []
    for i, source in enumerate(facts['sources']):
        rows: dict[str, Any] = {
            name: checkpoint.tensors[f'{GIVEN}{i}/{name}'].numpy().view(np.uint32).copy()
            for name in _SPANS
        }
        parts.append(
            StepRewards(
                run_id=run_id,
                phase=int(facts['phase']),
                version=int(facts['version']),
                part=i,
                parts=len(facts['sources']),
                source=source,
                labels=labelled.of(source, *rows.values()),
                commit=commit,
                **rows,
            )
        )
    return parts
