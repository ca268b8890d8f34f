"""What of a bag goes out when, without ROS."""

from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.bags import causal as causal_module
from codetr_ros.bags.causal import causal
from codetr_ros.bags.playback import (
    Item,
    Pace,
    Playback,
    PlaybackReport,
    PlayError,
    items,
    recorded_run,
)
from codetr_ros.bags.reader import Bag
from codetr_ros.records import (
    Commit,
    CompositeReward,
    Metrics,
    Policy,
    Presence,
    RunSpec,
    StepRewards,
    Transitions,
    TrueRewards,
    metrics,
)
from helpers.bags import SETTINGS, WRITERS, a_run, ours
from helpers.builders import run, same


def played(records=None):
    return [
        Item(r, b'', i) for i, r in enumerate(records or a_run()) if not isinstance(r, RunSpec)
    ]


def playback(records=None, phases=3, lag=1, learners=('reward',), pace=None):
    return Playback(played(records), phases, lag, learners, pace)


def until_it_waits(work):
    """What comes out until somebody has to be waited for, or all is out."""
    found = []
    while (slice_ := next(work)) is not None:
        found += [item.record for item in slice_]
    return found


def handled(phase, role='reward'):
    return metrics('run', role, role, phase, 0, {'x': 1.0})


def phases_of(records):
    return [r.phase for r in records if isinstance(r, Commit)]


def steps_of(records):
    return sorted({r.phase for r in records if isinstance(r, Transitions)})


def test_the_next_phase_waits_until_the_one_before_has_been_learnt_from():
    p = playback()
    work = p.work()
    first = until_it_waits(work)
    assert (steps_of(first), phases_of(first)) == ([0], [0])
    assert p.waiting_for() == 'reward, to have learnt from phase 0'
    assert until_it_waits(work) == []
    p.receive(handled(0, 'sim'))  # somebody else's
    assert until_it_waits(work) == []
    p.receive(handled(0))
    assert phases_of(until_it_waits(work)) == [1]
    p.receive(handled(1))
    assert phases_of(until_it_waits(work)) == [2]
    assert not p.finished and not p.done('reward')
    p.receive(handled(2))
    assert until_it_waits(work) == []
    assert p.finished and p.done('reward')


def test_with_overlap_one_phase_more_is_under_way():
    p = playback(lag=2)
    work = p.work()
    assert phases_of(until_it_waits(work)) == [0, 1]
    p.receive(handled(0))
    assert phases_of(until_it_waits(work)) == [2]


def test_everybody_who_learns_is_waited_for():
    p = playback(learners=('reward', 'learner'))
    work = p.work()
    until_it_waits(work)
    p.receive(handled(0))
    assert until_it_waits(work) == []
    assert p.waiting_for() == 'learner, to have learnt from phase 0'
    p.receive(handled(0, 'learner'))
    assert phases_of(until_it_waits(work)) == [1]


def test_with_nobody_to_wait_for_everything_goes_out_in_the_order_of_the_bag():
    records = a_run()
    p = playback(records, learners=())
    found = until_it_waits(p.work())
    assert found == [r for r in records if not isinstance(r, RunSpec)]
    assert p.report() == PlaybackReport(counters={'steps': 60}, phases=3)


def test_what_belongs_to_no_phase_that_is_played_is_left_out_and_counted():
    """A run that was stopped in the middle, and a learner that wants fewer phases."""
    p = playback(phases=2)
    p.receive(handled(1))
    found = until_it_waits(p.work())
    assert phases_of(found) == steps_of(found) == [0, 1]
    assert sum(isinstance(r, CompositeReward) for r in found) == 8
    assert p.report().counters == {
        'steps': 40,
        'transitions of no phase that is played': 4,
        'composite_rewards of no phase that is played': 4,
        'true_rewards of no phase that is played': 4,
        'commits of no phase that is played': 1,
    }
    assert p.finished


def test_the_word_that_all_is_permitted_goes_out():
    nothing = Policy(
        run_id='run',
        phase=3,
        version=2,
        sources=('sim',),
        steps=np.zeros(1, np.uint32),
        random=True,
        network='',
        weights=b'',
    )
    p = playback([*a_run(), nothing])
    p.receive(handled(2))
    assert until_it_waits(p.work())[-1] is nothing


def test_a_gap_is_an_error_that_names_it():
    records = a_run()
    lost = [r for r in records if not (isinstance(r, Transitions) and r.sequence in (5, 6))]
    p = playback(lost)
    p.receive(handled(2))
    with pytest.raises(
        PlayError, match="transitions 5 to 6 of 'sim' are not in the bag, after pha"
    ):
        until_it_waits(p.work())


