"""A run over topics ends with the very weights of the in-process run: nothing lost, reordered or
altered.
"""

import itertools
from pathlib import Path
from typing import Any

import pytest

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.config import Settings
from codetr_ros.cores import in_process
from codetr_ros.offline.replay import replay
from codetr_ros.runs.summary import Summary
from helpers.builders import tiny
from helpers.runs import asked_again, train

# Episodes of the pendulum end early and at any step; those of the reacher at 50. Segments of 7
# steps fit into neither a phase of 200 steps nor an episode of 50.
PENDULUM, REACHER = 'InvertedDoublePendulum-v5', 'Reacher-v5'
QUICKLY = (PENDULUM, 'codetr', 'overlap')
CASES = [
    *itertools.product((PENDULUM, REACHER), ('codetr', 'none'), ('lock-step', 'overlap')),
    # the other methods once each, on either task and at either pace
    (REACHER, 'rbt', 'overlap'),
    (PENDULUM, 'rrd', 'lock-step'),
    (PENDULUM, 'ircr', 'overlap'),
    (REACHER, 'mlp', 'lock-step'),
    (PENDULUM, 'uniform', 'overlap'),
    (REACHER, 'random', 'lock-step'),
    (PENDULUM, 'lrr', 'lock-step'),
    (REACHER, 'diaster', 'overlap'),
    (PENDULUM, 'mil_lstm', 'lock-step'),
    (REACHER, 'aggregate', 'overlap'),
    (REACHER, 'evidence', 'lock-step'),
    (PENDULUM, 'evidence', 'overlap'),
]


def by_calls(settings: Settings) -> dict[str, Any]:
    """The summary of a run in this process, which is not even that of `codetr train`."""
    summary = Summary(settings, 'calls', True)
    reports = in_process.run(settings, 'calls', observe=summary.receive)
    return summary.build(reports, None, False, None).model_dump(mode='json')


def check_same(topics: dict[str, Any], calls: dict[str, Any]) -> None:
    """Compare what two runs have learnt."""
    for what in (
        'policy_sha256',
        'reward_model_sha256',
        'reward_recovery',
        'evaluations',
        'random_score',
    ):
        assert topics[what] == calls[what], what
    assert topics['policy_sha256']


@pytest.mark.parametrize(
    ('task', 'method', 'pace'),
    [pytest.param(*case, marks=[pytest.mark.slow] * (case != QUICKLY)) for case in CASES],
)
def test_over_topics_and_in_process_end_with_the_same_weights(tmp_path, task, method, pace):
    # ircr's labels change now and then, and not when they are evaluated
    kept = 'all' if method == 'ircr' else 'first'
    settings = tiny(
        task=task, method=method, overlap=pace == 'overlap', delay=7, record_relabels=kept
    )
    as_users_do = (task, method, pace) == CASES[0]
    topics, _ = train(settings, tmp_path / 'topics', installed=as_users_do)
    check_same(topics, by_calls(settings))
    if (task, method, pace) == QUICKLY:
        folder = tmp_path / 'topics' / 'checkpoints'
        replayed = replay(Bag(topics['bag']), folder)
        assert replayed.first is None
        assert replayed.same['checkpoint of the learner'] == 4


@pytest.mark.slow
def test_a_transformer_above_a_regression_is_the_same_over_topics(tmp_path):
    settings = tiny(task=REACHER, method='codetr', codetr__base='evidence', delay=7)
    topics, _ = train(settings, tmp_path / 'topics')
    check_same(topics, by_calls(settings))


@pytest.mark.slow
@pytest.mark.parametrize('overlap', [False, True])
def test_two_threads_in_each_process_end_with_the_same_weights(tmp_path, two_threads, overlap):
    # wide enough for products to be divided
    wide = {'sac__hidden': (256, 256), 'sac__batch': 256, 'codetr__embedding': 64}
    settings = tiny(threads=2, overlap=overlap, sac__updates_per_step=0.1, **wide)
    topics, _ = train(settings, tmp_path / 'topics', installed=True)
    check_same(topics, by_calls(settings))


