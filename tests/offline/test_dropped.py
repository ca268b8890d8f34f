"""Learning from a bag of a run from which a simulator was left out."""

import pytest

from codetr_ros.bags.reader import Bag
from codetr_ros.offline.cutting import stretches
from codetr_ros.offline.episodes import DROPPED, Index
from codetr_ros.offline.loading import load
from codetr_ros.offline.phases import fold
from codetr_ros.offline.replay import replay
from codetr_ros.offline.score_course import score_course
from codetr_ros.records import Commit
from helpers.leaving import bag_with_dropped_steps


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp('dropped') / 'bag'
    simulated, ended = bag_with_dropped_steps(folder)
    assert ended.failures == [] and ended.errors == {}
    reports = {name: simulated.processes[name].core.report() for name in ('reward', 'learner')}
    return Bag(folder), simulated.plan.settings, reports


def kept_steps(bag, settings):
    """Steps of all phases, without those that the commits say nobody took or learnt from."""
    commits = [entry.record for entry in bag.entries((Commit,))]
    shares = settings.shares_of(0)[0]
    return sum(shares * len(set(c.sources) - set(c.dropped)) for c in commits)


def test_a_replay_makes_the_weights_of_the_run_and_permits_whom_it_permitted(made):
    bag, settings, reports = made
    again = replay(bag)
    assert (again.first, again.phases) == (None, settings.phases)
    for name, field in (('learner', 'policy_sha256'), ('reward', 'reward_model_sha256')):
        assert getattr(again.reports[name], field) == getattr(reports[name], field)


def test_a_fit_phase_by_phase_makes_the_reward_model_of_the_run(made):
    bag, settings, reports = made
    run = replay(bag).recorded.run
    folded = fold(bag, run, settings, None)
    assert folded.phases == settings.phases
    assert folded.core.report().reward_model_sha256 == reports['reward'].reward_model_sha256


def test_a_fit_in_epochs_takes_no_step_that_was_dropped_and_counts_them(made):
    bag, settings, _ = made
    index = Index([bag]).read()
    assert index.skipped == {DROPPED: 2}
    assert index.steps == kept_steps(bag, settings)
    usable = stretches(index, index.within(settings).longest, 100).usable
    sizes = index.observation_size, index.action_size
    assert load([bag], usable, sizes, 5).memory.steps == sum(one.steps for one in usable)


def test_scores_are_those_of_the_steps_that_were_kept(made):
    course = score_course(made[0])
    assert course.unknown == 0
