"""Whole runs in this process whose scores come irregularly, by every method."""

import math
from typing import get_args

import pytest

from codetr_ros.config import SCORE_LEARNERS, Method
from codetr_ros.cores import in_process
from codetr_ros.records import CompositeReward, Metrics, Record
from codetr_ros.runs.report_text import title
from codetr_ros.runs.summary import Summary
from helpers.builders import tiny

METHODS = get_args(Method)


def finished(**changes) -> tuple[Summary, list[Record], dict]:
    """A short run to its end: its summary so far, its records and its reports."""
    few = {'steps': 600, 'warmup_steps': 200, 'sac__updates_per_step': 0.1, 'hc__width': 8}
    settings = tiny(**few | {'evaluate_every': 600, 'evaluate_episodes': 1} | changes)
    records: list[Record] = []
    summary = Summary(settings, 'calls', True)

    def observe(record: Record) -> None:
        records.append(record)
        summary.receive(record)

    reports = in_process.run(settings, 'calls', observe=observe)
    assert all(report.finished for report in reports.values())
    assert not any(sum(report.refused.values()) for report in reports.values())
    return summary, records, reports


@pytest.mark.slow
@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('delay', ['3:20', 'episode'])
def test_every_method_learns_from_scores_of_any_delay(method, delay):
    summary, records, reports = finished(method=method, delay=delay, task='Reacher-v5')
    built = summary.build(reports, None, False, None)
    assert built.delay == delay and built.policy_sha256
    assert built.final_score is not None
    scores = [r for r in records if isinstance(r, CompositeReward)]
    if method not in SCORE_LEARNERS:
        assert labelled(records) == sum(score.length for score in scores)


INEXACT = {'score_missing': 0.4, 'score_noise': 0.5, 'score_levels': 5}


@pytest.mark.slow
@pytest.mark.parametrize('method', METHODS)
def test_every_method_learns_where_scores_are_missing_noisy_and_verdicts(method):
    how = {'method': method, 'delay': '3:20', 'task': 'InvertedDoublePendulum-v5'}
    summary, records, reports = finished(**how | INEXACT)
    scores = [r for r in records if isinstance(r, CompositeReward)]
    missing = [score for score in scores if math.isnan(score.value)]
    assert 0.2 < len(missing) / len(scores) < 0.6
    assert {s.value for s in scores} - {s.value for s in missing} <= {1.0, 2.0, 3.0, 4.0, 5.0}
    counters = reports['sim'].counters
    assert (counters['scores'], counters['scores missing']) == (len(scores), len(missing))
    if method not in SCORE_LEARNERS:
        assert labelled(records) == sum(score.length for score in scores)
    built = summary.build(reports, None, False, None)
    assert '(40% missing, noise of 0.5 deviations, on 5 levels)' in title(built)


def test_what_is_evaluated_is_the_true_score():
    few = {'method': 'ones', 'steps': 200, 'task': 'Reacher-v5'}  # one that no score changes
    one, other = (finished(**few | how)[0].evaluations() for how in ({}, INEXACT))
    assert one == other and one


@pytest.mark.slow
@pytest.mark.parametrize('method', ['uniform', 'mlp', 'evidence', 'hc', 'lirpg'])
@pytest.mark.parametrize('share', [0.95, 0.9999])
def test_a_run_with_hardly_any_score_or_none_at_all_still_ends(method, share):
    _, records, reports = finished(method=method, delay=25, score_missing=share)
    scores = [r for r in records if isinstance(r, CompositeReward)]
    known = sum(not math.isnan(score.value) for score in scores)
    assert (0 < known < len(scores) / 8) if share == 0.95 else known == 0
    if method not in SCORE_LEARNERS:
        steps = sum(score.length for score in scores)
        assert labelled(records) == (steps if known else 0)
    if 'reward' in reports and not known:
        assert reports['reward'].counters['segments not labelled, nothing scored'] > 0


def labelled(records: list[Record]) -> float:
    """Labelled steps of the learner's memory at the end."""
    last = [r for r in records if isinstance(r, Metrics) and r.role == 'learner'][-1]
    return dict(zip(last.names, last.values.tolist(), strict=True))['labelled_steps']
