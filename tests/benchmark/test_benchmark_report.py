import csv
import itertools
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from codetr_ros import cli, config
from codetr_ros.benchmark import anchors, curves, report, results, sections, statistics, table
from codetr_ros.benchmark.spec import BenchmarkError, Cell
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.records import EpisodeResult, Policy
from codetr_ros.runs.document import Heading, Table
from helpers.benchmark_folders import benchmark

SCORES = {
    'codetr': [[0.50, 0.70, 0.60], [0.40, 0.60, 0.20]],  # a row for each delay, 25 and 50
    'uniform': [[0.48, 0.73, 0.52], [0.41, 0.55, 0.26]],  # now above, now below
    'none': [[0.11, 0.29, 0.24], [0.05, 0.17, -0.21]],  # always about 0.4 below
}


def by_hand(cell: Cell) -> float:
    settings = cell.settings
    return SCORES[settings.method][(25, 50).index(settings.delay)][settings.seed]


def entries(row: table.Row) -> dict[str, table.Entry]:
    return {entry.method: entry for entry in row.entries}


def paired_p_by_hand(a: list[float], b: list[float]) -> float:
    d = np.subtract(a, b)
    t = d.mean() / (d.std(ddof=1) / math.sqrt(len(d)))
    return float(2 * stats.t.sf(abs(t), len(d) - 1))


@pytest.fixture
def made(tmp_path: Path) -> list[results.Result]:
    folder = benchmark(tmp_path / 'b', by_hand, methods=list(SCORES), delays=[25, 50])
    return results.read([folder.path])


def test_a_cell_is_the_mean_over_delays_and_seeds_with_the_spread_of_the_seeds_means(
    made: list[results.Result],
) -> None:
    together, alone = table.rows(made)
    (row,) = together
    codetr = entries(row)['codetr']

    assert row.delays == (25, 50)
    assert codetr.mean == pytest.approx((0.5 + 0.7 + 0.6 + 0.4 + 0.6 + 0.2) / 6)
    assert codetr.spread == pytest.approx(np.std([0.45, 0.65, 0.40], ddof=1))
    assert codetr.return_mean == pytest.approx(500)
    assert [row.delays for row in alone] == [(25,), (50,)]
    assert entries(alone[1])['none'].mean == pytest.approx(0.01 / 3)


def test_bold_is_the_best_and_what_a_paired_t_test_does_not_tell_from_it(
    made: list[results.Result],
) -> None:
    found = entries(table.rows(made)[0][0])
    flat = {method: [*scores[0], *scores[1]] for method, scores in SCORES.items()}

    assert found['codetr'].best
    for method in ('uniform', 'none'):
        assert found[method].pairs == 6
        expected = paired_p_by_hand(flat['codetr'], flat[method])
        assert found[method].p == pytest.approx(expected)
    assert found['uniform'].p > 0.05 > found['none'].p
    assert [m for m, entry in found.items() if entry.bold] == ['codetr', 'uniform']
    assert stats.ttest_ind(flat['codetr'], flat['none']).pvalue > found['none'].p, 'pairs matter'


def test_with_fewer_than_two_pairs_only_the_best_is_bold(tmp_path: Path) -> None:
    folder = benchmark(
        tmp_path / 'b', lambda cell: 0.5 + (cell.settings.method == 'none') / 1000, seeds=[0]
    )
    found = entries(table.rows(results.read([folder.path]))[0][0])

    assert found['none'].bold
    assert found['none'].spread is None
    assert (found['codetr'].bold, found['codetr'].p, found['codetr'].pairs) == (False, None, 1)


def test_differences_that_do_not_vary_leave_no_doubt() -> None:
    assert statistics.paired_p([1.0, 2.0], [1.0, 2.0]) == 1
    assert statistics.paired_p([1.0, 2.0], [0.5, 1.5]) == 0
    assert statistics.paired_p([1.0], [0.0]) is None


def test_the_oracle_is_shown_but_neither_best_nor_compared(tmp_path: Path) -> None:
    folder = benchmark(
        tmp_path / 'b',
        lambda cell: 0.9 if cell.settings.method == 'true' else 0.1 + cell.settings.seed / 100,
        methods=['true', 'none'],
    )
    found = entries(table.rows(results.read([folder.path]))[0][0])

    assert found['true'].mean == pytest.approx(0.9)
    assert not found['true'].bold
    assert found['none'].best


