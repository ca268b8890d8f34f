"""Runs in which messages, disks and nodes fail end as if nothing had happened, or by name."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import pytest

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.losing import losing
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.place import Pace
from codetr_ros.simtest.plan import DEADLINE, all_settings, plan
from codetr_ros.simtest.run import carry_out, simulate
from helpers.slow_runs import far_apart, slow_and_losing

QUICK, MANY = range(24), range(24, 120)
FOUND = (43, 247, 475, 583, 792, 821, 1604, 5709, 5733, 50070, 50636, 53873)
"""Seeds beyond those that once failed."""
LOSING = (110, 128, 136, 176, 213, 217, 219, 260)
"""Likewise, where much is lost and nodes are killed: a node gave up on what it did not need or on
what was lost only now, or waited until a recorder had asked all others.
"""


def failures(seeds):
    return {seed: found for seed in seeds if (found := simulate(seed).failures)}


def test_a_few_seeds_end_as_if_nothing_had_happened_or_by_name():
    assert failures(QUICK) == {}


def test_seeds_that_once_failed_end_as_if_nothing_had_happened_or_by_name():
    assert failures(FOUND) == {}


def test_where_a_fifth_of_all_is_lost_and_nodes_are_killed_nobody_waits_in_vain():
    assert {seed: found for seed in LOSING if (found := carry_out(losing(seed)).failures)} == {}


@pytest.mark.parametrize('seed', [4, 6])
def test_an_evaluator_gives_up_on_no_policy_that_it_does_not_need(seed):
    ended = carry_out(slow_and_losing(seed), kept=20_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert any('policy to evaluate is lost' in line for line in ended.trace)


@pytest.mark.parametrize('seed', [28, 60])
def test_questions_whose_answers_take_longer_than_the_next_try_are_answered(seed):
    assert carry_out(far_apart(plan(seed))).failures == []


def test_no_loss_is_hidden_where_many_messages_never_reach_the_recorder():
    for seed in (47, 51, 285):
        planned = plan(seed)
        weather = replace(planned.weather, overrun=0.1)
        planned = replace(planned, weather=weather, deaths=(), disk=Trouble())
        assert carry_out(replace(planned, checkpoints=Trouble())).failures == []


@pytest.mark.slow
def test_some_hundred_seeds_end_as_if_nothing_had_happened_or_by_name():
    assert failures(MANY) == {}


def test_seeds_draw_every_kind_of_run_and_every_kind_of_trouble():
    plans = [plan(seed) for seed in range(24, 300)]
    assert {each.settings.hash() for each in plans} == {s.hash() for s in all_settings()}
    for happens in (
        lambda p: p.weather.doubled,
        lambda p: p.weather.lost,
        lambda p: p.weather.overrun,
        lambda p: p.weather.unanswered,
        lambda p: p.weather.reorder,
        lambda p: p.weather.partitions,
        lambda p: any(pace.stalls for pace in p.paces.values()),
        lambda p: p.deaths,
        lambda p: p.disk.room is not None,
        lambda p: p.disk.syncs is not None,
        lambda p: p.calm,
        lambda p: not p.heals,
    ):
        count = sum(bool(happens(each)) for each in plans)
        assert 3 < count < len(plans)


def test_a_run_that_cannot_be_mended_ends_by_errors_that_name_a_cause():
    for disk, cause in (
        (Trouble(syncs=2), 'Input/output error'),
        (Trouble(room=60_000), 'No space left on device'),
    ):
        ended = carry_out(replace(plan(0), disk=disk, heals=False))
        assert cause in ended.errors['record']
        assert 'record /record' in ended.errors['learner']
        assert ended.failures == []


def test_a_wait_that_nobody_can_end_ends_at_the_deadline_and_names_who_waits_for_what():
    seed = next(i for i, each in enumerate(all_settings()) if each.method == 'rrd')
    calm = Weather(delay=0.01, overrun=0.2, unanswered=1.0)
    planned = replace(
        plan(seed), weather=calm, disk=Trouble(), checkpoints=Trouble(), deaths=(), heals=False
    )
    ended = carry_out(replace(planned, paces=dict.fromkeys(planned.paces, Pace())))
    assert ended.failures == []
    assert set(ended.errors) == set(planned.paces)
    assert DEADLINE < ended.seconds < DEADLINE + 20
    lacks = r"record (gave up after \d+ s: it )?waits for the rest of phase \d+: \d+ .* of 'sim'"
    for error in ended.errors.values():  # each names the one that lacks something, and what
        assert re.search(lacks, error), error


def test_what_made_a_chain_of_nodes_give_up_is_named_by_all_of_them():
    ended = carry_out(replace(plan(0), disk=Trouble(room=60_000), heals=False))
    assert set(ended.errors) == set(plan(0).paces)
    for error in ended.errors.values():
        assert 'No space left on device' in error, ended.errors


PROGRAM = """
import sys
from codetr_ros.simtest.run import simulate
outcome = simulate(3)
print(outcome.seconds, outcome.errors, *outcome.trace, sep='\\n')
"""


def test_a_seed_gives_the_same_run_to_the_last_event_in_another_process_too():
    texts = []
    for hash_seed in ('1', '2'):  # which decides the order of sets
        environment = os.environ | {'PYTHONHASHSEED': hash_seed}
        done = subprocess.run(
            [sys.executable, '-c', PROGRAM],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
        texts.append(done.stdout)
    assert len(texts[0].splitlines()) > 100
    assert texts[0] == texts[1]