def test_a_commit_of_something_that_is_missing_is_an_error_before_it_goes_out():
    records = a_run()
    last = [r for r in records if isinstance(r, CompositeReward)][3]
    p = playback([r for r in records if r is not last])
    with pytest.raises(PlayError, match="composite_rewards 3 to 3 of 'sim' are not in the bag"):
        until_it_waits(p.work())


def test_what_was_recorded_twice_is_played_once():
    records = a_run()
    chunk = next(r for r in records if isinstance(r, Transitions))
    at = records.index(chunk)
    p = playback([*records[: at + 1], chunk, *records[at + 1 :]], learners=())
    found = until_it_waits(p.work())
    assert sum(r is chunk for r in found) == 1
    assert p.report().counters['transitions recorded twice'] == 1


def test_steps_recorded_before_the_commit_that_permitted_them_come_after_it():
    """Another recorder may hear topics in another order."""
    records = [r for r in a_run() if isinstance(r, (Transitions, CompositeReward, Commit))]
    commit = next(r for r in records if isinstance(r, Commit))
    late = [r for r in records if r is not commit]
    late.insert(10, commit)  # a chunk and its score too late
    assert late != records
    found = [item.record for item in causal(played(late), 1)]
    assert sorted(map(id, found)) == sorted(map(id, records))
    seen = -1
    for r in found:
        if isinstance(r, Commit):
            seen = r.phase
        elif isinstance(r, Transitions):
            assert r.phase - 1 <= seen
    assert list(causal(played(records), 1)) == played(records)  # nothing else is moved


def topic_by_topic(records, ahead):
    """Each topic in its own order, some so many messages ahead of the others."""
    places = sorted(
        (i - ahead.get(type(r), 0), i) for i, r in enumerate(records) if not isinstance(r, RunSpec)
    )
    return [records[i] for _, i in places]


@pytest.mark.parametrize('first', [Transitions, CompositeReward, Commit, TrueRewards])
@pytest.mark.parametrize('lag', [1, 2])
def test_a_run_is_played_in_whatever_order_its_topics_were_recorded(first, lag):
    records = a_run(phases=6)
    late = topic_by_topic(records, {first: 20, Metrics: 30})
    assert late != [r for r in records if not isinstance(r, RunSpec)]
    p = playback(late, phases=6, lag=lag)
    for phase in range(6):
        p.receive(handled(phase))
    found = until_it_waits(p.work())
    assert p.finished and phases_of(found) == [0, 1, 2, 3, 4, 5]
    assert sorted(map(id, found)) == sorted(map(id, late))


def labels(phase, part=0):
    one = np.array([0], np.uint32)
    return StepRewards(
        run_id='run',
        phase=phase,
        version=phase,
        part=part,
        parts=2,
        source='sim',
        episodes=one,
        first_steps=one,
        lengths=one + 1,
        labels=np.zeros(1, 'f4'),
    )


@pytest.mark.parametrize('late', [Transitions, CompositeReward, Commit])
@pytest.mark.parametrize('by', [4, 10, 25])
def test_labels_in_parts_hold_up_nothing_that_is_ready(late, by):
    records = []
    for r in a_run(phases=6):
        records += [r, labels(r.phase, 0), labels(r.phase, 1)] if isinstance(r, Commit) else [r]
    kinds = {type(r) for r in records} - {late}
    mixed = topic_by_topic(records, dict.fromkeys(kinds, by))
    found = [item.record for item in causal(played(mixed), 1)]
    assert len(found) == len(mixed)
    for kind in kinds | {late}:
        said, meant = ([id(r) for r in some if isinstance(r, kind)] for some in (found, mixed))
        assert said == meant, kind


def test_a_commit_that_is_missing_is_an_error_and_nothing_waits_for_it():
    records = [r for r in a_run() if not (isinstance(r, Commit) and r.phase == 1)]
    p = playback(records)
    for phase in range(3):
        p.receive(handled(phase))
    with pytest.raises(PlayError, match="transitions 8 to 11 of 'sim' are not in the bag"):
        until_it_waits(p.work())


def test_where_a_topic_is_missing_no_more_is_held_than_a_queue_has(monkeypatch):
    monkeypatch.setattr(causal_module, '_MOST_HELD', 30)
    taken = []
    records = [r for r in a_run(phases=30) if not isinstance(r, CompositeReward)]
    found = causal((taken.append(i) or i for i in played(records)), 1)
    out = list(zip(found, iter(lambda: len(taken), None), strict=False))
    assert len(out) == len(records) - 1
    said = [item.record for item, _ in out if isinstance(item.record, (Transitions, Commit))]
    assert said == [r for r in records if isinstance(r, (Transitions, Commit))]
    assert max(read - given for given, (_, read) in enumerate(out)) <= 31
    with pytest.raises(PlayError, match="composite_rewards 0 to 3 of 'sim' are not in the bag"):
        until_it_waits(playback(records).work())


