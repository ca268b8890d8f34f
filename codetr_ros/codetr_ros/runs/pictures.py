"""The pictures that reports share, each a PNG.

They are 6.4 inches wide or less and their text is large, so that a phone shows them legibly.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from codetr_ros.runs.numbers import exact
from codetr_ros.runs.segments import Segment

TRUE, INFERRED, GREY = '#1f5fa8', '#b8561c', '#555555'
"""Colours of what is true, of what is inferred, and of what both are compared with."""
WIDE = 6.4
_MOST_POINTS = 5000
"""The most points of a scatter plot; of more, every n-th is shown, as the caption states."""

Axes = Any  # matplotlib has no types
Figure = Any


def png(size: tuple[float, float], draw: Callable[[Figure], None]) -> bytes:
    """A picture of so many inches as `draw` fills it."""
    # Without pyplot: no display, no state that outlives the picture, half the import time.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    figure = Canvas(figsize=size, dpi=150, layout='constrained')
    FigureCanvasAgg(figure)
    draw(figure)
    picture = io.BytesIO()
    figure.savefig(picture, format='png')
    return picture.getvalue()


def plain(axes: Axes) -> None:
    """A light grid, no frame above and to the right, and numbers without exponents."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.grid(alpha=0.3)
    axes.spines[['top', 'right']].set_visible(False)
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == 'linear':
            axis.get_major_formatter().set_scientific(False)
            axis.get_major_formatter().set_useOffset(False)
        else:
            low, high = axis.get_view_interval()
            if high < 100 * low:
                axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: exact(value)))
            axis.set_minor_formatter(NullFormatter())


def line(axes: Axes, points: Sequence[tuple[float, float]], label: str, colour: str) -> None:
    """A curve with its points; nothing if there are none."""
    if points:
        x, y = zip(*points, strict=True)
        # the last point lies on the border
        axes.plot(
            x, y, 'o-', color=colour, markersize=3.5, lw=1.6, label=label, clip_on=False, zorder=3
        )


def scatter(axes: Axes, x: ArrayLike, y: ArrayLike, caption: str) -> None:
    """Points of (x, y): the fewer there are, the larger and the more opaque."""
    across, up = np.asarray(x), np.asarray(y)
    every = -(-len(across) // _MOST_POINTS)
    across, up = across[::every], up[::every]
    shown = '' if every == 1 else f', one of {every} points shown'
    few = float(np.clip(1 - np.log10(max(len(across), 1)) / np.log10(_MOST_POINTS), 0, 1))
    axes.scatter(across, up, s=12 + 36 * few, alpha=0.3 + 0.5 * few, color=TRUE, lw=0)
    axes.set_title(f'{caption}{shown}', fontsize=10)
    plain(axes)


def segment(one: Segment) -> bytes:
    """Inferred and true rewards, and attention weights, over the steps of a segment."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        steps = one.first + np.arange(len(one.labels))
        score = 'score not known' if one.value is None else f'score {exact(one.value, 4)}'
        predicted = '' if one.predicted is None else f', predicted {exact(one.predicted, 4)}'
        axes.set_title(f'{one.source}, episode {one.episode}: {score}{predicted}', fontsize=9)
        axes.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        axes.set_xlabel('step of the episode', fontsize=8)
        axes.set_ylabel('step reward', fontsize=8)
        plain(axes)
        if one.weights is not None:
            behind = axes.twinx()
            behind.bar(steps, one.weights, width=0.9, color='#cccccc', label='attention weight w')
            behind.set_ylim(0, 1.05 * max(1.0, float(one.weights.max())))
            behind.set_ylabel('attention weight w', fontsize=8)
            axes.set_zorder(behind.get_zorder() + 1)
            axes.patch.set_visible(False)
        dots = 3.5 if len(steps) <= 100 else 0
        axes.plot(steps, one.labels, 'o-', markersize=dots, color=INFERRED, label='inferred')
        if one.deviations is not None:
            low, high = one.labels - one.deviations, one.labels + one.deviations
            name = 'one standard deviation'
            axes.fill_between(steps, low, high, color=INFERRED, alpha=0.2, lw=0, label=name)
        if one.true is not None:
            axes.plot(steps, one.true, 'o-', markersize=dots, color=TRUE, label='true')
        for each in figure.axes:
            each.tick_params(labelsize=8)
        axes.legend(loc='best', fontsize=8, framealpha=0.6)

    return png((4.2, 2.4), draw)


def curves(
    panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]],
    along: str = 'environment steps',
    end: float | None = None,
    correlations: bool = False,
) -> bytes:
    """Curves over training, a panel for each quantity.

    Args:
        panels: by the name of the quantity, the points (x, y) of each curve by its label. A loss
            whose values are far apart has a logarithmic axis.
        along: name of x.
        end: where x ends; None: at the last point.
        correlations: the values are such, and 0 and 1 are shown.
    """

    def draw(figure: Figure) -> None:
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (name, lines) in zip(grid, panels.items(), strict=True):
            axes.set_ylabel(name, fontsize=9)
            for (label, points), colour in zip(
                lines.items(), (TRUE, INFERRED, GREY), strict=False
            ):
                line(axes, points, label, colour)
            if correlations:
                low, high = axes.get_ylim()
                axes.set_ylim(min(low, 0.0), max(high, 1.02))
            elif 'loss' in name and _far_apart([y for ps in lines.values() for _, y in ps]):
                axes.set_yscale('log')
            plain(axes)
            axes.tick_params(labelsize=9)
            if len(lines) > 1:
                axes.legend(fontsize=8, framealpha=0.7)
        grid[-1].set_xlabel(along)
        grid[-1].set_xlim(0, end)

    return png((WIDE, 1.1 + 1.3 * len(panels)), draw)


def _far_apart(values: Sequence[float]) -> bool:
    """Whether only a logarithmic axis shows all of these."""
    return bool(values) and min(values) > 0 and max(values) > 30 * min(values)
