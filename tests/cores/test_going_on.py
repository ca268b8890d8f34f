"""Learner and reward side that were ended go on from a checkpoint and the records of the run."""

import pytest

from codetr_ros.config import IN_PROCESS_ONLY, settled
from codetr_ros.cores import in_process
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.records import Commit, Metrics, Policy, StepRewards
from codetr_ros.rewards.registry import METHODS
from codetr_ros.runs import checkpoints
from codetr_ros.runs.checkpoints import CheckpointError
from helpers.builders import tiny
from helpers.cores import slices
from helpers.records import content

FROM = 2  # the phase of the checkpoint: the oldest of the three that are kept of five


def recorded(settings, folder):
    """The records of a whole run, and the reports of its parts."""
    records = []
    return records, in_process.run(settings, 'run', folder, records.append)


def fed(core, records, labels=()):
    """All that a core yields that is fed the records of a run, each commit's at a time."""
    given = []
    work = core.work()
    kinds = (*core.subscribes, Commit)
    for record in records:
        if isinstance(record, StepRewards) or not isinstance(record, kinds):
            continue
        core.receive(record)
        if isinstance(record, Commit):
            for part in labels:
                if part.phase == record.phase and part.phase > FROM:
                    core.receive(part)
            given += slices(work)
    return given


def after(records, role, kinds, phase):
    """What a side published in a run from the end of a phase on."""
    at = next(
        i
        for i, r in enumerate(records)
        if isinstance(r, Metrics) and r.role == role and r.phase == phase
    )
    while at and isinstance(records[at - 1], kinds) and not isinstance(records[at - 1], Metrics):
        at -= 1
    return [
        content(r)
        for r in records[at:]
        if isinstance(r, kinds) and not (isinstance(r, Metrics) and r.role != role)
    ]


def check_both_sides(settings, folder, run_id='run'):
    """Both sides end as in the undisturbed run, and publish the same after the checkpoint."""
    settings = settled(settings)
    records, reports = recorded(settings, folder)
    spec = settings.run_spec(run_id)
    where = folder / 'checkpoints'
    labels = [r for r in records if isinstance(r, StepRewards)]
    if settings.labels_steps:
        reward = Labeller(spec, settings, 'reward', where)
        assert reward.resume(FROM) == FROM
        given = fed(reward, records)
        assert [content(r) for r in given] == after(
            records, 'reward', (StepRewards, Metrics), FROM
        )
        assert reward.report().model_dump() == {
            name: value
            for name, value in reports['reward'].model_dump().items()
            if name in reward.report().model_dump()
        }
    learner = Learner(spec, settings, 'learner', where)
    assert learner.resume(FROM) == FROM
    given = fed(learner, records, labels)
    assert [content(r) for r in given] == after(records, 'learner', (Policy, Metrics), FROM)
    ended = reports['learner'].model_dump()
    assert all(ended[n] == value for n, value in learner.report().model_dump().items())
    assert learner.finished


PLAIN = [name for name in METHODS if name not in IN_PROCESS_ONLY]
CASES = {
    **{name: {'method': name} for name in (*PLAIN, 'hc', 'lirpg', 'true')},
    'codetr above evidence': {'codetr__base': 'evidence', 'codetr__gradient_steps': 10},
    'codetr above evidence, verdicts': {
        'codetr__base': 'evidence', 'codetr__gradient_steps': 10,
        'score_levels': 3, 'evidence__score_scale': 'ordinal',
    },
    'a link that is chosen': {
        'method': 'evidence', 'evidence__link': 'choose', 'composite': 'max',
    },
    'overlap, two simulators': {'overlap': True, 'simulators': 2, 'memory_steps': 600},
    'windows, only what is drawn': {'codetr__labelling': 'window', 'relabel': 'drawn'},
    'the oldest labels': {'relabel_steps': 50, 'memory_steps': 500},
    'scores that are missing, segments of any length': {'score_missing': 0.3, 'delay': '3:9'},
}  # fmt: skip


@pytest.mark.parametrize('case', CASES)
def test_both_sides_go_on_to_the_bit(case, tmp_path):
    quick = {'steps': 1000, 'evaluate_every': 0, 'sac__updates_per_step': 0.1}
    check_both_sides(tiny(**(quick | CASES[case])), tmp_path)


def saved(tmp_path, **changes):
    settings = settled(tiny(method='uniform', evaluate_every=0, sac__updates_per_step=0.01))
    recorded(settings, tmp_path)
    return settings.changed(changes), tmp_path / 'checkpoints'


def side(settings, where, run_id='run'):
    return Labeller(settings.run_spec(run_id), settings, 'reward', where)


def test_a_damaged_checkpoint_is_logged_and_the_one_before_it_taken(tmp_path, caplog):
    settings, where = saved(tmp_path)
    tensors = where / 'reward-000005' / checkpoints.TENSORS
    tensors.write_bytes(tensors.read_bytes()[:-1])
    assert side(settings, where).resume() == 4
    assert 'reward-000005/tensors.safetensors is damaged: sha256 is' in caplog.text
    assert 'removed' in caplog.text
    assert sorted(path.name for path in where.glob('reward-*')) == [
        'reward-000003', 'reward-000004',
    ]  # fmt: skip


def test_without_a_sound_checkpoint_everything_is_learnt_again(tmp_path):
    settings, where = saved(tmp_path)
    assert side(settings, where).resume(2) == -1
    assert not list(where.glob('reward-*'))
    assert side(settings, where).resume() == -1
    assert side(settings, None).resume() == -1


def test_a_run_goes_on_with_its_own_settings_and_id_only(tmp_path):
    settings, where = saved(tmp_path)
    for changed, names in (({'seed': 7}, 'seed = 0 .here 7.'), ({'delay': 8}, 'delay = 7')):
        with pytest.raises(CheckpointError, match=f'{names}.*only steps may change'):
            side(settings.changed(changed), where).resume()
    with pytest.raises(CheckpointError, match="of run 'run', this is run 'other'"):
        side(settings, where, 'other').resume()
    assert side(settings.changed({'steps': 2000}), where).resume() == 5


def test_a_checkpoint_of_an_older_version_is_refused_with_the_remedy(tmp_path):
    settings, where = saved(tmp_path)
    newest = checkpoints.latest(where, 'reward')
    tensors, meta = checkpoints.load(newest)
    del meta['going_on']
    checkpoints.save(where, 'reward', 5, tensors, meta)
    with pytest.raises(CheckpointError, match='from whose checkpoints no run can go on: start'):
        side(settings, where).resume()