def test_delays_outside_25_to_200_count_in_the_own_table_and_not_beside_the_paper(
    tmp_path: Path,
) -> None:
    folder = benchmark(
        tmp_path / 'b', lambda cell: cell.settings.delay / 1000, delays=[5, 25, 200, 500]
    )
    found = results.read([folder.path])
    together, alone = table.rows(found, table.TABLE_DELAYS)

    assert [row.delays for row in together] == [(25, 200)]
    assert entries(together[0])['none'].mean == pytest.approx(0.1125)
    assert [row.delays for row in alone] == [(5,), (25,), (200,), (500,)]

    together, _ = table.rows(found)
    assert [row.delays for row in together] == [(5, 25, 200, 500)], 'the own table has all'
    assert entries(together[0])['none'].mean == pytest.approx((5 + 25 + 200 + 500) / 4000)


def test_drawn_lengths_and_whole_episodes_have_rows_of_their_own_after_shorter_ones(
    tmp_path: Path,
) -> None:
    folder = benchmark(tmp_path / 'b', lambda cell: 0.5, delays=['episode', 50, '10:50', 25])
    together, alone = table.rows(results.read([folder.path]))

    assert [row.delays for row in together] == [(25, 50)]
    assert [row.delays for row in alone] == [(25,), ('10:50',), (50,), ('episode',)]


def test_rows_of_the_interquartile_means_state_their_delays(tmp_path: Path) -> None:
    made = benchmark(tmp_path / 'b', lambda cell: 0.5, delays=['episode', '10:50'])
    folder, _ = report.write([made.path])

    section = (folder / 'table.md').read_text().partition('Interquartile means')[2]
    lines = section.partition('\n#')[0].splitlines()
    rows = [line for line in lines if line.startswith('|')][2:]
    assert len(set(rows)) == len(rows) > 2
    assert {row.split('|')[3].strip() for row in rows if '0.5000' in row} >= {'episode', '10:50'}


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    values = [9.0, -100.0, 1.0, 2.0, 3.0, 4.0, 1000.0, 5.0]

    assert statistics.interquartile_mean(values) == pytest.approx((2 + 3 + 4 + 5) / 4)
    assert statistics.interquartile_mean(values[:7]) == stats.trim_mean(values[:7], 0.25)


def test_the_bootstrap_draws_within_strata() -> None:
    """Two strata that do not vary in themselves: nothing varies, however far apart they are."""
    assert statistics.interquartile_interval([[1.0] * 3, [5.0] * 3]) == (3.0, 3.0)
    low, high = statistics.interquartile_interval([[1.0, 5.0] * 3])
    assert (low, high) == (1.0, 5.0)


def test_the_interval_is_that_of_all_possible_draws() -> None:
    """Five seeds: all 3125 draws can be listed, and one value is cut off at each end."""
    values = [0.1, 0.2, 0.6, 0.9, 1.5]
    means = [sum(sorted(draw)[1:4]) / 3 for draw in itertools.product(values, repeat=5)]

    interval = statistics.interquartile_interval([values])

    assert interval == pytest.approx(np.percentile(means, [2.5, 97.5]), abs=0.04)


def test_failed_and_missing_cells_are_listed_with_their_errors_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def score(cell: Cell) -> float | str | None:
        if cell.settings.seed == 1 and cell.settings.method == 'codetr':
            return 'labels are not <finite> after 3 gradient steps'
        if cell.settings.seed == 2 and cell.settings.method == 'none':
            return None
        return 0.25

    folder = benchmark(tmp_path / 'b', score)

    assert cli.main(['benchmark', 'report', str(folder.path)]) == 0

    shown = capsys.readouterr().out
    assert '0.2500 (0.0000) [2 of 3, 1 failed]*' in shown
    assert re.search(r'\[2 of 3\]  ', shown)
    text = (folder.path / 'report' / 'table.md').read_text()
    assert '**0.2500 (0.0000) [2 of 3, 1 failed]**' in text
    assert '6 cells: 4 finished, 1 failed, 1 missing' in text
    after = text.split('## Failed and missing cells')[1]
    assert 'Failed: labels are not <finite> after 3 gradient steps' in after
    assert '- InvertedPendulum-v5_sum_25_none_seed2' in after
    page = (folder.path / 'report' / 'index.html').read_text()
    assert 'labels are not &lt;finite&gt; after 3' in page
    with (folder.path / 'report' / 'cells.csv').open() as file:
        states = {row['cell'][-12:]: row['state'] for row in csv.DictReader(file)}
    assert states['codetr_seed1'] == 'failed'
    assert sorted(states.values()).count('finished') == 4