@pytest.fixture
def two_threads():
    """This process gets back the threads that it has."""
    import torch

    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_another_seed_pace_or_method_ends_with_other_weights():
    """What the equality above would miss if the digests were of something else."""
    changes = (
        {},
        {'seed': 1},
        {'overlap': True},
        {'method': 'none'},
        {'codetr.learning_rate': 2e-3},
    )
    digests = {by_calls(tiny().changed(change))['policy_sha256'] for change in changes}
    assert len(digests) == len(changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('task', 'history', 'overlap'),
    [(PENDULUM, 'singleton', True), (REACHER, 'recurrent', False)],
)
def test_a_learner_of_scores_ends_with_the_same_weights_without_a_reward_node(
    tmp_path, task, history, overlap
):
    settings = tiny(
        task=task, method='hc', delay=7, overlap=overlap, hc__history=history, hc__width=8
    )
    topics, _ = train(settings, tmp_path / 'topics')
    calls = by_calls(settings)
    check_same(topics, calls)
    assert topics['processes'].keys() - {'codetr'} == {
        'sim-sim', 'evaluate-evaluate', 'record-record', 'learner-learner',
    }  # fmt: skip
    assert topics['updates'] == calls['updates'] == 1000
    assert topics['messages']['step_rewards']['published'] == 0
    assert topics['lost'] == topics['refused'] == 0


@pytest.mark.slow
@pytest.mark.timeout(900)  # an empty cache costs half a minute of computing, twice
def test_compiled_updates_are_the_same_in_another_process(tmp_path):
    settings = tiny(sac__compile=True)
    calls = by_calls(settings)  # first: the node then finds in the cache what it needs
    # a learner that compiles all the same publishes nothing meanwhile
    topics, _ = train(settings, tmp_path / 'topics', '--peer-deadline', '300', installed=True)
    check_same(topics, calls)


@pytest.mark.slow
@pytest.mark.parametrize(
    'changes',
    [
        {'relabel_steps': 100},
        {'method': 'aggregate', 'aggregate__critic_sees_aggregate': True},
        {
            'task': PENDULUM,
            'relabel': 'drawn',
            'codetr__labelling': 'window',
            'codetr__window': 5,
            'sac__updates_per_step': 0.1,
        },
    ],
)
def test_labels_of_several_ages_are_the_same_over_topics_and_in_process(tmp_path, changes):
    settings = tiny(**changes, record_relabels='all')
    topics, _ = train(settings, tmp_path / 'topics')
    calls = by_calls(settings)
    check_same(topics, calls)
    if settings.relabel_steps:  # else the same labels are learnt from, to rounding
        assert calls['policy_sha256'] != by_calls(tiny())['policy_sha256']


@pytest.mark.slow
@pytest.mark.parametrize('method', ['evidence', 'hc'])
def test_irregular_missing_and_noisy_scores_are_the_same_over_topics_and_in_process(
    tmp_path, method
):
    settings = tiny(
        task=PENDULUM,
        method=method,
        delay='3:11',
        score_missing=0.3,
        score_noise=0.5,
        score_levels=5,
        simulators=2,
        hc__width=8,
    )
    topics, _ = train(settings, tmp_path / 'topics')
    calls = by_calls(settings)
    check_same(topics, calls)
    assert topics['lost'] == topics['refused'] == 0
    assert topics['duplicated'] == 0 or asked_again(tmp_path / 'topics')
    for name in settings.simulator_names:
        counters = topics['counters'][f'sim-{name}']
        assert 0 < counters['scores missing'] < counters['scores'] / 2
        assert counters == calls['counters'][name]
    bag = verify(Path(topics['bag']))
    assert bag.sound, bag.findings


@pytest.mark.slow
def test_two_simulators_over_topics_equal_two_in_process(tmp_path):
    settings = tiny(simulators=2, task=REACHER)
    topics, _ = train(settings, tmp_path / 'topics')
    check_same(topics, by_calls(settings))


@pytest.mark.slow
def test_several_environments_of_a_simulator_over_topics_equal_those_in_process(tmp_path):
    settings = tiny(simulators=2, envs=2, overlap=True)
    topics, _ = train(settings, tmp_path / 'topics')
    check_same(topics, by_calls(settings))
    assert topics['lost'] == topics['refused'] == 0
    assert topics['duplicated'] == 0 or asked_again(tmp_path / 'topics')
    steps = [topics['counters'][f'sim-{name}']['steps'] for name in settings.simulator_names]
    assert steps == [600, 600]
    bag = verify(Path(topics['bag']))
    assert bag.sound, bag.findings
