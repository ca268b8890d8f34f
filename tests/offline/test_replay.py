"""A recorded run derives its own weights again, and the first phase that differs is named."""

import json
from dataclasses import replace

import numpy as np
import pytest

from codetr_ros import cli
from codetr_ros.bags.reader import Bag
from codetr_ros.config import settled
from codetr_ros.cores import in_process
from codetr_ros.offline.replay import replay
from codetr_ros.records import CompositeReward, Policy, StepRewards
from codetr_ros.runs import checkpoints, origin
from codetr_ros.runs import folder as run_folder
from helpers.builders import tiny
from helpers.foreign_bags import write

SETTINGS = settled(
    tiny(steps=1000, sac__updates_per_step=0.05, evaluate_every=400, threads=1, method='mlp')
)


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """The folder of a run in process, its records and its reports."""
    folder = tmp_path_factory.mktemp('run')
    run_folder.write_settings(folder, SETTINGS)
    made = origin.origin(SETTINGS, 'run', '/run_run', True, True, 'codetr train')
    origin.write(folder, made)
    records = []
    reports = in_process.run(SETTINGS, 'run', folder, records.append, bag=True)
    return folder, records, reports


def test_a_run_derives_its_own_weights_again(run):
    folder, _, reports = run
    replayed = replay(Bag(folder / 'bag'), folder / 'checkpoints')
    assert replayed.first is None
    assert replayed.reports['learner'].policy_sha256 == reports['learner'].policy_sha256
    assert replayed.same['policy'] == 4  # versions 1 to 4
    assert replayed.same['checkpoint of the learner'] == 3
    assert replayed.same['checkpoint of the reward'] == 3
    assert replayed.same['labels'] > 100


@pytest.mark.parametrize('method', ['hc', 'lirpg', 'true'])
def test_so_do_runs_of_methods_that_differ(method, tmp_path):
    settings = SETTINGS.changed({'method': method})
    reports = in_process.run(settings, 'run', tmp_path, bag=True)
    replayed = replay(Bag(tmp_path / 'bag'))
    assert replayed.first is None
    assert replayed.same['policy'] == 4
    assert replayed.reports['learner'].policy_sha256 == reports['learner'].policy_sha256


def changed(records, kind, which, **changes):
    """The records with the first of a kind changed for which something holds."""
    at = next(i for i, r in enumerate(records) if isinstance(r, kind) and which(r))
    new = {name: change(getattr(records[at], name)) for name, change in changes.items()}
    return [*records[:at], replace(records[at], **new), *records[at + 1 :]]


def flipped(weights: bytes) -> bytes:
    return weights[:-1] + bytes([weights[-1] ^ 1])


CHANGES = {
    'a bit of a policy': (3, 'policy', Policy, lambda r: r.version == 3, {'weights': flipped}),
    'a bit of a label': (
        2, 'labels', StepRewards, lambda r: r.phase == 2 and len(r.labels),
        {'labels': lambda labels: np.nextafter(labels, np.float32(9))},
    ),
}  # fmt: skip


@pytest.mark.parametrize('what', CHANGES)
def test_the_first_phase_that_differs_is_named(what, run, tmp_path):
    phase, kind, record_kind, which, change = CHANGES[what]
    bag = write(tmp_path / 'bag', changed(run[1], record_kind, which, **change))
    replayed = replay(Bag(bag))
    assert (replayed.first.phase, replayed.first.what) == (phase, kind)
    assert str(replayed.first).startswith(f'phase {phase}: {kind} made here: ')


def test_a_run_whose_weights_come_out_otherwise_names_their_first_phase(run, tmp_path):
    """As on a machine with other last bits: here with another learning rate."""
    other = SETTINGS.changed({'sac.actor_learning_rate': 0.02}).run_spec('run')
    replayed = replay(Bag(write(tmp_path / 'bag', [other, *run[1][1:]])))
    assert (replayed.first.phase, replayed.first.what) == (1, 'policy')
    assert any('the policy that permitted phase 2' in what for what in replayed.differences)


def test_a_score_that_is_not_the_commits_is_named_too(run, tmp_path):
    records = changed(run[1], CompositeReward, lambda r: r.sequence == 3, value=lambda v: v + 0.5)
    replayed = replay(Bag(write(tmp_path / 'bag', records)))
    assert replayed.first.phase == 0
    assert "commit, composite_rewards 0 to 35 of 'sim' have the digest" in str(replayed.first)


def test_the_command_prints_where_the_run_was_made_and_what_it_compared(run, capsys):
    folder, _, reports = run
    assert cli.main(['replay', str(folder), '--verify']) == 0
    printed = capsys.readouterr().out
    assert f'made on {origin.read(folder).host} (' in printed
    assert ', 1 threads, codetr_ros ' in printed
    assert f'policy_sha256        {reports["learner"].policy_sha256}' in printed
    assert 'every phase leads to the same' in printed


def test_the_command_names_a_checkpoint_that_is_not_that_of_the_bag(run, tmp_path, capsys):
    folder, _, _ = run
    for name in ('config.yaml', 'run.json'):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / 'bag').symlink_to(folder / 'bag')
    tensors, meta = checkpoints.load(folder / 'checkpoints' / 'learner-000003')
    tensors['actor.heads.weight'] = tensors['actor.heads.weight'] + 1
    checkpoints.save(tmp_path / 'checkpoints', 'learner', 3, tensors, meta)
    made = json.loads((tmp_path / 'run.json').read_text())
    made['versions']['torch'] = '1.0'
    (tmp_path / 'run.json').write_text(json.dumps(made))
    assert cli.main(['replay', str(tmp_path), '--verify']) == 1
    printed = capsys.readouterr().out
    assert 'phase 3 is the first that differs' in printed
    assert 'phase 3: checkpoint of the learner made here: ' in printed
    assert 'other there: torch 1.0 (here ' in printed


def test_what_is_no_run_is_refused(tmp_path, capsys):
    assert cli.main(['replay', str(tmp_path)]) == 2
    assert 'is no bag' in capsys.readouterr().err
