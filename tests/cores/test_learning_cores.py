"""Learner and reward side of Algorithm 1: what they wait for, what they refuse, what they say."""

import numpy as np
import pytest

from codetr_ros.cores import in_process
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.learners.base import LearnerError
from codetr_ros.records import (
    MESSAGE_BYTES,
    Metrics,
    Policy,
    RecordError,
    StepRewards,
    TrueRewards,
)
from helpers.builders import run, step_rewards, task_spec, tiny
from helpers.cores import Endless, slices


def labeller(**changes):
    settings = tiny(**changes)
    core = Labeller(run(settings), settings, 'reward', None)
    core.receive(task_spec())
    return core, settings


def test_labels_come_after_the_warm_up_and_cover_every_scored_segment():
    core, settings = labeller()
    episode = Endless(settings)
    work = core.work()
    episode.phase(core, 0)
    (said,) = slices(work)  # that it has taken the phase in
    assert isinstance(said, Metrics) and said.phase == 0
    episode.phase(core, 1)
    parts = [r for r in slices(work) if isinstance(r, StepRewards)]
    assert [p.part for p in parts] == list(range(parts[0].parts))
    firsts = np.concatenate([p.first_steps for p in parts])
    assert firsts.tolist() == list(range(0, 400 - 400 % 7, 7))
    assert all(np.isfinite(p.labels).all() for p in parts)


