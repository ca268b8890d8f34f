"""The report of a run for people."""

import re
from pathlib import Path

import numpy as np
import pytest

from codetr_ros import config
from codetr_ros.offline.score_course import ScoreCourse
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import report, summary
from codetr_ros.runs.report_text import recovery_text, scale_text
from codetr_ros.runs.run_summary import GivenScores, RewardRecovery, RunSummary
from codetr_ros.runs.segments import Segment
from codetr_ros.runs.summary import Summary
from helpers.summaries import SETTINGS, a_run, episode, run_summary


def recovered(*rows: tuple[int, float | None, float | None]) -> list[RewardRecovery]:
    """Rows of step, correlation, and correlation within segments."""
    names = 'step', 'pearson', 'within'
    return [
        RewardRecovery(spearman=None, steps=100, **dict(zip(names, row, strict=True)))
        for row in rows
    ]


def written(folder: Path, made: RunSummary, metrics_csv: str = 'step,phase\n') -> str:
    """The page of a run, whose segment is the one below."""
    shown = Segment(
        source='sim',
        episode=3,
        first=25,
        value=1.5,
        labels=np.array([0.1, 0.2], np.float32),
        true=np.array([1.0, 0.0], np.float32),
    )
    summary.write(folder, made, metrics_csv, [shown])
    report.write(folder, made)
    return (folder / run_folder.REPORT).read_text()


def headings(page: str) -> list[str]:
    return re.findall(r'<h[123]>(.*?)</h[123]>', page)


def test_the_report_is_one_file_that_fetches_nothing_from_elsewhere(tmp_path: Path) -> None:
    page = written(tmp_path, run_summary(failure='learner <died>'))

    assert (tmp_path / run_folder.PICTURE).read_bytes().startswith(b'\x89PNG')
    assert 'src="data:image/png;base64,iVBOR' in page
    assert not re.search(r'src="(?!data:)', page)
    assert not re.search(r'https?:|url\(|@import', page)
    assert 'learner &lt;died&gt;' in page


def test_its_links_lead_to_files_of_the_runs_folder(tmp_path: Path) -> None:
    run_folder.write_settings(tmp_path, SETTINGS)
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'bag_0.mcap').touch()
    (tmp_path / 'logs').mkdir()  # of a run in process, without the output of a node

    page = written(tmp_path, run_summary())

    links = re.findall(r'href="([^"]+)"', page)
    assert {'config.yaml', 'bag/', 'summary.json', 'metrics.csv', 'step_rewards.csv'} == set(links)
    assert all((tmp_path / link).exists() for link in links)


def test_the_evaluations_begin_with_the_random_policy_at_step_0(tmp_path: Path) -> None:
    page = written(tmp_path, run_summary())

    table = page.split('<h2>Evaluations</h2>')[1].split('</table>')[0]
    rows = re.findall(r'<tr><td>(.*?)</td><td>(.*?)</td>', table)
    assert rows == [
        ('0 (random policy)', '20.00'),
        ('1000', '25.00'),
        ('2000', '125.00'),
        ('2500', '225.00'),
    ]


