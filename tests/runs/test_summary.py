import csv
import io
import json
from pathlib import Path
from typing import Any

import pytest

from codetr_ros.cli import results
from codetr_ros.config import Settings
from codetr_ros.records import EpisodeResult, metrics
from codetr_ros.runs import facts, report, summary
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.progress import Progress
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.summary import Summary
from helpers.bags import ours
from helpers.builders import step_rewards
from helpers.summaries import SETTINGS, Clock, a_run, built, run_summary


def test_a_summary_says_what_was_run_and_what_came_out() -> None:
    said = built()

    for key, value in {
        'run_id': 'r',
        'task': 'Reacher-v5',
        'composite': 'sum',
        'delay': 50,
        'method': 'codetr',
        'seed': 0,
        'steps': 2500,
        'phases': 3,
        'wall_s': 50.0,
        'steps_per_s': 50.0,
        'policy_sha256': 'abc',
        'reward_model_sha256': 'def',
        'updates': 1500,
        'gradient_steps': 240,
        'bag': '/runs/x/bag',
        'interrupted': False,
        'in_process': False,
        'failure': None,
        'settings_hash': SETTINGS.hash(),
    }.items():
        assert said[key] == value, key
    assert Settings.model_validate(said['settings']) == SETTINGS
    assert said['versions']['torch'].startswith('2.')
    assert json.loads(json.dumps(said)) == said


def test_each_evaluation_has_means_and_spread_over_its_episodes() -> None:
    said = built()

    assert [row['step'] for row in said['evaluations']] == [1000, 2000, 2500]
    assert said['evaluations'][-1] == {
        'step': 2500,
        'version': 2,
        'true_return_mean': 225.0,
        'true_return_std': 25.0,
        'true_return_min': 200.0,
        'true_return_max': 250.0,
        'composite_return_mean': 60.0,
        'score_mean': pytest.approx(0.225),
        'score_std': pytest.approx(0.025),
        'length_mean': 40.0,
        'episodes': 2,
    }
    assert said['final_score'] == pytest.approx(0.225)
    assert said['final_true_return'] == 225.0
    assert said['random_score'] == 0.5
    assert said['random_true_return'] == 20.0


def test_an_evaluation_that_lacks_episodes_is_no_result_and_is_counted() -> None:
    made = Summary(SETTINGS, 'r', in_process=False)
    for record in a_run():
        lacking = isinstance(record, EpisodeResult) and record.purpose != 'training'
        if not (lacking and record.version in (-1, 2) and record.episode == 1):
            made.receive(record)
    said = made.build({})

    assert [row.step for row in said.evaluations] == [1000, 2000]
    assert said.random is None
    assert said.final_true_return == 125.0
    assert said.evaluations_missing == 2
    lacks = '2 of 4 evaluations are missing or lack episodes'
    assert lacks in dict(report.result_rows(said))['evaluations']
    assert lacks in report.page(said, b'')
    steps = [row['step'] for row in table(made.metrics_csv()) if row.get('evaluation.episodes')]
    assert steps == ['1000', '2000']


def test_messages_that_came_again_as_others_are_shown() -> None:
    again = NodeReport(role='record', name='record', different={'transitions': 3})
    made = Summary(SETTINGS, 'r', in_process=False).build({'record-record': again})

    assert made.different == made.messages['transitions'].different == 3
    assert '3 came again as others' in dict(report.result_rows(made))['messages']
    assert 'again' not in dict(report.result_rows(run_summary()))['messages']


def test_messages_are_counted_by_topic_over_all_nodes() -> None:
    said = built()

    assert said['messages']['transitions'] == {
        'published': 100,
        'recorded': 98,
        'received_by_learner': 99,
        'received_by_reward': 100,
        'lost': 1,
        'duplicated': 0,
        'refused': 0,
        'different': 0,
    }
    assert said['messages']['composite_rewards']['refused'] == 4
    assert said['messages']['composite_rewards']['lost'] == 5
    assert said['messages']['true_rewards']['published'] == 0, 'a silent topic is there with zeros'
    assert (said['lost'], said['duplicated'], said['refused']) == (6, 2, 4)


def test_what_each_process_took_is_listed_this_one_included() -> None:
    said = built()

    assert said['processes']['sim-sim']['peak_rss_mb'] == 80.5
    assert said['processes']['sim-sim']['cpu_s'] == 2.5
    assert said['processes']['codetr']['peak_rss_mb'] > 1
    assert said['counters'] == {'learner-learner': {'labels of evicted steps': 7}}


def test_a_run_that_was_stopped_at_once_has_a_summary_too() -> None:
    made = Summary(SETTINGS, 'r', in_process=True).build({}, interrupted=True)
    said = made.model_dump(mode='json')

    assert said['interrupted']
    assert (said['steps'], said['phases'], said['steps_planned']) == (0, 0, 2500)
    assert said['final_score'] is None
    assert said['policy_sha256'] is None
    assert said['bag'] is None
    report.page(made, report.draw(made))