def test_a_frozen_method_sends_each_label_once_and_an_empty_part_where_none_is_new():
    core, settings = labeller(method='uniform')
    episode = Endless(settings)
    work = core.work()
    episode.phase(core, 0)
    slices(work)
    episode.phase(core, 1)
    (first,) = [r for r in slices(work) if isinstance(r, StepRewards)]
    episode.phase(core, 2)
    (second,) = [r for r in slices(work) if isinstance(r, StepRewards)]
    assert set(first.first_steps.tolist()).isdisjoint(second.first_steps.tolist())
    np.testing.assert_allclose(first.labels[:7], 0.0)  # the first segment's score is 0
    assert (second.part, second.parts, len(second.lengths)) == (0, 1, (600 // 7) - (400 // 7))


@pytest.mark.parametrize('most', [1, 60, 10_000])
def test_as_many_steps_as_asked_for_are_labelled_again_in_turn_oldest_first(most):
    core, settings = labeller(relabel_steps=most, memory_steps=10_000)
    episode = Endless(settings)
    work = core.work()
    episode.phase(core, 0)
    labelled_at: dict[int, int] = {}  # first step -> gradient steps at its newest label
    for phase in range(1, 5):
        episode.phase(core, phase)
        said = slices(work)
        parts = [r for r in said if isinstance(r, StepRewards)]
        (version,) = {p.version for p in parts}
        done = np.concatenate([p.first_steps for p in parts]).tolist()
        ended = set(range(0, (phase + 1) * 200 - 6, 7))
        new, again = ended - labelled_at.keys(), set(done) & labelled_at.keys()
        # whole segments of 7 steps within what is asked for, one at least
        assert len(again) == min(len(labelled_at), max(1, most // 7)) and new <= set(done)
        turn = sorted(labelled_at, key=lambda first: (labelled_at[first], first))
        assert again == set(turn[: len(again)])
        labelled_at |= dict.fromkeys(done, version)
        (metrics,) = [r for r in said if isinstance(r, Metrics) and 'label_age_max' in r.names]
        values = dict(zip(metrics.names, metrics.values, strict=True))
        ages = [version - then for then in labelled_at.values()]
        assert values['label_age_max'] == max(ages)
        assert values['label_age_mean'] == pytest.approx(np.mean(ages))
        assert values['steps_labelled'] == 7 * len(done)


def test_labels_of_a_model_that_learns_are_all_of_its_newest_version_unless_asked_otherwise():
    core, settings = labeller()
    episode = Endless(settings)
    work = core.work()
    said = []
    for phase in range(3):
        episode.phase(core, phase)
        said += slices(work)
    ages = [
        dict(zip(r.names, r.values, strict=True))['label_age_max']
        for r in said
        if isinstance(r, Metrics) and 'label_age_max' in r.names
    ]
    assert ages == [0.0, 0.0]


def test_a_warm_up_without_scores_delays_the_fit_and_freezes_no_scale():
    core, settings = labeller()
    episode = Endless(settings)
    work = core.work()
    said = []
    for phase in range(2):
        episode.phase(core, phase, scored=False)
        said += slices(work)
    (part,) = [r for r in said if isinstance(r, StepRewards)]
    assert (part.parts, len(part.labels)) == (1, 0)
    (metrics,) = [r for r in said if isinstance(r, Metrics) and r.phase == 1]
    values = dict(zip(metrics.names, metrics.values, strict=True))
    assert values['target_scale'] == 0 and values['gradient_steps'] == 0
    assert core.report().counters == {'gradient steps skipped, nothing scored': 5}


def test_labels_travel_in_parts_well_below_the_shared_memory_segment():
    settings = tiny(
        method='uniform',
        steps=60_000,
        phase_steps=30_000,
        warmup_steps=30_000,
        delay=1,
        memory_steps=100_000,
    )
    core = Labeller(run(settings), settings, 'reward', None)
    core.receive(task_spec(horizon=100_000))
    work = core.work()
    Endless(settings).phase(core, 0)
    parts = [r for r in slices(work) if isinstance(r, StepRewards)]
    assert len(parts) == 3 and sum(len(p.labels) for p in parts) == 30_000
    assert all(p.labels.nbytes + 3 * p.lengths.nbytes <= MESSAGE_BYTES for p in parts)


def learner(**changes):
    settings = tiny(**changes)
    core = Learner(run(settings), settings, 'learner', None)
    core.receive(task_spec())
    return core, settings


def test_the_learner_permits_one_phase_in_lock_step_and_two_with_overlap():
    for overlap, phases in ((False, [0]), (True, [0, 1])):
        core, _ = learner(overlap=overlap)
        permitted = slices(core.work())
        assert [p.phase for p in permitted] == phases
        assert all(p.random and p.version == -1 and p.weights == b'' for p in permitted)


def test_the_learner_waits_for_all_parts_of_the_labels_before_it_learns():
    core, settings = learner()
    episode = Endless(settings)
    work = core.work()
    slices(work)
    episode.phase(core, 0)
    permitted = [r for r in slices(work) if isinstance(r, Policy)]
    assert [p.phase for p in permitted] == [1]
    episode.phase(core, 1)
    made_of = {'phase': 1, 'parts': 2, 'commit': episode.commits[1]}
    core.receive(step_rewards(part=1, **made_of))
    assert slices(work) == [] and core.report().updates == 0
    assert core.waiting_for() == 'labels of phase 1 from the reward node'
    core.receive(step_rewards(part=0, first_steps=np.array([7], np.uint32), **made_of))
    said = slices(work)
    (permit,) = [r for r in said if isinstance(r, Policy)]
    assert (permit.phase, permit.version, permit.random) == (2, 1, False)
    assert core.report().updates == settings.phase_steps
    (metrics,) = [r for r in said if isinstance(r, Metrics)]
    assert dict(zip(metrics.names, metrics.values, strict=True))['labelled_steps'] == 10


def test_labels_that_come_again_while_the_learner_learns_from_them_are_counted_and_dropped():
    settings = tiny(method='uniform')
    core = Learner(run(settings), settings, 'learner', None)
    core.receive(task_spec())
    episode = Endless(settings)
    work = core.work()
    for phase in range(2):
        slices(work)
        episode.phase(core, phase)
    slices(work)
    labels = step_rewards(phase=1, parts=1, commit=episode.commits[1])
    core.receive(labels)
    assert next(work) == []  # the first burst of updates
    core.receive(labels)
    assert core.duplicated == {'step_rewards': 1}
    assert core._labels._held == {}  # nothing is held for ever


def test_nothing_is_learnt_while_nothing_is_labelled_and_that_is_counted():
    core, settings = learner()
    episode = Endless(settings)
    work = core.work()
    for phase in range(2):
        slices(work)
        episode.phase(core, phase)
    slices(work)
    empty = np.empty(0, np.uint32)
    core.receive(
        step_rewards(
            phase=1,
            source='',
            episodes=empty,
            first_steps=empty,
            lengths=empty,
            labels=np.empty(0, np.float32),
            commit=episode.commits[1],
        )
    )
    slices(work)
    assert core.report().counters['updates skipped, nothing labelled'] == 200


@pytest.mark.parametrize(
    ('wrong', 'said'),
    [
        (step_rewards(run_id='other'), "of run 'other'"),
        (step_rewards(labels=np.ones(4, np.float32)), '4 labels for segments of 5 steps'),
        (step_rewards(part=2, parts=2), 'part 2 of 2'),
        (step_rewards(labels=np.full(5, np.nan, np.float32)), r'labels\[0\] is not finite'),
    ],
)
def test_the_learner_refuses_labels_that_cannot_be(wrong, said):
    core, _ = learner()
    with pytest.raises(RecordError, match=said):
        core.receive(wrong)


def test_true_rewards_reach_neither_side_unless_the_method_is_the_oracle():
    for method in ('codetr', 'none', 'uniform'):
        settings = tiny(method=method)
        assert TrueRewards not in Labeller(run(settings), settings, 'reward', None).subscribes
        assert TrueRewards not in Learner(run(settings), settings, 'learner', None).subscribes
    settings = tiny(method='true')
    assert TrueRewards in Labeller(run(settings), settings, 'reward', None).subscribes


def test_simulators_share_the_steps_of_a_phase():
    settings = tiny(simulators=3)
    core = Learner(run(settings), settings, 'learner', None)
    for source in ('c', 'a', 'b'):
        core.receive(task_spec(source=source))
    (permit,) = slices(core.work())
    assert permit.sources == ('a', 'b', 'c') and permit.steps.tolist() == [67, 67, 66]


def test_memory_and_updates_of_a_run_add_up():
    settings = tiny(method='uniform')
    seen = []
    reports = in_process.run(settings, 'run', observe=seen.append)
    learning = settings.phases - settings.warmup_phases + 1
    assert reports['learner'].updates == learning * settings.phase_steps
    assert reports['learner'].memory.steps <= settings.memory_steps
    versions = [r.version for r in seen if isinstance(r, Policy)]
    assert versions == [-1, *range(settings.phases)]
    assert [r.steps.sum() for r in seen if isinstance(r, Policy)] == [200] * 6 + [0]
    networks = {r.network for r in seen if isinstance(r, Policy) and not r.random}
    assert len(networks) == 1 and '"hidden":[16,16]' in networks.pop()


def test_what_raises_while_watching_ends_the_run_with_reports(tmp_path):
    def observe(record):
        if isinstance(record, Metrics) and record.phase == 3 and record.role == 'learner':
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_process.run(tiny(), 'run', tmp_path, observe)
    assert (tmp_path / 'nodes' / 'learner-learner.json').is_file()
    assert list((tmp_path / 'checkpoints').glob('learner-*'))


@pytest.mark.slow
def test_the_oracle_learns_from_the_true_rewards_and_only_it():
    """The digest of a run with the oracle changes with the true rewards' unit, as it must."""
    digests = {
        unit: in_process.run(tiny(method='true', reward_unit=unit), 'run')['learner'].policy_sha256
        for unit in ('raw', 'scaled')
    }
    assert digests['raw'] != digests['scaled']


def test_a_policy_that_has_diverged_ends_the_run_and_says_what_to_do():
    """Weights that are not finite would be refused by every simulator, which would then wait."""
    core, settings = learner()
    episode = Endless(settings)
    work = core.work()
    slices(work)
    for phase in range(2):
        episode.phase(core, phase)
        slices(work)
    labels = np.full(5, 3e38, np.float32)
    core.receive(step_rewards(phase=1, labels=labels, commit=episode.commits[1]))
    said = 'not finite after phase 1 .*Lower sac.actor_learning_rate'
    with pytest.raises(LearnerError, match=said):
        slices(work)


def test_no_first_gradient_steps_still_means_gradient_steps_later():
    settings = tiny(codetr__first_gradient_steps=0)
    reports = in_process.run(settings, 'run')
    later = settings.phases - settings.warmup_phases
    assert reports['reward'].gradient_steps == later * settings.codetr.gradient_steps


def test_window_labelling_gives_every_step_a_label_in_the_place_it_belongs():
    settings = tiny(codetr__labelling='window', codetr__window=5, codetr__label_batch=16)
    seen = []
    in_process.run(settings, 'run', observe=seen.append)
    for record in seen:
        if isinstance(record, StepRewards):
            assert len(record.labels) == record.lengths.sum() and np.isfinite(record.labels).all()
    assert sum(isinstance(record, StepRewards) for record in seen) >= 5


def test_a_committed_phase_that_a_core_has_still_to_permit_is_not_missing():
    """The core learns again: it asks for one phase after the other, as it can take them in."""
    settings = tiny()
    core = Learner(run(settings), settings, 'learner', None)
    core.receive(task_spec())
    core.catch_up(9)
    episode, work = Endless(settings), core.work()
    slices(work)  # permits the first phase
    asked = []
    for phase in range(2):
        asked.append((core.missing, core.unlabelled))
        episode.phase(core, phase)
        slices(work)
    assert asked == [(0, None), (1, None)]
    assert (core.due, core.permitted) == (2, 1)
    assert (core.missing, core.uncommitted, core.unlabelled) == (None, None, 1)
    core.receive(step_rewards(phase=1, commit=episode.commits[1]))
    slices(work)
    assert (core.missing, core.permitted) == (2, 2)
