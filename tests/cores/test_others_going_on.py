"""Simulator, recorder and evaluator that were ended go on behind what they have published."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.bags.episodes import Cuts, SourceChecks
from codetr_ros.bags.findings import Findings
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.simulator import Simulator
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import (
    INITIAL_VERSION,
    Commit,
    CompositeReward,
    EpisodeResult,
    RecordError,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.digests import digest
from helpers.builders import policy, step_rewards, task_spec, tiny
from helpers.builders import run as run_spec
from helpers.own_environments import (
    HORIZON,
    OfNumpy,
    OfPython,
    OfTorch,
    Point,
    registered,
)
from helpers.records import content
from helpers.simulating import FALLS, NEVER_ENDS, deterministic, kind, learnt, permit, simulate

PHASES = 4


def policies(task):
    later = [permit(k, 90, **learnt(task)) for k in (2, 3)] if task in (FALLS, NEVER_ENDS) else []
    return [permit(0, 90), permit(1, 90), *later, *[permit(k, 90) for k in (2, 3) if not later]]


def ended_before(settings, permits, phase, published, true=True, order=list):
    """What a simulator publishes from a phase on, given what was published before it."""
    simulator = Simulator(run_spec(settings), settings, 'sim')
    scores = sum(r.scores_due for r in kind(Transitions, published) if r.phase < phase)
    for record in order(published):
        early = getattr(record, 'phase', phase) < phase
        if isinstance(record, CompositeReward):
            early = record.sequence < scores
        if early and (true or not isinstance(record, TrueRewards)):
            simulator.restore(record)
    simulator.resume(phase)
    for each in permits:
        if each.phase >= phase:
            simulator.receive(each)
    out = []
    for records in itertools.takewhile(lambda r: r is not None, simulator.work()):
        out += records
    simulator.close()
    return simulator, out


def steps_last(published):
    """The same records in an order in which other topics have overtaken the steps."""
    return sorted(published, key=lambda record: isinstance(record, Transitions))


def check_goes_on(settings, **how):
    permits = policies(settings.task)
    published = simulate(settings, permits)
    whole = Simulator(run_spec(settings), settings, 'sim')
    for each in permits:
        whole.receive(each)
    for _ in itertools.takewhile(lambda r: r is not None, whole.work()):
        pass
    whole.close()
    for phase in range(1, PHASES):
        simulator, after = ended_before(settings, permits, phase, published, **how)
        starts = [i for i, r in enumerate(published) if getattr(r, 'phase', -1) == phase]
        expected = [published[0], *published[starts[0] :]]
        assert [content(r) for r in deterministic(after)] == [
            content(r) for r in deterministic(expected)
        ]
        assert simulator.report().counters == whole.report().counters


INEXACT = {'score_missing': 0.3, 'score_noise': 0.2}


def test_a_simulator_goes_on_whatever_topic_its_steps_were_overtaken_by():
    check_goes_on(tiny(task=FALLS), order=steps_last)


@pytest.mark.parametrize('task', [FALLS, NEVER_ENDS])
@pytest.mark.parametrize(
    'changes', [{}, INEXACT, {'delay': '3:20'}, {'delay': 'episode'}, {'score_levels': 3}]
)
def test_a_simulator_goes_on_within_its_episode_to_the_bit(task, changes):
    check_goes_on(tiny(task=task, **changes))


def test_behind_the_last_phase_it_has_finished_whether_or_not_the_learner_is_still_there():
    settings = tiny(task=FALLS)
    published = simulate(settings, policies(FALLS))
    simulator, after = ended_before(settings, [], settings.phases, published)
    assert simulator.finished and simulator.unpermitted is None
    assert [type(record) for record in after] == [TaskSpec]
    simulator, _ = ended_before(settings, [], settings.phases - 1, published)
    assert not simulator.finished and simulator.unpermitted == settings.phases - 1


def test_without_true_rewards_it_goes_on_too():
    check_goes_on(tiny(task=NEVER_ENDS), true=False)


@pytest.mark.parametrize('kind_', [OfPython, OfNumpy, OfTorch])
def test_an_environment_that_draws_from_global_generators_goes_on(kind_):
    with registered(kind_) as task:
        check_goes_on(tiny(task=task))


class DrawsFromNowhere(Point):
    """No seed reaches where it draws from."""

    made = itertools.count(1)

    def __init__(self) -> None:
        super().__init__()
        self.own = np.random.default_rng(next(self.made))

    def drift(self):
        return float(self.own.normal())


@pytest.mark.parametrize('true', [True, False])
def test_an_episode_that_cannot_be_repeated_ends_as_truncated(true, caplog):
    with registered(DrawsFromNowhere) as task:
        settings = tiny(task=task)
        permits = policies(task)
        published = simulate(settings, permits)
        simulator, after = ended_before(settings, permits, 1, published, true)
    assert 'is not deterministic: the episode ends there as truncated' in caplog.text
    assert 'sim: the environment cannot be brought back to step 40 of episode 1' in caplog.text
    counters = simulator.report().counters
    assert counters['episodes cut short, as the environment did not repeat them'] == 1
    chunk, *others = [r for r in after if not hasattr(r, 'horizon')]
    assert (chunk.episode, chunk.first_step, chunk.phase) == (2, 0, 1)
    ending = [r for r in others if getattr(r, 'episode', None) == 1]
    if true:
        cut, result = ending
        assert (cut.first_step, cut.length) == (35, 5)  # segments have 7 steps: 40 = 5 * 7 + 5
        rewards = np.concatenate([
            r.rewards for r in kind(TrueRewards, published) if r.episode == 1 and r.phase == 0
        ])  # fmt: skip
        assert cut.value == pytest.approx(rewards[35:].sum())
        assert isinstance(result, EpisodeResult)
        assert (result.length, result.terminated) == (40, False)
        assert result.true_return == pytest.approx(rewards.sum())
    else:
        assert ending == []
    check_everybody_takes(settings, published, after)


def check_everybody_takes(settings, published, after):
    """Memory, recorder and the checks of bags take what follows on an episode cut short."""
    before = [r for r in published if getattr(r, 'phase', 1) == 0]
    due = sum(r.scores_due for r in kind(Transitions, before))
    before += [r for r in kind(CompositeReward, published) if r.sequence < due]
    memory = Trajectories(2, 1, settings.delay, 10_000, 1000)
    recorder = Recorder(run_spec(settings), settings, 'record')
    recorder.receive(task_spec(observation_size=2, action_size=1, horizon=HORIZON))
    findings = Findings()
    checks = SourceChecks('sim', Cuts(settings.delay, 0), findings)
    for record in (*before, *after):
        if isinstance(record, Transitions):
            memory.append(record)
            checks.transitions(record, 'here')
        if isinstance(record, CompositeReward):
            memory.score(record)
            checks.score(record, 'here')
        if isinstance(record, (Transitions, CompositeReward)):
            recorder.receive(record)
    assert not findings.counts
    assert checks.abandoned == 1
    assert memory.steps == 4 * 90


@pytest.mark.parametrize('kept', ['first', 'all'])
def test_a_recorder_commits_from_its_first_phase_without_a_commit(kept):
    settings = tiny(task=NEVER_ENDS, record_relabels=kept)
    permits = policies(settings.task)
    published = simulate(settings, permits)
    settings = settings.changed({'steps': 360, 'phase_steps': 90, 'warmup_steps': 90})

    def recorder():
        return Recorder(run_spec(settings), settings, 'record')

    whole, said, published_labels = recorder(), [], []
    work = whole.work()
    for each in (*permits, *published):
        if isinstance(each, whole.subscribes):
            whole.receive(each)
            said.append(each)
        while (made := next(work)) is not None:
            said += made
            labels = [labels_of(made[-1])]
            whole.receive(labels[0])
            said += [whole.kept(labels[0])]
            published_labels += labels
    commits = kind(Commit, said)
    assert [c.phase for c in commits] == [0, 1, 2, 3]
    for ends in range(4):
        again = recorder()
        stops = [i for i, r in enumerate(said) if isinstance(r, Commit)][ends]
        for record in said[: stops + 1]:
            again.restore(record)
        assert again.phase == ends + 1
        work = again.work()
        given = []
        again.receive(published_labels[ends])  # a reward node publishes them again as well
        for record in said[stops + 1 :]:
            if isinstance(record, StepRewards):
                again.receive(published_labels[record.phase])
            elif isinstance(record, again.subscribes):
                again.receive(record)
            while (made := next(work)) is not None:
                given += made
        assert [content(c) for c in kind(Commit, given)] == [
            content(c) for c in commits[ends + 1 :]
        ]
    lacking = [r for r in said if not (isinstance(r, Transitions) and r.phase_end)]
    with pytest.raises(RecordError, match='is in the bag, where phase 0 is the next .*damaged'):
        restored(recorder(), lacking)
    wrong = replace(commits[0], transitions=commits[0].transitions - 1)
    said[said.index(commits[0])] = wrong
    with pytest.raises(RecordError, match='names transitions .-1., and the bag holds .0. before'):
        restored(recorder(), said)


def labels_of(committed):
    """Labels of a phase: its last segment, and once more the first one of all."""
    phase = committed.phase
    return step_rewards(
        phase=phase,
        episodes=np.array([0, phase], np.uint32),
        first_steps=np.array([0, 7], np.uint32),
        lengths=np.array([7, 7], np.uint32),
        labels=np.arange(14, dtype=np.float32) + phase,
        commit=digest(committed),
    )


def restored(recorder, held):
    for record in held:
        recorder.restore(record)


def evaluations(evaluator, permits):
    work, out = evaluator.work(), []
    for each in permits:
        evaluator.receive(each)
    while (made := next(work)) is not None:
        out += made
    return out


@pytest.mark.parametrize('known', range(7))
def test_an_evaluator_runs_only_the_episodes_that_have_no_result(known):
    settings = tiny(task=NEVER_ENDS, steps=800, evaluate_every=400, evaluate_episodes=2)
    permits = [policy(), *[permit(k, **learnt(NEVER_ENDS)) for k in range(2, 5)]]
    whole = Evaluator(run_spec(settings), settings, 'evaluate')
    results = evaluations(whole, permits)
    assert [r.version for r in results] == [INITIAL_VERSION] * 2 + [1] * 2 + [3] * 2
    again = Evaluator(run_spec(settings), settings, 'evaluate')
    for result in results[:known]:
        again.restore(result)
    assert [content(r) for r in evaluations(again, permits)] == [
        content(r) for r in results[known:]
    ]
    assert again.finished
    assert again.report().counters == whole.report().counters