def test_the_learning_curve_begins_at_step_0(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    line = report.pictures.line
    monkeypatch.setattr(
        report.pictures, 'line', lambda *args: drawn.append(args[1]) or line(*args)
    )

    report.draw(run_summary())

    assert [point[0] for point in drawn[0]] == [0, 1000, 2000, 2500]
    assert drawn[0][0] == (0, 20.0)


def test_settings_that_differ_from_the_nearest_preset_are_shown_and_all_others_folded(
    tmp_path: Path,
) -> None:
    page = written(tmp_path, run_summary())

    shown, _, folded = page.partition('<details>')
    assert 'differ from the preset quick' in shown
    assert '<tr><td>steps</td><td>8000</td><td>2500</td></tr>' in shown
    assert '<tr><td>evaluate_episodes</td><td>10</td><td>2</td></tr>' in shown
    assert 'codetr.learning_rate' not in shown
    assert '<tr><td>codetr.learning_rate</td><td>0.001</td></tr>' in folded
    assert '<td>composite_rewards</td>' in folded
    assert all(f'<td>{name}</td>' in folded for name in SETTINGS.flat())


def test_the_origin_of_a_run_is_there(tmp_path: Path) -> None:
    made = run_summary().model_copy(
        update={
            'command': 'codetr train --delay 7',
            'host': 'robot-9',
            'began': '2026-01-02T03:04',
        }
    )

    page = written(tmp_path, made)

    for text in ('codetr train --delay 7', 'robot-9', '2026-01-02 03:04', 'torch 2.'):
        assert text in page, text


def test_no_number_of_a_page_has_an_exponent(tmp_path: Path) -> None:
    made = Summary(config.load('paper').changed({'steps': 2500}), 'r', in_process=False)
    for record in a_run():
        made.receive(record)
    for i, score in enumerate((6.5e-06, 7.5e-06)):
        changes = {'step': 2500, 'version': 2, 'episode': i, 'score': score, 'true_return': 1e-5}
        made.receive(episode(**changes))

    page = written(tmp_path, made.build({}))

    text = re.sub(r'src="[^"]*"', '', page)
    assert not re.search(r'\d(\.\d+)?e[-+]?\d', text.partition('Identity')[0])
    assert '<tr><td>codetr.learning_rate</td><td>0.00005</td></tr>' in page


def test_pictures_of_step_rewards_losses_and_returns_are_there_if_the_run_has_them(
    tmp_path: Path,
) -> None:
    made = run_summary().model_copy(update={'reward_recovery': recovered((1000, 0.2, 0.4))})
    metrics = 'step,phase,training.true_return_mean,reward.reward_loss,learner.critic_loss\n'
    page = written(tmp_path, made, f'{metrics}1000,0,5.0,0.1,2.0\n2000,1,6.0,,1.0\n')

    assert {'Training', 'Some segments, step by step'} <= set(headings(page))
    assert page.count('<img') == 4  # with the learning curve and the recovery

    bare = report.page(run_summary(), b'')
    assert not {'Training', 'Some segments, step by step'} & set(headings(bare))
    assert bare.count('<img') == 1


def test_a_damaged_table_is_named_in_the_report_which_does_without_it(tmp_path: Path) -> None:
    summary.write(tmp_path, run_summary(), 'what,is\nthis,table\n')

    report.write(tmp_path, run_summary())

    page = (tmp_path / run_folder.REPORT).read_text()
    assert 'metrics.csv is not the table of a run' in page


def test_a_summary_of_an_earlier_version_still_makes_a_report() -> None:
    made = run_summary()
    later = ('began', 'host', 'command', 'label_unit')
    old = {name: v for name, v in made.model_dump(mode='json').items() if name not in later}
    old['settings'] = {**old['settings'], 'a_setting_of_old': 3}

    page = report.page(RunSummary.model_validate(old), b'')

    assert '<td>begun</td><td>not recorded</td>' in page
    assert '<tr><td>a_setting_of_old</td><td>not given</td><td>3</td></tr>' in page


@pytest.mark.parametrize(
    ('rows', 'shown'),
    [
        (
            [(1000, 0.1, 0.05), (9000, 0.9, 0.95)],
            'almost as the true ones do. Their correlation with the true rewards inside segments '
            'rose from 0.05 after 1000 steps to 0.95 after 9000',
        ),
        ([(1000, 0.1, 0.7), (9000, 0.9, 0.4)], 'in part. .* fell from 0.70 after 1000'),
        ([(1000, 0.1, 0.7), (9000, 0.9, 0.69)], 'mostly .* stayed about the same, from 0.70'),
        ([(1000, 0.1, 0.2)], 'hardly .* is 0.20 after 1000 steps'),
        ([(1000, 0.1, -0.4)], 'do not single out .* is -0.40'),
        ([(1000, 0.1, None)], 'nothing can be compared'),
    ],
)
def test_a_sentence_explains_the_reward_recovery(rows, shown: str) -> None:
    assert re.search(shown, recovery_text(recovered(*rows)))


def test_the_scale_of_inferred_rewards_stands_beside_that_of_the_true_ones() -> None:
    (row,) = recovered((1000, 0.1, 0.2))
    scales = {'true_mean': 2.0, 'true_std': 0.5, 'inferred_mean': 1.9, 'inferred_std': 6.5e-06}
    known = row.model_copy(update=scales)
    made = run_summary().model_copy(update={'reward_recovery': [known], 'label_unit': 7.25})

    assert 'an inferred reward is 1.9 +- < 0.0001' in scale_text(made)
    assert 'a true one 2 +- 0.5' in scale_text(made)
    assert 'in units of 7.25' in scale_text(made)
    assert not scale_text(made.model_copy(update={'reward_recovery': [row]}))


@pytest.mark.parametrize(
    ('rows', 'shown'),
    [
        ([], 'no labels were compared'),
        ([(4000, 0.125, 0.5)], 'correlation 0.12, within segments 0.50'),
        ([(4000, 0.125, None)], 'correlation 0.12'),
        ([(2000, 0.125, None)], 'correlation 0.12, after 2000 steps'),
        ([(2000, 0.9, 0.9), (4000, None, None)], 'not defined where one side does not vary'),
    ],
)
def test_the_report_tells_the_last_reward_recovery(rows, shown):
    made = run_summary()
    last = made.evaluations[-1].model_copy(update={'step': 4000})
    said = made.model_copy(update={'evaluations': [last], 'reward_recovery': recovered(*rows)})
    assert dict(report.result_rows(said))['reward recovery'] == shown


@pytest.mark.parametrize(
    ('encoding', 'shown'), [('utf-8', '▁▄█▁'), ('ascii', '.=@.'), (None, '.=@.')]
)
def test_the_sketch_of_a_curve_fits_the_terminal(encoding: str | None, shown: str) -> None:
    assert report.sketch([0, 50, 110, 0], encoding) == shown
    assert report.sketch([3.0, 3.0], 'utf-8') == '▁▁'


def test_a_run_that_nobody_evaluates_states_so_once_and_shows_the_scores_that_were_given(tmp_path):
    given = [GivenScores(phase=n, scores=2 + n, per_step=0.1 * n, random=n < 2) for n in range(10)]
    names = ('random', 'final_score', 'random_score', 'final_true_return', 'random_true_return')
    changes = dict.fromkeys(names) | {'evaluations': [], 'scores_given': given}
    made = run_summary().model_copy(update=changes)
    page = written(tmp_path, made)
    assert page.count('not evaluated') == 0
    assert page.count('no policy was tried in simulation') == 1
    assert 'Evaluations' not in headings(page)
    # phases 8 and 9: (10 * 0.8 + 11 * 0.9) / 21
    assert 'last fifth of the phases' in page and '0.852, mean of 21 scores' in page
    assert '0.060, mean of 5 scores' in page
    drawn = report.given(given, report.title(made))
    assert (tmp_path / run_folder.PICTURE).read_bytes() == drawn


def test_the_scores_of_a_bag_are_given_to_the_summary_by_phase():
    course = ScoreCourse({0: [1.0, 3.0], 4: [2.0]})
    rows = course.rows(warmup=1)
    assert [(r.phase, r.scores, r.per_step, r.random) for r in rows] == [
        (0, 2, 2.0, True),
        (4, 1, 2.0, False),
    ]
