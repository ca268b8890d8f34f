"""A run over topics ends with the very weights of the in-process run: nothing lost, reordered or
altered.
"""

import pytest
from builders import tiny
from system.runs import train

# Episodes of the pendulum end early and at any step; those of the reacher at 50. Segments of 7
# steps fit into neither a phase of 200 steps nor an episode of 50.
TASKS = ('InvertedDoublePendulum-v5', 'Reacher-v5')


@pytest.mark.parametrize('overlap', [False, True], ids=['lock-step', 'overlap'])
@pytest.mark.parametrize('method', ['codetr', 'none'])
@pytest.mark.parametrize('task', TASKS)
def test_over_topics_and_in_process_end_with_the_same_weights(tmp_path, task, method, overlap):
    settings = tiny(task=task, method=method, overlap=overlap, delay=7)
    topics, _ = train(settings, tmp_path / 'topics')
    calls, _ = train(settings, tmp_path / 'calls', '--in-process')
    assert topics['policy_sha256'] == calls['policy_sha256']
    assert topics['reward_model_sha256'] == calls['reward_model_sha256']
    assert topics['evaluations'] == calls['evaluations']
    assert topics['random_score'] == calls['random_score']


def test_another_seed_pace_or_method_ends_with_other_weights(tmp_path):
    """What the equality above would miss if the digests were of something else."""
    changes = (
        {},
        {'seed': 1},
        {'overlap': True},
        {'method': 'none'},
        {'codetr.learning_rate': 2e-3},
    )
    digests = set()
    for i, change in enumerate(changes):
        settings = tiny().changed(change)
        summary, _ = train(settings, tmp_path / str(i), '--in-process')
        digests.add(summary['policy_sha256'])
    assert len(digests) == len(changes)


def test_two_simulators_over_topics_equal_two_in_process(tmp_path):
    settings = tiny(simulators=2, task='Reacher-v5')
    topics, _ = train(settings, tmp_path / 'topics')
    calls, _ = train(settings, tmp_path / 'calls', '--in-process')
    assert topics['policy_sha256'] == calls['policy_sha256']
    assert topics['reward_model_sha256'] == calls['reward_model_sha256']
