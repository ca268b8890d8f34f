"""How methods stand to each other: shares of the way, prices and corrected tests."""

import csv
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from codetr_ros.benchmark import report, results, standing_rows, statistics
from codetr_ros.benchmark.spec import Cell
from codetr_ros.benchmark.standings import Standing, standings
from helpers.benchmark_folders import benchmark

PLACE = ('InvertedPendulum-v5', 'sum', 25)
ANCHORS = {PLACE: {'random': {'true_return_mean': -400.0}, 'zero': {'true_return_mean': 100.0}}}
SCORES = {
    'true': [0.90, 1.00, 1.10, 1.00, 1.30],
    'codetr': [0.70, 0.82, 0.97, 0.90, 0.60],
    'uniform': [0.50, 0.73, 0.52, 0.61, 0.44],
    'none': [0.05, -0.21, 0.11, 0.08, 0.70],
}
"""The true returns are a thousand times these."""


def by_hand(cell: Cell) -> float:
    return SCORES[cell.settings.method][cell.settings.seed]


def by_method(rows: list[Standing]) -> dict[str, Standing]:
    return {row.method: row for row in rows}


@pytest.fixture
def found(tmp_path: Path) -> dict[str, Standing]:
    folder = benchmark(tmp_path / 'b', by_hand, methods=list(SCORES), seeds=[0, 1, 2, 3, 4])
    return by_method(standings(results.read([folder.path]), ANCHORS))


def closed_testing(p: list[float]) -> list[float]:
    """The definition that Holm's procedure is a shortcut of: a hypothesis is rejected if every
    set of hypotheses that it belongs to is, each by Bonferroni.
    """
    sets = [s for n in range(1, len(p) + 1) for s in itertools.combinations(range(len(p)), n)]
    return [
        max(min(1.0, len(s) * min(p[j] for j in s)) for s in sets if i in s) for i in range(len(p))
    ]


def test_the_correction_is_that_of_testing_every_set_of_hypotheses() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        p = (rng.random(rng.integers(1, 7)) ** rng.integers(1, 6)).tolist()
        p += p[:1]  # two alike
        assert statistics.holm(p) == pytest.approx(closed_testing(p))
    assert statistics.holm([]) == []
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_returns_are_interquartile_means_and_the_best_stands_first(
    found: dict[str, Standing],
) -> None:
    assert list(found) == ['true', 'codetr', 'uniform', 'none']
    for method, row in found.items():
        middle = stats.trim_mean(SCORES[method], 0.25)
        assert row.scores and row.returns
        assert row.scores.iqm == pytest.approx(middle)
        assert row.returns.iqm == pytest.approx(1000 * middle)
        assert row.returns.low < row.returns.iqm < row.returns.high


def test_the_way_leads_from_the_better_trivial_policy_to_the_oracle(
    found: dict[str, Standing],
) -> None:
    oracle, mine = (stats.trim_mean(SCORES[name], 0.25) for name in ('true', 'codetr'))
    assert found['true'].share == pytest.approx(1)
    assert found['codetr'].share == pytest.approx((1000 * mine - 100) / (1000 * oracle - 100))
    assert found['none'].share and found['none'].share < 0, 'worse than standing still'


def test_without_an_oracle_there_is_no_way_and_no_price(tmp_path: Path) -> None:
    for name, methods, oracle in (('a', ['codetr', 'uniform'], 1.0), ('b', list(SCORES), 0.05)):
        folder = benchmark(
            tmp_path / name,
            lambda cell, of=oracle: of if cell.settings.method == 'true' else by_hand(cell),
            methods=methods,
        )
        row = by_method(standings(results.read([folder.path]), ANCHORS))['codetr']
        assert (row.share, row.reached, row.cpu_s_to) == (None, None, None)
        assert row.cpu_s == 30


def test_the_price_is_that_of_the_first_evaluation_that_came_there(tmp_path: Path) -> None:
    """Returns of evaluations are score * step / 3: the oracle ends at 1000, where 80 % of the way
    from 100 on is 820.
    """
    scores = {'true': [1.0] * 3, 'codetr': [1.25, 2.5, 0.8], 'uniform': [0.9, 0.5, 0.4]}
    folder = benchmark(
        tmp_path / 'b', lambda c: scores[c.settings.method][c.settings.seed], methods=list(scores)
    )
    found = by_method(standings(results.read([folder.path]), ANCHORS))

    assert (found['true'].reached, found['true'].cpu_s_to) == (3, 30)
    assert (found['codetr'].reached, found['codetr'].cpu_s_to) == (2, 15), 'after 20 s and 10 s'
    assert (found['uniform'].reached, found['uniform'].cpu_s_to) == (1, None), 'one of three'