def test_numbers_that_json_has_no_word_for_become_null() -> None:
    assert facts.finite({'a': [1.0, float('nan')], 'b': (float('inf'),), 'c': 'x', 'd': 3}) == {
        'a': [1.0, None],
        'b': [None],
        'c': 'x',
        'd': 3,
    }


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_metrics_have_a_row_for_each_phase_and_a_column_for_each_number() -> None:
    made = Summary(SETTINGS, 'r', in_process=False)
    for record in reversed(a_run()):
        made.receive(record)

    rows = table(made.metrics_csv())

    assert [row['step'] for row in rows] == ['0', '1000', '2000', '2500']
    assert [row['phase'] for row in rows] == ['', '0', '1', '2']
    assert [row['evaluation.true_return_mean'] for row in rows] == [
        '20.0',
        '25.0',
        '125.0',
        '225.0',
    ]
    assert [row['learner.critic_loss'] for row in rows] == ['', '1.0', '0.5', repr(1 / 3)]
    assert [row['training.true_return_mean'] for row in rows] == ['', '50.0', '50.0', '50.0']
    assert [row['sim.simulate_seconds'] for row in rows] == ['', '0.5', '0.5', '0.5']


def test_several_nodes_of_a_role_get_columns_of_their_own() -> None:
    made = Summary(SETTINGS, 'r', in_process=False)
    made.receive(metrics('r', 'sim', '/run_r/sim', 0, 1000, {'simulate_seconds': 1.0}))
    made.receive(metrics('r', 'sim', '/run_r/sim_2', 0, 1000, {'simulate_seconds': 2.0}))

    (row,) = table(made.metrics_csv())

    assert (row['sim.simulate_seconds'], row['sim_2.simulate_seconds']) == ('1.0', '2.0')


def test_what_is_learnt_about_a_run_that_has_ended_takes_none_of_its_time():
    clock = Clock()
    made = Summary(SETTINGS, 'r', in_process=False, clock=clock)
    clock.now += 50
    made.end()
    clock.now += 7
    assert made.build({}).wall_s == 50


def test_a_summary_on_disk_is_what_was_built(tmp_path: Path) -> None:
    made = run_summary()

    summary.write(tmp_path, made, 'step\n0\n')

    said = made.model_dump(mode='json')
    assert json.loads((tmp_path / 'summary.json').read_text()) == said
    assert (tmp_path / 'metrics.csv').read_text() == 'step\n0\n'


def told(made: Summary) -> tuple[dict[str, Any], str]:
    """What is said of a run, without what its process takes."""
    return made.build({}).model_dump(exclude={'processes'}), made.metrics_csv()


def test_a_run_that_is_told_twice_and_in_another_order_is_the_same_run():
    once, twice = Summary(SETTINGS, 'r', False, Clock()), Summary(SETTINGS, 'r', False, Clock())
    for record in a_run():
        once.receive(record)
    for record in [*reversed(a_run()), *a_run()]:
        twice.receive(record)
    assert told(once) == told(twice)


def test_what_was_not_heard_is_taken_from_the_bag(tmp_path):
    """Who listens to a run may be found after its first messages have gone out."""
    bag = ours(tmp_path / run_folder.BAG, a_run())
    heard, late = Summary(SETTINGS, 'r', False, Clock()), Summary(SETTINGS, 'r', False, Clock())
    stream = io.StringIO()
    progress = Progress(SETTINGS, stream, live=False, clock=Clock())
    for record in a_run():
        heard.receive(record)
    for record in a_run()[3:]:
        late.receive(record)
    assert late.build({}).random is None
    results.complete(late, tmp_path / run_folder.BAG, progress.log)
    assert told(late) == told(heard)
    assert stream.getvalue() == ''

    file = next(bag.glob('*.mcap'))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    results.complete(late, tmp_path / run_folder.BAG, progress.log)
    assert told(late) == told(heard)
    assert 'what was received' in stream.getvalue()


def test_ctrl_c_ends_the_reading_of_the_bag_and_the_summary_is_written_all_the_same(tmp_path):
    ours(tmp_path / run_folder.BAG, a_run())
    late = Summary(SETTINGS, 'r', False, Clock())
    logged: list[str] = []
    results.complete(late, tmp_path / run_folder.BAG, logged.append, lambda: True)
    assert logged == ['stopped: the summary holds what was read until now']
    assert late.build({}).evaluations == []


def test_reward_recovery_without_all_true_rewards_is_said_not_to_be_told(tmp_path):
    ours(tmp_path / run_folder.BAG, [*a_run(), step_rewards(run_id='r', phase=0, source='sim')])
    stream, late = io.StringIO(), Summary(SETTINGS, 'r', False, Clock())
    progress = Progress(SETTINGS, stream, live=False, clock=Clock())
    results.complete(late, tmp_path / run_folder.BAG, progress.log)
    assert "reward recovery is incomplete: 'sim' published no true rewards" in stream.getvalue()
    assert late.build({}).evaluations, 'all else is told'
