"""How methods stand to each other on a task: returns, scores, credit and cost in one row each.

Each task, composite reward and delay is a row of its own here; nothing is averaged over them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean, median
from typing import Literal

from codetr_ros.benchmark.anchors import Anchors
from codetr_ros.benchmark.results import Result
from codetr_ros.benchmark.statistics import (
    holm,
    interquartile_interval,
    interquartile_mean,
    paired_p,
)
from codetr_ros.benchmark.table import methods

REACHED = 0.8
"""The return whose price is asked for: so much of the way from the better trivial policy to the
oracle."""
REFERENCES = ('uniform', 'true')
"""What every method is tested against: the even spread (does credit pay?) and the oracle."""

Measure = Literal['true_return', 'score']
MEASURES: tuple[Measure, ...] = ('true_return', 'score')
Place = tuple[str, str, int | str]
"""Task, composite reward and delay."""


@dataclass(frozen=True, kw_only=True)
class Middle:
    """The interquartile mean of the seeds, and its 95 % bootstrap interval."""

    iqm: float
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A method against a reference, over the seeds that both have.

    Attributes:
        mean: of the method's number less the reference's.
        pairs: number of seeds.
        p: of a paired t-test; None with fewer than two pairs.
        corrected: that p by Holm, for all tests of the report with this reference and measure.
    """

    mean: float
    pairs: int
    p: float | None
    corrected: float | None = None


@dataclass(frozen=True, kw_only=True)
class Standing:
    """A method on a task, composite reward and delay.

    Attributes:
        place, method: what it is of.
        seeds, planned: number of finished cells, and of planned ones.
        returns, scores: of the last evaluation.
        share: how much of the way from the better trivial policy to the oracle its return has
            come; None without an oracle that is better than that policy.
        within: credit inside segments at the end, mean of the seeds; None where there is none.
        cpu_s: processor time of a run until its last evaluation, median of the seeds [s].
        reached: number of seeds with an evaluation at `REACHED` of the way; None as for `share`.
        cpu_s_to: processor time until the first such evaluation, median of the seeds that came to
            one; None if half of them or more did not.
        against: differences by reference and measure.
    """

    place: Place
    method: str
    seeds: int
    planned: int
    returns: Middle | None
    scores: Middle | None
    share: float | None = None
    within: float | None = None
    cpu_s: float | None = None
    reached: int | None = None
    cpu_s_to: float | None = None
    against: Mapping[tuple[str, Measure], Difference] = field(default_factory=dict)


def standings(results: Sequence[Result], anchors: Anchors) -> list[Standing]:
    """Every method of every place; within a place the best return first.

    Args:
        results: of all cells.
        anchors: numbers of the trivial policies.
    """
    places: dict[Place, dict[str, list[Result]]] = {}
    for method in methods(results):
        for r in results:
            if r.method == method:
                place = (r.task, r.composite, r.delay)
                places.setdefault(place, {}).setdefault(method, []).append(r)
    differences = _corrected(
        {
            (place, method, reference, measure): made
            for place, by_method in places.items()
            for method, cells in by_method.items()
            for reference in REFERENCES
            for measure in MEASURES
            if (made := _difference(cells, by_method.get(reference, []), measure)) is not None
        }
    )
    found = []
    for place, by_method in places.items():
        trivial = max(row['true_return_mean'] for row in anchors[place].values())
        oracle = _middle(by_method.get('true', []), 'true_return')
        way = oracle.iqm - trivial if oracle and oracle.iqm > trivial else None
        rows = [
            _standing(
                place,
                method,
                cells,
                trivial,
                way,
                {
                    (reference, measure): made
                    for (p, m, reference, measure), made in differences.items()
                    if (p, m) == (place, method)
                },
            )
            for method, cells in by_method.items()
        ]
        found += sorted(rows, key=lambda r: -r.returns.iqm if r.returns else float('inf'))
    return found


def _numbers(cells: Sequence[Result], measure: Measure) -> dict[int, float]:
    values = {r.seed: r.true_return if measure == 'true_return' else r.score for r in cells}
    return {seed: float(value) for seed, value in values.items() if value is not None}


def _middle(cells: Sequence[Result], measure: Measure) -> Middle | None:
    values = list(_numbers(cells, measure).values())
    if not values:
        return None
    low, high = interquartile_interval([values])
    return Middle(iqm=interquartile_mean(values), low=low, high=high)


def _difference(
    cells: Sequence[Result], reference: Sequence[Result], measure: Measure
) -> Difference | None:
    """None for the reference itself, and without a seed that both have."""
    mine, theirs = _numbers(cells, measure), _numbers(reference, measure)
    seeds = sorted(mine.keys() & theirs.keys())
    if not seeds or cells[0].method == reference[0].method:
        return None
    a, b = [mine[seed] for seed in seeds], [theirs[seed] for seed in seeds]
    return Difference(mean=fmean(a) - fmean(b), pairs=len(seeds), p=paired_p(a, b))


_Test = tuple[Place, str, str, Measure]


def _corrected(tests: Mapping[_Test, Difference]) -> dict[_Test, Difference]:
    """The tests with the correction of those that share their reference and measure."""
    made = dict(tests)
    for reference in REFERENCES:
        for measure in MEASURES:
            family = [
                (key, test.p)
                for key, test in tests.items()
                if key[2:] == (reference, measure) and test.p is not None
            ]
            for (key, _), p in zip(family, holm([p for _, p in family]), strict=True):
                test = tests[key]
                made[key] = Difference(mean=test.mean, pairs=test.pairs, p=test.p, corrected=p)
    return made


def _standing(
    place: Place,
    method: str,
    cells: Sequence[Result],
    trivial: float,
    way: float | None,
    against: Mapping[tuple[str, Measure], Difference],
) -> Standing:
    done = [r for r in cells if r.summary is not None]
    returns = _middle(cells, 'true_return')
    credit = [r.reward_recovery[-1].within for r in done if r.reward_recovery]
    within = [value for value in credit if value is not None]
    spent = [r.summary.spent[-1].cpu_s for r in done if r.summary and r.summary.spent]
    prices = [_price(r, trivial + REACHED * way) for r in done] if way else []
    paid = [seconds for there, seconds in prices if there and seconds is not None]
    reached = sum(there for there, _ in prices)
    return Standing(
        place=place,
        method=method,
        seeds=len(done),
        planned=len(cells),
        returns=returns,
        scores=_middle(cells, 'score'),
        share=(returns.iqm - trivial) / way if returns and way else None,
        within=fmean(within) if within else None,
        cpu_s=median(spent) if spent else None,
        reached=reached if way else None,
        cpu_s_to=median(paid) if paid and 2 * reached > len(done) else None,
        against=against,
    )


def _price(result: Result, target: float) -> tuple[bool, float | None]:
    """Whether an evaluation came to a return, and the processor time until then, if known."""
    for row in result.evaluations:
        if row.true_return_mean is not None and row.true_return_mean >= target:
            spent = result.summary.spent if result.summary else []
            return True, next((one.cpu_s for one in spent if one.step == row.step), None)
    return False, None
