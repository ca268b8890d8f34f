"""Pictures of a benchmark: learning curves and reward recovery over training."""

import io
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codetr_ros.benchmark.results import Result
from codetr_ros.benchmark.table import methods
from codetr_ros.runs.run_summary import Evaluation, RewardRecovery

_COLOURS = (
    '#1f77b4',
    '#d62728',
    '#2ca02c',
    '#9467bd',
    '#ff7f0e',
    '#8c564b',
    '#e377c2',
    '#17becf',
    '#bcbd22',
    '#333333',
)
_STYLES = ('-', '--', '-.', ':')
_ANCHORS = {'random': ('random policy', '--'), 'zero': ('standing still', ':')}

_ROWS: Mapping[str, Callable[[Result], Sequence[Evaluation | RewardRecovery]]] = {
    'evaluations': lambda result: result.evaluations,
    'reward_recovery': lambda result: result.reward_recovery,
}

Curve = tuple[list[int], list[float], list[float], list[float]]
"""Steps, and at each the mean, lowest and highest value of the seeds."""


def curve(results: Sequence[Result], key: str, of: str) -> Curve:
    """A number over training, over all seeds that have it.

    Args:
        results: cells that differ in their seed only.
        key: of the summary: `evaluations` or `reward_recovery`.
        of: name of the number in a row.
    """
    at: dict[int, list[float]] = defaultdict(list)
    for result in results:
        for row in _ROWS[key](result):
            value: float | None = getattr(row, of)
            if value is not None:
                at[row.step].append(value)
    steps = sorted(at)
    means = [float(np.mean(at[step])) for step in steps]
    return steps, means, [min(at[step]) for step in steps], [max(at[step]) for step in steps]


def learning_curves(
    results: Sequence[Result],
    order: Sequence[str],
    anchors: Mapping[str, Mapping[str, float]],
    title: str,
) -> bytes:
    """Score and true return over training, as a PNG.

    Args:
        results: the cells of one task, composite reward and delay.
        order: all methods of the report, so that each has the same colour in every picture.
        anchors: numbers of `random` and `zero`.
        title: of the picture.
    """
    return _picture(
        results,
        order,
        title,
        'evaluations',
        {'score_mean': 'score', 'true_return_mean': 'true return'},
        anchors,
    )


def recovery_curves(results: Sequence[Result], order: Sequence[str], title: str) -> bytes | None:
    """Correlation of labels and true rewards over training, as a PNG; None if there are none."""
    if not any(result.reward_recovery for result in results):
        return None
    names = {
        'pearson': 'Pearson, all steps',
        'within': "Pearson, segments' means removed",
    }
    return _picture(results, order, title, 'reward_recovery', names, {})


def _picture(
    results: Sequence[Result],
    order: Sequence[str],
    title: str,
    key: str,
    names: Mapping[str, str],
    anchors: Mapping[str, Mapping[str, float]],
) -> bytes:
    # Without pyplot there is no display, and no state that outlives the picture.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.6), dpi=110, layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    handles: dict[str, Any] = {}
    panels = figure.subplots(1, len(names))
    for axes, (of, label) in zip(panels, names.items(), strict=True):
        axes.set(xlabel='environment steps', ylabel=label)
        axes.grid(alpha=0.25)
        axes.spines[['top', 'right']].set_visible(False)
        for policy, numbers in anchors.items():
            name, style = _ANCHORS[policy]
            handles[name] = axes.axhline(numbers[of], color='#777777', ls=style, lw=1.5)
        # the first method last, so that nothing hides it
        for method in reversed(methods(results)):
            some = [result for result in results if result.method == method]
            steps, means, low, high = curve(some, key, of)
            if steps:
                i = order.index(method)
                colour = _COLOURS[i % len(_COLOURS)]
                axes.fill_between(steps, low, high, color=colour, alpha=0.12, lw=0)
                (handles[method],) = axes.plot(
                    steps,
                    means,
                    _STYLES[i // len(_COLOURS) % len(_STYLES)],
                    color=colour,
                    marker='o',
                    markersize=3.5,
                    lw=2.6 if i == 0 else 1.6,
                )
    shown = [name for name in (*order, *(n for n, _ in _ANCHORS.values())) if name in handles]
    if shown:
        places: Callable[..., Any] = figure.legend
        places([handles[n] for n in shown], shown, loc='outside right center', frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format='png')
    return picture.getvalue()