class Clock:
    def __init__(self):
        self.now = 5.0

    def __call__(self):
        return self.now


def test_at_the_recorded_pace_a_message_waits_for_its_time():
    clock = Clock()
    found = [item._replace(log_time=item.log_time * 10**9) for item in played()[:3]]
    work = Playback(found, 3, 1, (), Pace(2.0, clock)).work()
    assert len(until_it_waits(work)) == 1  # the first at once
    clock.now += 0.4
    assert until_it_waits(work) == []
    clock.now += 0.2
    assert len(until_it_waits(work)) == 1  # one second of the bag in half a second
    clock.now += 0.39
    assert until_it_waits(work) == []
    clock.now += 0.02
    assert len(until_it_waits(work)) == 1


def test_after_somebody_was_waited_for_the_pace_goes_on_from_there():
    clock = Clock()
    p = Playback(
        [item._replace(log_time=item.log_time * 10**9) for item in played()],
        3, 1, ('reward',), Pace(1.0, clock),
    )  # fmt: skip
    work = p.work()
    for _ in range(100):
        clock.now += 1.0
        until_it_waits(work)
    assert p.phase == 0
    p.receive(handled(0))
    assert len(until_it_waits(work)) == 1  # and not all that would be due by now


def test_a_survey_says_what_run_a_bag_holds(tmp_path):
    bag = Bag(ours(tmp_path / 'bag', a_run()))
    found = recorded_run(bag)
    assert (found.run.run_id, found.sources, found.phases) == ('run', ('sim',), 3)
    assert found.settings == SETTINGS
    assert found.cut() is found
    data = [item.data for item in items(bag, 'run')]
    assert data == [bytes(raw.data) for raw in bag.raw()][1:]  # all but the announcement
    assert list(items(bag, 'another')) == []


def test_presence_that_another_recorder_has_recorded_is_not_played(tmp_path):
    counts = np.zeros(0, np.uint64)
    said = Presence(
        run_id='run',
        role='sim',
        node='/run/sim',
        instance_id='an instance',
        settings_hash='',
        finished=False,
        topics=(),
        published=counts,
        missed=0,
    )
    bag = Bag(ours(tmp_path / 'bag', [*a_run(), said]))
    assert not any(isinstance(item.record, Presence) for item in items(bag, 'run'))


@pytest.mark.parametrize('writer', WRITERS)
def test_bags_that_others_wrote_are_played_too(tmp_path, writer):
    records = a_run()
    bag = Bag(WRITERS[writer](tmp_path / 'bag', records))
    assert recorded_run(bag).phases == 3
    found = [item.record for item in items(bag, 'run')]
    assert len(found) == len(records) - 1 and all(map(same, found, records[1:]))


def test_a_run_that_was_stopped_is_announced_with_the_steps_that_were_committed(tmp_path):
    found = recorded_run(Bag(ours(tmp_path / 'bag', a_run(phases=2)))).cut()
    assert found.settings == SETTINGS.changed({'steps': 40})
    assert found.run.settings_hash == found.settings.hash()
    assert found.run.run_id == 'run'


def test_of_several_runs_one_must_be_chosen(tmp_path):
    bag = Bag(ours(tmp_path / 'bag', [*a_run(), *a_run(run_id='two')]))
    with pytest.raises(
        PlayError, match=r'holds 2 runs to be played \(there are: run, two\): choos'
    ):
        recorded_run(bag)
    assert recorded_run(bag, 'two').run.run_id == 'two'
    with pytest.raises(PlayError, match="holds 0 runs 'three' to be played"):
        recorded_run(bag, 'three')


def test_a_bag_without_a_commit_is_refused(tmp_path):
    records = [r for r in a_run() if not isinstance(r, Commit)]
    with pytest.raises(PlayError, match="no phase of run 'run' was committed"):
        recorded_run(Bag(ours(tmp_path / 'bag', records)))


def test_settings_that_this_version_does_not_know_are_refused(tmp_path):
    spec = replace(run(SETTINGS), settings=run(SETTINGS).settings.replace('"delay"', '"dealy"'))
    with pytest.raises(PlayError, match=r"run 'run': dealy = 5: there is no such setting"):
        recorded_run(Bag(ours(tmp_path / 'bag', [spec, *a_run()[1:]])))


def test_labels_are_played_where_their_node_is():
    none = np.zeros(0, np.uint32)
    labels = StepRewards(
        run_id='run',
        phase=1,
        version=0,
        part=0,
        parts=1,
        source='',
        episodes=none,
        first_steps=none,
        lengths=none,
        labels=np.zeros(0, np.float32),
    )
    p = playback([*a_run(phases=2), labels], phases=1)
    p.receive(handled(0))
    assert labels not in until_it_waits(p.work())
