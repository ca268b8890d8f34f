"""Whole runs in this process whose scores come irregularly, by every method."""

from typing import get_args

import pytest

from codetr_ros.config import SCORE_LEARNERS, Method
from codetr_ros.cores import in_process
from codetr_ros.records import CompositeReward, Metrics, Record
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


def labelled(records: list[Record]) -> float:
    """Labelled steps of the learner's memory at the end."""
    last = [r for r in records if isinstance(r, Metrics) and r.role == 'learner'][-1]
    return dict(zip(last.names, last.values.tolist(), strict=True))['labelled_steps']
