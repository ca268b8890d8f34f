"""Some segments of a run or a fit, step by step: for pictures, and as a file for programs."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from codetr_ros.records import F32, F64
from codetr_ros.runs.folder import RunFolderError

SHOWN = 6
"""Number of segments of which a report shows every step."""
_COLUMNS = ('source', 'episode', 'first_step', 'step', 'score', 'inferred', 'true')


@dataclass(frozen=True, kw_only=True, eq=False)
class Segment:
    """Every step of one segment.

    Attributes:
        source: whose episode it belongs to.
        episode: number of the episode.
        first: index within the episode of the first step.
        value: its composite reward; None if not known.
        labels: inferred step rewards (n,), in the task's unit.
        true: the environment's own (n,); None if not known.
        predicted: the composite reward that the model predicts; None if it predicts none.
        weights: attention weights w (n,), 1 on average; None if the model has none.
        deviations: how far each inferred reward (n,) may be off; None if the model cannot tell.
    """

    source: str
    episode: int
    first: int
    value: float | None
    labels: F32 | F64
    true: F32 | None
    predicted: float | None = None
    weights: F32 | None = None
    deviations: F32 | F64 | None = None


def spread_evenly(values: ArrayLike, count: int = SHOWN) -> list[int]:
    """The places of so many values, spread evenly from the lowest to the highest."""
    order = np.argsort(np.asarray(values, np.float64), kind='stable')
    places = np.linspace(0, len(order) - 1, min(count, len(order))).round().astype(int)
    return [int(order[place]) for place in places]


def to_csv(segments: Sequence[Segment]) -> str:
    """The segments as text: a line for each step. What is not known is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(_COLUMNS)
    for one in segments:
        score = '' if one.value is None else repr(one.value)
        true = [''] * len(one.labels) if one.true is None else [str(v) for v in one.true]
        for i, (label, own) in enumerate(zip(one.labels, true, strict=True)):
            step = one.first + i
            writer.writerow([one.source, one.episode, one.first, step, score, str(label), own])
    return text.getvalue()


def read_csv(path: Path) -> list[Segment]:
    """The segments of a file that `to_csv` made.

    Raises:
        RunFolderError: it cannot be read, or is no such file.
    """
    try:
        with path.open(newline='') as file:
            rows = list(csv.DictReader(file))
        groups: dict[tuple[str, int, int], list[dict[str, str]]] = {}
        for row in rows:
            key = row['source'], int(row['episode']), int(row['first_step'])
            groups.setdefault(key, []).append(row)
        return [_segment(*key, steps) for key, steps in groups.items()]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise RunFolderError(
            f'{path} is not a file of step rewards ({error}): remove it, a report can do without '
            'it'
        ) from None


def _segment(source: str, episode: int, first: int, steps: Sequence[dict[str, str]]) -> Segment:
    score, true = steps[0]['score'], [row['true'] for row in steps]
    return Segment(
        source=source,
        episode=episode,
        first=first,
        value=float(score) if score else None,
        labels=np.array([float(row['inferred']) for row in steps], np.float32),
        true=np.array([float(v) for v in true], np.float32) if all(true) else None,
    )
