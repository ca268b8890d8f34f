"""A robot at a free pace: commits decide what is learnt, and from them it is learnt anew."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from codetr_ros import cli
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.cli import results
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.offline.replay import replay
from codetr_ros.offline.robot_report import faults, robot_page
from codetr_ros.offline.score_course import score_course
from codetr_ros.records import Commit, CompositeReward, Policy, RunSpec, StepRewards, Transitions
from codetr_ros.runs.reports import NodeReport
from codetr_ros.runs.summary import Summary
from helpers.builders import run
from helpers.foreign_bags import write
from helpers.free_runs import FreeRun, free_run


@pytest.fixture(scope='module')
def a_free_run() -> FreeRun:
    return free_run()


def of(made: FreeRun, kind: type) -> list:
    return [record for record in made.records if isinstance(record, kind)]


def test_the_robot_goes_on_while_the_learner_learns(a_free_run):
    """Steps of later phases were published before the policy of earlier ones."""
    phases, learnt = [], -1
    for record in a_free_run.records:
        if isinstance(record, Policy):
            learnt = max(learnt, record.version)
        elif isinstance(record, Transitions):
            phases.append(record.phase - learnt)
    assert max(phases) >= 3
    assert a_free_run.robot.report().counters['policies used'] > 3


def test_scores_that_come_late_join_a_later_commit_and_none_is_lost(a_free_run):
    counts = [commit.scores.sum() + len(commit.scores) for commit in of(a_free_run, Commit)]
    assert counts == sorted(counts)
    scores = {score.sequence: score for score in of(a_free_run, CompositeReward)}
    ends = {}
    for chunk in of(a_free_run, Transitions):
        ends[chunk.episode] = max(ends.get(chunk.episode, 0), chunk.phase)
    late = 0
    for commit, (first, end) in zip(
        of(a_free_run, Commit), itertools.pairwise([0, *counts]), strict=True
    ):
        late += sum(ends[scores[n].episode] < commit.phase for n in range(first, int(end)))
    assert late > 5
    assert a_free_run.labeller.report().refused == {}


def test_the_bag_of_a_free_run_teaches_the_reward_model_the_same_weights(a_free_run, tmp_path):
    bag = write(tmp_path / 'bag', a_free_run.records)
    assert cli.main(
        ['fit', str(bag), '--out', str(tmp_path / 'out'), '--schedule', 'phases']
    ) == 0  # fmt: skip
    said = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    report = a_free_run.labeller.report()
    assert said['reward_model_sha256'] == report.reward_model_sha256
    assert said['recorded_labels']['same'] > 0
    assert said['recorded_labels']['other'] == 0
    found = verify(bag)
    assert found.sound, found.findings.named


def learnt_again(bag: Bag, made: FreeRun) -> Learner:
    """Let a reward side and a learner learn from a bag alone."""
    spec = run(made.settings)
    sides = [
        Labeller(spec, made.settings, 'reward', None),
        Learner(spec, made.settings, 'l', None),
    ]
    works = [side.work() for side in sides]
    for entry in bag.entries():
        wanted = entry.kind not in (RunSpec, StepRewards)  # labels are made anew
        for side in sides:
            if wanted and entry.kind in side.subscribes:
                side.receive(entry.record)
        if isinstance(entry.record, Commit):
            while (given := next(works[0])) is not None:
                for record in given:
                    if type(record) in sides[1].subscribes:
                        sides[1].receive(record)
            while next(works[1]) is not None:
                pass
    return sides[1]


def test_the_bag_of_a_free_run_teaches_the_learner_the_same_weights(a_free_run, tmp_path):
    bag = Bag(write(tmp_path / 'bag', a_free_run.records))
    again = learnt_again(bag, a_free_run)
    assert again.report().policy_sha256 == a_free_run.learner.report().policy_sha256
    assert again.report().updates == a_free_run.learner.report().updates > 0


@pytest.mark.slow
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_however_slow_the_learner_and_whenever_scores_come_the_bag_teaches_the_same(
    seed: int, tmp_path: Path
):
    made = free_run(seed, slowest=400, method='codetr')
    again = learnt_again(Bag(write(tmp_path / 'bag', made.records)), made)
    assert again.report().policy_sha256 == made.learner.report().policy_sha256


def test_the_course_of_scores_is_that_of_the_segments_by_phase(a_free_run, tmp_path):
    course = score_course(Bag(write(tmp_path / 'bag', a_free_run.records)))
    scores = of(a_free_run, CompositeReward)
    assert course.mean(0, 100)[2] == len(scores)
    assert course.mean(0, 100)[0] == pytest.approx(np.mean([s.value / s.length for s in scores]))
    assert course.to_csv().splitlines()[0] == 'phase,scores,score per step'
    assert np.isnan(course.mean(50, 60)[0])


def test_the_page_on_a_robot_shows_scores_control_and_faults(a_free_run, tmp_path):
    log = tmp_path / 'truth.jsonl'
    log.write_text('{"time": 1, "fault": "joint stuck"}\n{"time": 2, "attempt": [0.5]}\n')
    course = score_course(Bag(write(tmp_path / 'bag', a_free_run.records)))
    report = NodeReport(role='sim', name='robot', counters={'control deadlines missed': 3})
    page = robot_page('a <robot>', course, {'score': '0.5'}, 2, report, faults(log))
    assert 'a &lt;robot&gt;' in page and 'joint stuck' in page and 'data:image/png' in page
    assert 'control deadlines missed' in page and 'attempt' not in page
    assert 'left no report' in robot_page('r', course, {}, 2, None, {})


def test_labels_that_the_bag_has_phases_later_are_compared_when_it_is_replayed(
    a_free_run, tmp_path
):
    """A recorder that was killed asks for them once more; the robot goes on meanwhile."""
    records: list = []
    later: list = []
    for record in a_free_run.records:
        if isinstance(record, StepRewards):
            later.append(record)
            continue
        records.append(record)
        if isinstance(record, Commit):
            due = [each for each in later if each.phase <= record.phase - 4]
            records += due
            later = [each for each in later if each.phase > record.phase - 4]
    bag = write(tmp_path / 'bag', records + later)
    made = replay(Bag(bag))
    assert made.same['labels'] > 0
    assert not made.differences


def test_the_summary_of_such_a_run_has_the_scores_by_phase_and_asks_for_no_true_rewards(
    a_free_run, tmp_path
):
    bag = write(tmp_path / 'bag', a_free_run.records)
    logged: list[str] = []
    made = Summary(a_free_run.settings, 'run', in_process=False)
    results.complete(made, bag, logged.append)
    assert logged == []
    assert sum(row.scores for row in made.scores_given) == len(of(a_free_run, CompositeReward))
    assert [row.random for row in made.scores_given[:3]] == [True, True, False]