def test_the_page_names_its_pictures_and_the_csv_holds_the_tables_numbers(tmp_path: Path) -> None:
    folder = benchmark(tmp_path / 'b', by_hand, methods=list(SCORES), delays=[25, 50])

    out, _ = report.write([folder.path])

    page = (out / 'index.html').read_text()
    named = set(re.findall(r'src="([^"]+)"', page))
    made = {path.name for path in out.glob('*.png')}
    assert named == made
    assert 'recovery_InvertedPendulum-v5_sum_25.png' in made
    assert all(path.read_bytes()[:4] == b'\x89PNG' for path in out.glob('*.png'))
    with (out / 'table.csv').open() as file:
        first = next(csv.DictReader(file))
    assert (first['delays'], first['method'], first['bold']) == ('25 50', 'codetr', '1')
    assert float(first['score_mean']) == pytest.approx(0.5)
    assert float(first['score_iqm']) == pytest.approx(
        stats.trim_mean([0.5, 0.7, 0.6, 0.4, 0.6, 0.2], 0.25)
    )


def test_a_curve_has_the_mean_and_the_range_of_the_seeds(made: list[results.Result]) -> None:
    some = [r for r in made if r.method == 'codetr' and r.delay == 25]

    steps, means, low, high = curves.curve(some, 'evaluations', 'score_mean')

    assert steps == [1000, 2000, 3000]
    assert (means[-1], low[-1], high[-1]) == pytest.approx((0.6, 0.5, 0.7))
    assert curves.curve(some, 'reward_recovery', 'spearman')[0] == [], 'None is no number'