def test_tests_are_paired_by_seed_and_corrected_with_all_of_their_report(tmp_path: Path) -> None:
    folder = benchmark(
        tmp_path / 'b',
        lambda cell: by_hand(cell) * (1 if cell.settings.composite == 'sum' else 0.9),
        methods=list(SCORES),
        composites=['sum', 'max'],
        seeds=[0, 1, 2, 3, 4],
    )
    anchors = ANCHORS | {('InvertedPendulum-v5', 'max', 25): ANCHORS[PLACE]}
    rows = standings(results.read([folder.path]), anchors)

    for measure, factor in (('true_return', 1000), ('score', 1)):
        tests = [row.against['uniform', measure] for row in rows if row.method != 'uniform']
        expected = [
            stats.ttest_rel(SCORES[row.method], SCORES['uniform']).pvalue
            for row in rows
            if row.method != 'uniform'
        ]
        assert [test.p for test in tests] == pytest.approx(expected)
        assert [test.corrected for test in tests] == pytest.approx(closed_testing(expected))
        difference = np.mean(SCORES['codetr']) - np.mean(SCORES['uniform'])
        mine = by_method(rows[:4])['codetr'].against['uniform', measure]
        assert mine.mean == pytest.approx(factor * difference)
        assert mine.pairs == 5
    assert ('uniform', 'score') not in by_method(rows[:4])['uniform'].against
    assert by_method(rows[:4])['codetr'].against['true', 'score'].mean < 0


def test_seeds_that_one_of_two_lacks_are_no_pairs(tmp_path: Path) -> None:
    folder = benchmark(
        tmp_path / 'b',
        lambda c: None if (c.settings.method, c.settings.seed) == ('codetr', 1) else by_hand(c),
        methods=['codetr', 'uniform'],
    )
    row = by_method(standings(results.read([folder.path]), ANCHORS))['codetr']

    assert (row.seeds, row.planned) == (2, 3)
    expected = stats.ttest_rel([0.70, 0.97], [0.50, 0.52])
    assert row.against['uniform', 'score'].pairs == 2
    assert row.against['uniform', 'score'].p == pytest.approx(expected.pvalue)


def test_the_report_shows_them_and_its_files_hold_every_number(tmp_path: Path) -> None:
    folder = benchmark(
        tmp_path / 'b',
        lambda c: None if (c.settings.method, c.settings.seed) == ('none', 2) else by_hand(c),
        methods=list(SCORES),
    )
    out, _ = report.write([folder.path])

    text = (out / 'table.md').read_text().partition('## Standings')[2].partition('\n## ')[0]
    assert '### InvertedPendulum-v5: sum of 25' in text
    assert '| none | 2 of 3 |' in text
    assert 'less `uniform`' in text
    assert 'less `true`' in text
    with (out / 'standings.csv').open() as file:
        rows = {row['method']: row for row in csv.DictReader(file)}
    assert float(rows['codetr']['within']) == pytest.approx(np.mean(SCORES['codetr'][:3]) / 2)
    p = stats.ttest_rel(SCORES['codetr'][:3], SCORES['uniform'][:3]).pvalue
    assert float(rows['codetr']['score_from_uniform_p']) == pytest.approx(p)
    assert rows['uniform']['score_from_uniform_p'] == ''
    with (out / 'evaluations.csv').open() as file:
        evaluations = list(csv.DictReader(file))
    assert len(evaluations) == 11 * 3
    assert [float(row['cpu_s']) for row in evaluations[:3]] == [10, 20, 30]
    assert [float(row['true_return']) for row in evaluations[:3]] == pytest.approx([300, 600, 900])


def test_a_p_value_is_short() -> None:
    assert [standing_rows.p_value(p) for p in (None, 0.0, 0.00099, 0.0456, 1.0)] == [
        '–',
        '< 0.001',
        '< 0.001',
        '0.046',
        '1.000',
    ]
