"""The numbers of the table: means, spreads, the best method and those comparable with it."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from codetr_ros.benchmark.results import Result
from codetr_ros.benchmark.statistics import (
    SIGNIFICANCE,
    interquartile_interval,
    interquartile_mean,
    paired_p,
    spread,
)
from codetr_ros.config import Lengths
from codetr_ros.config.delays import LONGEST

TABLE_DELAYS = (25, 200)
"""A cell of Table 2 is the mean over delays from 25 to 200. The supplement says "utilizing various
delayed steps ranging from 25 to 200"; that one number averages over them is inferred."""
ORACLES = ('true',)
"""Methods that see rewards hidden from all others: shown, but never best, nor compared."""

Pair = tuple[int, int | str]  # seed, delay


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A method in a row.

    Attributes:
        method: its name.
        scores, returns: of each finished cell, by seed and delay.
        planned, failed: number of planned cells, and of those that failed.
        mean, spread: of the scores; the spread is the sample standard deviation, over seeds, of
            the mean over delays. None without values, or, for the spread, with fewer than two.
        return_mean, return_spread: the same of the true returns.
        iqm, interval: interquartile mean of the scores and its 95 % bootstrap interval.
        best: whether its mean is the highest, oracles left out.
        p: of a paired t-test against the best over the pairs (seed, delay) that both have; None
            if it is the best or an oracle, or with fewer than two pairs.
        pairs: number of these pairs.
    """

    method: str
    scores: dict[Pair, float]
    returns: dict[Pair, float]
    planned: int
    failed: int
    mean: float | None
    spread: float | None
    return_mean: float | None
    return_spread: float | None
    iqm: float | None
    interval: tuple[float, float] | None
    best: bool = False
    p: float | None = None
    pairs: int = 0

    @property
    def bold(self) -> bool:
        """Best, or statistically comparable with the best at the 5 % level."""
        return self.best or (self.p is not None and self.p >= SIGNIFICANCE)


@dataclass(frozen=True)
class Row:
    """A row of the table: all methods on one task and composite reward, over some delays."""

    task: str
    composite: str
    delays: tuple[int | str, ...]
    entries: tuple[Entry, ...]


def methods(results: Sequence[Result]) -> list[str]:
    """Every method, in the order of the specs."""
    return list(dict.fromkeys(result.method for result in results))


def rows(
    results: Sequence[Result], span: tuple[int, int] | None = None
) -> tuple[list[Row], list[Row]]:
    """The rows over several delays, and those of each delay alone.

    Args:
        results: of all cells.
        span: the least and the greatest delay of the rows over several; None: all delays. A task
            and composite reward without a delay in it has no such row. Lengths that are drawn and
            whole episodes have rows of their own only.
    """
    groups: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for result in results:
        groups[result.task, result.composite].append(result)
    together, alone = [], []
    for (task, composite), group in groups.items():
        delays = sorted({result.delay for result in group}, key=_longest)
        numbers = (delay for delay in delays if isinstance(delay, int))
        if within := tuple(d for d in numbers if span is None or span[0] <= d <= span[1]):
            together.append(_row(task, composite, within, group))
        alone += [_row(task, composite, (delay,), group) for delay in delays]
    return together, alone


def _longest(delay: int | str) -> tuple[int, int]:
    """The place of a delay in a table: by its longest segments, whole episodes last."""
    lengths = Lengths.of(delay)
    return lengths.most or LONGEST + 1, lengths.least


def _row(task: str, composite: str, delays: tuple[int | str, ...], group: Sequence[Result]) -> Row:
    inside = [result for result in group if result.delay in delays]
    entries = [
        _entry(method, [result for result in inside if result.method == method])
        for method in methods(inside)
    ]
    return Row(task, composite, delays, compare(entries))


def _entry(method: str, results: Sequence[Result]) -> Entry:
    def of(name: str) -> dict[Pair, float]:
        values = {(r.seed, r.delay): getattr(r, name) for r in results}
        return {pair: float(value) for pair, value in values.items() if value is not None}

    scores, returns = of('score'), of('true_return')
    strata: dict[int | str, list[float]] = defaultdict(list)
    for (_, delay), score in scores.items():
        strata[delay].append(score)
    values = list(scores.values())
    mean, spread = _mean_and_spread(scores)
    return_mean, return_spread = _mean_and_spread(returns)
    return Entry(
        method=method,
        scores=scores,
        returns=returns,
        planned=len(results),
        failed=sum(result.state == 'failed' for result in results),
        mean=mean,
        spread=spread,
        return_mean=return_mean,
        return_spread=return_spread,
        iqm=interquartile_mean(values) if values else None,
        interval=interquartile_interval(list(strata.values())) if values else None,
    )


def _mean_and_spread(values: dict[Pair, float]) -> tuple[float | None, float | None]:
    if not values:
        return None, None
    seeds: dict[int, list[float]] = defaultdict(list)
    for (seed, _), value in values.items():
        seeds[seed].append(value)
    means = [sum(each) / len(each) for each in seeds.values()]
    return sum(values.values()) / len(values), spread(means)


def compare(entries: Sequence[Entry]) -> tuple[Entry, ...]:
    """The entries with the best marked, and the others tested against it."""
    able = [e for e in entries if e.mean is not None and e.method not in ORACLES]
    if not able:
        return tuple(entries)
    best = max(able, key=lambda entry: entry.mean or 0.0)
    compared = []
    for entry in entries:
        if entry is best:
            compared.append(replace(entry, best=True))
        elif entry not in able:
            compared.append(entry)
        else:
            pairs = [pair for pair in best.scores if pair in entry.scores]
            p = paired_p([best.scores[x] for x in pairs], [entry.scores[x] for x in pairs])
            compared.append(replace(entry, p=p, pairs=len(pairs)))
    return tuple(compared)


@dataclass(frozen=True, kw_only=True)
class Aggregate:
    """The interquartile mean of a method's scores on a task, with its interval.

    Attributes:
        task, method: of the scores.
        composites: of the scores, with the delays of `rows`.
        iqm, interval: interquartile mean and 95 % interval.
        cells: number of scores.
    """

    task: str
    method: str
    composites: tuple[str, ...]
    iqm: float
    interval: tuple[float, float]
    cells: int


def aggregate(together: Sequence[Row]) -> list[Aggregate]:
    """Each method over all composite rewards of a task; strata are composite reward and delay."""
    aggregates = []
    for task in dict.fromkeys(row.task for row in together):
        strata: dict[str, dict[tuple[str, int | str], list[float]]] = defaultdict(
            lambda: defaultdict(list)
        )
        for row in together:
            for entry in row.entries if row.task == task else ():
                for (_, delay), score in entry.scores.items():
                    strata[entry.method][row.composite, delay].append(score)
        for method, of in strata.items():
            values = [score for scores in of.values() for score in scores]
            aggregates.append(
                Aggregate(
                    task=task,
                    method=method,
                    composites=tuple(dict.fromkeys(composite for composite, _ in of)),
                    iqm=interquartile_mean(values),
                    interval=interquartile_interval(list(of.values())),
                    cells=len(values),
                )
            )
    return aggregates
