"""Pictures of a benchmark: learning curves and reward recovery over training."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codetr_ros.benchmark.results import Result
from codetr_ros.benchmark.table import methods
from codetr_ros.runs import pictures
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
    'evaluations': lambda result: result.summary.evaluated() if result.summary else (),
    'reward_recovery': lambda result: result.reward_recovery,
}

Curve = tuple[list[int], list[float], list[float], list[float]]
"""Steps, and at each the mean, lowest and highest value of the seeds."""


def curve(results: Sequence[Result], key: str, of: str) -> Curve:
    """A number over training, over all seeds that have it.

    Args:
        results: cells that differ in their seed only.
        key: of the summary: `evaluations`, which begin with the random policy at step 0, or
            `reward_recovery`.
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
    def draw(figure: pictures.Figure) -> None:
        figure.suptitle(title, fontsize=10, wrap=True)
        handles: dict[str, Any] = {}
        panels = figure.subplots(len(names), 1, sharex=True)
        for axes, (of, label) in zip(panels, names.items(), strict=True):
            axes.set_ylabel(label)
            for policy, numbers in anchors.items():
                name, style = _ANCHORS[policy]
                handles[name] = axes.axhline(numbers[of], color='#777777', ls=style, lw=1.5)
            # the first method last, so that nothing hides it
            for method in reversed(methods(results)):
                some = [result for result in results if result.method == method]
                if line := _curve(axes, curve(some, key, of), order.index(method)):
                    handles[method] = line
            pictures.plain(axes)
        panels[-1].set_xlabel('environment steps')
        panels[-1].set_xlim(left=0)
        all_names = (*order, *(n for n, _ in _ANCHORS.values()))
        shown = [name for name in all_names if name in handles]
        if shown:
            lines = [handles[name] for name in shown]
            figure.legend(lines, shown, loc='outside lower center', ncols=4, frameon=False)

    return pictures.png((pictures.WIDE, 6.4), draw)


def _curve(axes: pictures.Axes, of: Curve, i: int) -> Any:
    """Draw the curve of the i-th method, with its range; None if it has no point."""
    steps, means, low, high = of
    if not steps:
        return None
    colour = _COLOURS[i % len(_COLOURS)]
    axes.fill_between(steps, low, high, color=colour, alpha=0.12, lw=0)
    (line,) = axes.plot(
        steps,
        means,
        _STYLES[i // len(_COLOURS) % len(_STYLES)],
        color=colour,
        marker='o',
        markersize=3.5,
        lw=2.6 if i == 0 else 1.6,
    )
    return line
