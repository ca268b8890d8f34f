"""A reward model that was saved serves elsewhere, live or frozen, or is refused and told why."""

import numpy as np
import pytest
import torch

from codetr_ros.cores.labeller import Labeller
from codetr_ros.rewards import registry, saved
from codetr_ros.rewards.base import RewardModelError
from codetr_ros.runs import checkpoints
from codetr_ros.runs.checkpoints import CheckpointError
from helpers.builders import run, task_spec, tiny
from helpers.cores import Endless, slices
from helpers.saved import served, trained


def test_a_frozen_model_labels_as_it_was_saved_and_each_segment_once(tmp_path):
    before, _ = trained(tmp_path)
    core, said = served(checkpoints.latest(tmp_path, 'reward'), frozen=True, phases=4)

    digest = before.report().reward_model_sha256
    assert core.report().reward_model_sha256 == digest
    assert core.report().started_from.model_dump() == {
        'checkpoint': str(tmp_path / 'reward-000002'),
        'reward_model_sha256': digest,
        'frozen': True,
    }
    firsts = [f for parts in said for p in parts for f in p.first_steps.tolist()]
    assert len(firsts) == len(set(firsts)) > 50
    made = before.method
    memory = core._memory
    expected = np.concatenate(list(made.label_passes(memory, memory.segments.ids()[:3])))
    assert np.array_equal(said[1][0].labels[: len(expected)], expected)


@pytest.mark.parametrize('method', ['codetr', 'rbt'])
def test_a_model_of_pairs_keeps_the_order_of_its_tokens(tmp_path, method):
    """Old models, which state no order, have the state first."""
    core, _ = trained(tmp_path, method=method, **{'codetr.tokens': 'pair'})
    new, memory = core.method, core._memory
    state = new.state()
    batch = memory.segments.batch(memory.segments.ids(), new.context)
    assert state['action_first'] == 1

    old = registry.make(core._settings, memory.observation_size, memory.action_size)
    old.load_state({name: x for name, x in state.items() if name != 'action_first'})
    swapped = registry.make(core._settings, memory.observation_size, memory.action_size)
    swapped.load_state(state)
    torch.testing.assert_close(torch.tensor(swapped.label(batch)), torch.tensor(new.label(batch)))
    assert not np.allclose(old.label(batch), new.label(batch))
    again = registry.make(core._settings, memory.observation_size, memory.action_size)
    again.load_state(old.state())
    assert np.array_equal(again.label(batch), old.label(batch))


def test_a_frozen_rule_keeps_what_it_knew_of_scores(tmp_path):
    """IRCR learns extremes, not weights: it must not look at new scores either."""
    before, _ = trained(tmp_path, method='ircr')
    core, _ = served(checkpoints.latest(tmp_path, 'reward'), frozen=True, phases=5, method='ircr')
    live, _ = served(checkpoints.latest(tmp_path, 'reward'), phases=5, method='ircr')

    digests = [c.report().reward_model_sha256 for c in (before, core, live)]
    assert digests[0] == digests[1] != digests[2]


def test_a_live_model_goes_on_learning_from_where_it_was_saved(tmp_path):
    before, _ = trained(tmp_path)
    core, said = served(checkpoints.latest(tmp_path, 'reward'), phases=2)

    steps = before.report().gradient_steps
    assert steps == 7
    assert core.report().gradient_steps == steps + 5
    assert said[1][0].version == steps + 5
    assert core.method.target_scale == before.method.target_scale
    assert core.report().reward_model_sha256 != before.report().reward_model_sha256


def test_without_a_checkpoint_nothing_is_other_than_it_was(tmp_path):
    assert trained(tmp_path)[0].report().started_from is None
    with pytest.raises(RewardModelError, match='frozen = true without a checkpoint'):
        served(None, frozen=True)


@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'method': 'mlp'}, "has method = 'codetr', here 'mlp'"),
        ({'delay': 9}, 'has delay = 7, here 9'),
        ({'codetr.base': 'evidence'}, "has codetr.base = 'none', here 'evidence'"),
        ({'codetr.layers': 2}, 'has codetr.layers = 1, here 2'),
        ({'codetr.label': 'rhat'}, "has codetr.label = 'product', here 'rhat'"),
        ({'reward_unit': 'raw'}, "has reward_unit = 'scaled', here 'raw'"),
        ({'spec': task_spec(observation_size=4)}, 'has observation_size = 3, here 4'),
        ({'spec': task_spec(action_size=1)}, 'has action_size = 2, here 1'),
    ],
)
def test_a_model_of_other_sizes_settings_or_method_is_refused_naming_both(tmp_path, changes, said):
    trained(tmp_path)
    with pytest.raises(RewardModelError, match=said):
        served(checkpoints.latest(tmp_path, 'reward'), phases=0, **changes)


def test_an_aggregator_whose_numbers_are_in_units_of_another_delay_is_refused(tmp_path):
    trained(tmp_path, method='aggregate')
    with pytest.raises(RewardModelError, match='has delay = 7, here 9'):
        served(checkpoints.latest(tmp_path, 'reward'), phases=0, method='aggregate', delay=9)


def test_how_it_was_trained_may_differ_and_another_task_is_warned_of(tmp_path, caplog):
    trained(tmp_path)
    changes = {'codetr.learning_rate': 0.5, 'codetr.batch': 3, 'seed': 9, 'task': 'Swimmer-v5'}
    served(checkpoints.latest(tmp_path, 'reward'), phases=1, composite='max', **changes)

    assert "is of composite 'sum', here it is 'max': do they mean the same?" in caplog.text
    assert "is of task 'a task', here it is 'Swimmer-v5'" in caplog.text


def test_the_folder_of_a_run_stands_for_its_newest_checkpoint(tmp_path):
    trained(tmp_path / 'checkpoints')
    assert saved.read(tmp_path).path == tmp_path / 'checkpoints' / 'reward-000002'


def test_what_is_no_checkpoint_of_a_reward_model_is_refused(tmp_path):
    with pytest.raises(
        CheckpointError, match='is no checkpoint .*and no folder of a fit or a run'
    ):
        saved.read(tmp_path)
    path = checkpoints.save(tmp_path, 'other', 0, {}, {'task': 'x'})
    with pytest.raises(CheckpointError, match="lacks 'settings': it is not that of a reward"):
        saved.read(path)


def test_a_model_that_was_saved_before_anything_was_scored_knows_nothing(tmp_path):
    settings = tiny()
    core = Labeller(run(settings), settings, 'reward', tmp_path)
    core.receive(task_spec())
    episode, work = Endless(settings), core.work()
    for phase in range(2):
        episode.phase(core, phase, scored=False)
        slices(work)
    with pytest.raises(RewardModelError, match='saved before anything was scored'):
        served(checkpoints.latest(tmp_path, 'reward'), phases=1)
