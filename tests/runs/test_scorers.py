"""Who scored, in the summary and in the report of a run."""

from codetr_ros.records import metrics
from codetr_ros.runs import report
from codetr_ros.runs.reports import PREFERENCES_UNUSED
from helpers.summaries import run_summary


def reported(phase, **values):
    return metrics('r', 'reward', 'reward', phase, 1000 * (phase + 1), values)


def with_scorers():
    first = {'scorer_ann_b_scores': 3.0, 'scorer_ann_b_slope': 9.0}
    last = {'preferences': 4.0, 'offset': -2.0, 'slope': 0.5, 'noise': float('nan')}
    last |= {'scores': 12.0, 'agreement': 0.87}
    return run_summary(
        reported(0, **first),
        reported(1, **{f'scorer_ann_b_{name}': value for name, value in last.items()}),
    )


def test_the_summary_has_each_scorer_as_the_last_phase_knew_it():
    (name, row), *others = with_scorers().scorers.items()
    assert (name, others) == ('ann_b', [])
    assert (row.scores, row.preferences, row.slope, row.noise) == (12, 4, 0.5, None)


def test_the_report_shows_who_scored_and_how_well_they_agree():
    text = report.page(with_scorers(), b'')
    assert 'Who scored' in text and '0.87' in text and 'not known' in text


def test_the_report_counts_judgements_that_were_not_learnt_from_as_stated():
    known = with_scorers()
    assert PREFERENCES_UNUSED not in report.page(known, b'')
    unused = known.model_copy(update={'counters': {'reward': {PREFERENCES_UNUSED: 4}}})
    assert f'4 {PREFERENCES_UNUSED}: method' in report.page(unused, b'')


def test_where_the_simulator_scored_nothing_is_shown_of_scorers():
    assert 'Who scored' not in report.page(run_summary(), b'')
