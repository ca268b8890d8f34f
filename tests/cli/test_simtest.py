"""`codetr simtest` simulates one seed or many, and says what failed."""

import json

import pytest

from codetr_ros import cli
from codetr_ros.simtest import run
from codetr_ros.simtest.run import simulate


def test_a_seed_prints_what_it_draws_and_how_the_run_ended(capsys):
    assert cli.main(['simtest', '--seed', '0']) == 0
    printed = capsys.readouterr().out
    assert 'method none, 1 simulators of 1' in printed
    assert 'seed 0: sound after' in printed
    assert 'publishes Commit' not in printed


def test_the_trace_lists_the_newest_events(capsys):
    assert cli.main(['simtest', '--seed', '0', '--trace', '--events', '25']) == 0
    printed = capsys.readouterr().out
    assert printed.count('\n') < 35
    assert 'record      has finished' in printed


def test_many_seeds_are_counted(capsys):
    assert cli.main(['simtest', '--seeds', '0:3', '--json']) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report['seeds'], report['first'], report['failed']) == (3, 0, [])


def test_a_failing_seed_is_named_with_its_failure_and_the_events_before(capsys, monkeypatch):
    monkeypatch.setattr(run.checks, 'at_the_end', lambda simulated: ['the sky fell'])
    assert simulate(1).failures == ['the sky fell']
    assert cli.main(['simtest', '--seeds', '1:2']) == cli.FAILED
    assert 'seed 1: the sky fell' in capsys.readouterr().out
    assert cli.main(['simtest', '--seed', '1']) == cli.FAILED
    printed = capsys.readouterr().out
    assert 'seed 1: the sky fell' in printed
    assert '  learner     ' in printed


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        ([], 'give --seed N for one run, or --seeds A:B for many'),
        (['--seed', '1', '--seeds', '0:2'], 'give --seed N for one run, or --seeds A:B for many'),
        (['--seeds', '5:5'], '--seeds 5:5: give two numbers, the smaller first: 0:100'),
        (['--seed', '1', '--events', '0'], '--events 0: a run has at least 1 event'),
    ],
)
def test_what_cannot_be_meant_is_refused(arguments, complaint, capsys):
    assert cli.main(['simtest', *arguments]) == cli.USAGE
    assert complaint in capsys.readouterr().err