@pytest.mark.parametrize('delay', [7, '2:9', 'episode'])
def test_anchors_score_as_an_evaluation_does_and_are_simulated_once(
    delay: int | str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = benchmark(tmp_path / 'b', lambda cell: None, composites=['max'], delays=[delay])
    found = results.read([folder.path])
    file = tmp_path / 'anchors.json'

    said = anchors.anchors(found, file)['InvertedPendulum-v5', 'max', delay]

    random = evaluated(config.load(str(folder.settings(found[0].cell))))
    assert said['random']['score_mean'] == pytest.approx(np.mean([r.score for r in random]))
    assert said['random']['true_return_mean'] == np.mean([r.true_return for r in random])
    monkeypatch.setattr(anchors, 'simulate', lambda *_: pytest.fail('simulated again'))
    assert anchors.anchors(found, file)['InvertedPendulum-v5', 'max', delay] == said


def evaluated(settings: config.Settings) -> list[EpisodeResult]:
    """The random policy's evaluation, as a run has it."""
    evaluator = Evaluator(settings.run_spec('run'), settings, 'evaluate')
    none = np.zeros(1, np.uint32)
    evaluator.receive(
        Policy(
            run_id='run',
            phase=0,
            version=-1,
            sources=('sim',),
            steps=none,
            random=True,
            network='',
            weights=b'',
        )
    )
    found: list[EpisodeResult] = []
    for records in evaluator.work():
        if records is None:
            break
        found += [record for record in records if isinstance(record, EpisodeResult)]
    evaluator.close()
    return found


def test_standing_still_on_ant_earns_a_sixth_of_r_max(tmp_path: Path) -> None:
    rewards = anchors.simulate('Ant-v4', 1)['zero'][0]

    assert len(rewards) == 1000
    assert rewards.sum() == pytest.approx(1001, abs=5)


def test_the_papers_numbers_stand_beside_those_of_its_task_only(tmp_path: Path) -> None:
    for task, beside in (('Ant-v4', True), ('InvertedPendulum-v5', False)):
        changes: dict[str, Any] = {'tasks': [task], 'config': {'evaluate_episodes': 1}}
        folder = benchmark(tmp_path / task, lambda cell: 0.25, **changes)
        _, said = report.write([folder.path])
        text = (folder.path / 'report' / 'table.md').read_text()
        for shown in (said, text):
            assert ('0.5493 (0.0187)' in shown) == beside
            assert ("paper's Table 2" in shown) == beside
        assert ('Here it is, by task: Ant-v4 6.' in text) == beside
        assert text.index('## Scores') < text.find("paper's Table 2") or not beside
    assert 'r_max, the unit of scores: InvertedPendulum-v5 1.' in text


def test_the_settings_that_differ_from_the_nearest_preset_are_named(tmp_path: Path) -> None:
    for base in config.PRESETS:
        folder = benchmark(
            tmp_path / base,
            lambda cell: 0.5,
            delays=[5, 50],
            steps=config.load(base).steps,
            config={'base': base, 'sac.batch': 7, 'sac.tau': 1e-6},
        )
        blocks = sections.settings(results.read([folder.path]))
        assert isinstance(blocks[0], Heading) and f'the preset {base}, ' in blocks[0].text
        assert isinstance(blocks[1], Table)
        batch = str(config.load(base).sac.batch)
        assert blocks[1].rows == [
            ['sac.batch', batch, '7', 'InvertedPendulum-v5'],
            ['sac.tau', '0.005', '0.000001', 'InvertedPendulum-v5'],
        ]


@pytest.mark.parametrize('delays', [[10], [10, 500]])
def test_the_terminal_shows_the_numbers_whatever_the_delays(
    delays: list[int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = benchmark(
        tmp_path / 'b', lambda cell: cell.settings.delay / 1000, methods=['none'], delays=delays
    )

    assert cli.main(['benchmark', 'report', str(folder.path)]) == 0

    shown = capsys.readouterr().out
    scores, returns = shown.split('\nTrue returns\n')
    for delay in delays:
        assert re.search(rf'^sum +{delay} +{delay / 1000:.4f} \(0\.0000\)\*', scores, re.M)
        assert re.search(rf'^sum +{delay} +{delay:.1f} \(0\.0\)$', returns, re.M)
    assert ('mean of 10, 500' in scores) == (len(delays) > 1)
    assert '|' not in shown


def test_the_curves_begin_with_the_random_policy_at_step_0(made: list[results.Result]) -> None:
    some = [r for r in made if r.method == 'codetr' and r.delay == 25]
    random = some[0].evaluations[0].model_copy(update={'step': 0, 'score_mean': 0.125})
    begun = [replace(r, summary=r.summary.model_copy(update={'random': random})) for r in some]

    steps, means, _, _ = curves.curve(begun, 'evaluations', 'score_mean')

    assert (steps, means[0]) == ([0, 1000, 2000, 3000], 0.125)


def test_several_benchmarks_are_reported_together_unless_they_contradict_each_other(
    tmp_path: Path,
) -> None:
    one = benchmark(tmp_path / 'one', lambda cell: 0.1, methods=['none'])
    two = benchmark(tmp_path / 'two', lambda cell: 0.2, methods=['uniform'])
    changed = {'evaluate_every': 1000, 'evaluate_episodes': 2, 'sac': {'batch': 9}}
    three = benchmark(tmp_path / 'three', lambda cell: 0.2, methods=['true'], config=changed)

    longer = benchmark(tmp_path / 'longer', lambda cell: 0.9, delays=[50], steps=6000)

    found = results.read([one.path, two.path])
    assert table.methods(found) == ['none', 'uniform']
    with pytest.raises(BenchmarkError, match='has sac = .*what is compared must be alike'):
        results.read([one.path, three.path])
    with pytest.raises(BenchmarkError, match='has steps = 6000, but'):  # a mean over delays
        results.read([one.path, longer.path])
    with pytest.raises(BenchmarkError, match='cell .*_none_seed0 is in .*one and in .*one'):
        results.read([one.path, one.path])


def test_a_folder_without_a_benchmark_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(['benchmark', 'report', str(tmp_path)]) == 2
    assert 'is not the folder of a benchmark, it has no benchmark.json' in capsys.readouterr().err
    (tmp_path / 'benchmark.json').write_text(json.dumps({'format': 0}))
    assert cli.main(['benchmark', 'report', str(tmp_path)]) == 2
    assert 'is damaged or of another version' in capsys.readouterr().err
