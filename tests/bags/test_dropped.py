"""A bag of a run from which a simulator was left out: whoever reads it drops what was dropped."""

from dataclasses import replace

import pytest

from codetr_ros.bags.causal import causal
from codetr_ros.bags.definitions import encode
from codetr_ros.bags.dropped import undropped_entries
from codetr_ros.bags.info import survey
from codetr_ros.bags.playback import Playback, PlayError, items, recorded_run
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.topics import RECORDED, topics_of_run
from codetr_ros.bags.verify import verify
from codetr_ros.bags.writer import McapWriter
from codetr_ros.cores.recorder import Recorder
from codetr_ros.records import TOPICS, Commit, Transitions, TrueRewards
from codetr_ros.simtest.replay import replayed
from helpers.leaving import bag_with_dropped_steps


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp('dropped') / 'bag'
    simulated, ended = bag_with_dropped_steps(folder)
    assert ended.failures == [] and ended.errors == {}
    return folder, simulated


@pytest.fixture(scope='module')
def recorded(made):
    return [entry.record for entry in Bag(made[0]).entries()]


def dropping(records):
    return next(each for each in records if isinstance(each, Commit) and each.dropped)


def rewritten(records, folder, settings):
    names = {kind: f'/run/{TOPICS[kind]}' for kind in RECORDED}
    topics = dict(zip(RECORDED, topics_of_run(names, settings), strict=True))
    writer = McapWriter(folder, topics.values())
    for time, record in enumerate(records):
        writer.write(topics[type(record)].name, encode(record, time), time, time)
    writer.close()
    return folder


def test_verify_follows_the_commits_over_what_was_dropped(made):
    found = verify(made[0])
    assert found.findings.named == []
    remark = (
        "'sim_2' was left out of 1 phases in which it had steps to take; 2 that came were dropped"
    )
    assert any(remark in each for each in found.findings.remarks)
    (run,) = found.report()['runs']
    assert run['steps_dropped'] == {'sim_2': 2}
    assert run['phases_whole'] == run['phases_committed']


def test_a_commit_that_drops_nobody_any_more_is_found(made, recorded, tmp_path):
    wrong = [
        replace(each, dropped=()) if isinstance(each, Commit) and each.dropped else each
        for each in recorded
    ]
    found = verify(rewritten(wrong, tmp_path / 'bag', made[1].plan.settings))
    assert {'digest', 'commit'} <= {each.kind for each in found.findings.named}


def test_a_number_missing_before_what_was_dropped_is_still_a_gap(made, recorded, tmp_path):
    out = dropping(recorded)
    last = dict(zip(out.sources, out.transitions.tolist(), strict=True))['sim_2']
    lost = max(
        each.sequence
        for each in recorded
        if isinstance(each, Transitions) and each.source == 'sim_2' and each.sequence <= last
    )
    less = [
        each
        for each in recorded
        if not (
            isinstance(each, (Transitions, TrueRewards))
            and (each.source, each.sequence) == ('sim_2', lost - 1)
        )
    ]
    found = verify(rewritten(less, tmp_path / 'bag', made[1].plan.settings))
    assert any(f'number {lost - 1} is missing' in each.text for each in found.findings.named)


def test_info_counts_what_was_dropped(made):
    (run,) = survey(made[0])['runs']
    sources = run['sources']
    assert (sources['sim_2']['steps_dropped'], sources['sim_2']['phases_dropped']) == (2, 1)
    assert (sources['sim']['steps_dropped'], sources['sim']['phases_dropped']) == (0, 0)


def test_entries_without_those_that_were_dropped_go_on_where_the_episode_was(made, recorded):
    place = {}
    kept = [entry.record for entry in undropped_entries(Bag(made[0]), (Transitions,))]
    for chunk in kept:
        due = place.get(chunk.source, (0, 0))
        assert (chunk.episode, chunk.first_step) == due
        ended = chunk.terminated or chunk.truncated
        after = chunk.first_step + chunk.steps
        place[chunk.source] = (chunk.episode + 1, 0) if ended else (chunk.episode, after)
    everything = [each for each in recorded if isinstance(each, Transitions)]
    assert sum(c.steps for c in everything) - sum(c.steps for c in kept) == 2


def test_whoever_learns_from_what_is_played_ends_with_the_weights_of_the_run(made):
    folder, simulated = made
    recorded = recorded_run(Bag(folder))
    played = Playback(items(Bag(folder), recorded.run.run_id), recorded.phases, 1, ())
    records = []
    for batch in played.work():
        records += [item.record for item in batch or ()]
        if played.finished:
            break
    assert played.counters['phases of a source dropped'] == 1
    assert replayed(recorded.run, recorded.settings, [recorded.run, *records]) == (
        simulated.processes['learner'].core.report().policy_sha256,
        simulated.processes['reward'].core.report().reward_model_sha256,
    )


def test_what_a_commit_names_of_others_must_still_be_there_to_be_played(made, recorded):
    out = dropping(recorded)
    last = dict(zip(out.sources, out.transitions.tolist(), strict=True))['sim']
    less = [
        item
        for item in items(Bag(made[0]), out.run_id)
        if not (
            isinstance(item.record, Transitions)
            and (item.record.source, item.record.sequence) == ('sim', last)
        )
    ]
    with pytest.raises(PlayError, match=f"transitions {last} to {last} of 'sim' are not in"):
        for _ in Playback(less, made[1].plan.settings.phases, 1, ()).work():
            pass


def test_topics_in_any_order_are_brought_into_one_that_the_run_can_have_had(made):
    messages = list(items(Bag(made[0]), 'simtest'))
    by_topic = sorted(messages, key=lambda item: TOPICS[type(item.record)])
    phases = [item.record.phase for item in causal(by_topic, 1) if type(item.record) is Commit]
    assert phases == sorted(phases)
    number = {}
    for item in causal(by_topic, 1):
        record = item.record
        if isinstance(record, Transitions):
            number[record.source] = record.sequence
        elif isinstance(record, Commit):
            for name, last in zip(record.sources, record.transitions.tolist(), strict=True):
                assert name in record.dropped or number[name] >= last


def test_a_recorder_that_goes_on_with_the_bag_commits_the_same_again(made, recorded):
    settings = made[1].plan.settings
    core = Recorder(settings.run_spec('simtest'), settings, 'record')
    for record in recorded:
        core.restore(record)
    assert core.phase == settings.phases
