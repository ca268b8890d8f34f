"""Bags of runs whose scores come irregularly: verified, surveyed, fitted, labelled, played."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from codetr_ros import cli
from codetr_ros.bags.info import survey
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.config import Settings
from codetr_ros.cores import in_process
from codetr_ros.records import CompositeReward, Record, RunSpec, StepRewards
from codetr_ros.runs.reports import NodeReport
from helpers.bags import ours
from helpers.builders import tiny


@dataclass
class Run:
    """A run in this process, with everything that was published in it."""

    settings: Settings
    records: list[Record]
    reports: dict[str, NodeReport]
    bag: Path


def a_run(folder: Path, **changes) -> Run:
    few = {'steps': 800, 'sac__updates_per_step': 0.02, 'evaluate_every': 0, 'method': 'mlp'}
    settings = tiny(**few | changes)
    records: list[Record] = []
    reports = in_process.run(settings, 'calls', observe=records.append)
    return Run(settings, records, reports, ours(folder / 'bag', records))


@pytest.fixture(scope='module', params=['5:40', 'episode'])
def delayed(request, tmp_path_factory) -> Run:
    task = 'Reacher-v5' if request.param == '5:40' else 'InvertedDoublePendulum-v5'
    return a_run(tmp_path_factory.mktemp('run'), delay=request.param, task=task)


def test_the_bag_is_sound_and_states_its_delay(delayed):
    found = verify(delayed.bag)
    assert found.sound, found.findings.named
    run = survey(delayed.bag)['runs'][0]
    assert run['settings']['delay'] == delayed.settings.delay
    scores = [r for r in delayed.records if isinstance(r, CompositeReward)]
    assert run['segments_scored'] == len(scores) and len({s.length for s in scores}) > 3


def test_a_score_that_is_lost_and_one_of_other_steps_are_named(delayed, tmp_path):
    scores = [r for r in delayed.records if isinstance(r, CompositeReward) and r.length > 4]
    lost = ours(tmp_path / 'lost', [r for r in delayed.records if r is not scores[3]])
    texts = [finding.text for finding in verify(lost).findings.named]
    assert any('has no composite reward' in text for text in texts)
    other = [replace(r, length=3) if r is scores[3] else r for r in delayed.records]
    texts = [f.text for f in verify(ours(tmp_path / 'other', other)).findings.named]
    words = {'5:40': '5 to 40 steps', 'episode': 'whole episodes'}
    assert any(f'scores what is no segment of {words[delayed.settings.delay]}' in t for t in texts)


def test_learning_again_from_the_bag_ends_with_the_same_model(delayed, tmp_path):
    out = tmp_path / 'out'
    arguments = ['fit', str(delayed.bag), '--out', str(out), '--schedule', 'phases']
    assert cli.main(arguments) == 0
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['reward_model_sha256'] == delayed.reports['reward'].reward_model_sha256
    assert summary['metrics']['segments'] > 5


def test_a_model_is_fitted_to_the_bag_and_labels_it(delayed, tmp_path):
    out, labelled = tmp_path / 'out', tmp_path / 'labelled'
    few = ['--gradient-steps=20', '--check-every=10']
    assert cli.main(['fit', str(delayed.bag), '--out', str(out), *few, '--method=codetr']) == 0
    arguments = ['label', str(delayed.bag), '--checkpoint', str(out), '--out', str(labelled)]
    assert cli.main(arguments) == 0
    assert verify(labelled).sound


def test_settings_of_an_unknown_kind_of_delay_are_named(delayed, tmp_path):
    records = [
        replace(r, settings=r.settings.replace(json.dumps(delayed.settings.delay), '"now"'))
        if isinstance(r, RunSpec)
        else r
        for r in delayed.records
    ]
    texts = [f.text for f in verify(ours(tmp_path / 'bag', records)).findings.named]
    assert any('settings cannot be read: a delay is a number of steps' in t for t in texts)


# ------------------------------------------------------------------------------------------------
# scores that are missing


@pytest.fixture(scope='module', params=['mlp', 'uniform'])
def incomplete(request, tmp_path_factory) -> Run:
    how = {'score_missing': 0.3, 'score_noise': 0.5, 'score_levels': 4, 'delay': '5:40'}
    folder = tmp_path_factory.mktemp('run')
    return a_run(folder, **how, task='Reacher-v5', method=request.param)


def scores(run: Run) -> tuple[list[CompositeReward], list[CompositeReward]]:
    """The scores of a run, and the segments that have none."""
    every = [r for r in run.records if isinstance(r, CompositeReward)]
    return [s for s in every if s.value == s.value], [s for s in every if s.value != s.value]


def test_a_bag_of_incomplete_scores_is_sound_and_counts_them(incomplete, capsys):
    found = verify(incomplete.bag)
    assert found.sound, found.findings.named
    known, missing = scores(incomplete)
    assert len(missing) > 5
    run = survey(incomplete.bag)['runs'][0]
    assert (run['segments_scored'], run['segments_unscored']) == (len(known), len(missing))
    assert run['steps_scored'] == sum(s.length for s in known)
    assert run['scores']['max'] <= 4 and 'not_finite' not in run['scores']
    assert run['settings']['score_missing'] == 0.3
    assert cli.main(['bag', 'info', str(incomplete.bag)]) == 0
    assert f'; {len(missing)} without a score' in ' '.join(capsys.readouterr().out.split())


def test_no_number_is_no_score_only_where_scores_may_be_missing(delayed, incomplete, tmp_path):
    scored = [r for r in delayed.records if isinstance(r, CompositeReward)]
    wrong = [replace(r, value=float('nan')) if r is scored[1] else r for r in delayed.records]
    texts = [f.text for f in verify(ours(tmp_path / 'nan', wrong)).findings.named]
    assert any('value=nan) is not finite' in text for text in texts)
    known, _ = scores(incomplete)
    wrong = [replace(r, value=float('inf')) if r is known[1] else r for r in incomplete.records]
    texts = [f.text for f in verify(ours(tmp_path / 'inf', wrong)).findings.named]
    assert any('value=inf) is not finite' in text for text in texts)


def test_learning_again_from_an_incomplete_bag_ends_with_the_same_model(incomplete, tmp_path):
    out = tmp_path / 'out'
    assert cli.main(['fit', str(incomplete.bag), '--out', str(out), '--schedule', 'phases']) == 0
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['reward_model_sha256'] == incomplete.reports['reward'].reward_model_sha256
    assert summary['recorded_labels']['other'] == 0 < summary['recorded_labels']['same']


@pytest.mark.parametrize('method', ['mlp', 'evidence', 'uniform', 'ircr'])
def test_an_incomplete_bag_is_fitted_and_all_of_its_segments_are_labelled(
    incomplete, method, tmp_path, capsys
):
    known, missing = scores(incomplete)
    out, labelled = tmp_path / 'out', tmp_path / 'labelled'
    few = ['--gradient-steps=20', '--check-every=10', f'--method={method}']
    assert cli.main(['fit', str(incomplete.bag), '--out', str(out), *few]) == 0
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['data']['segments without a score'] == len(missing)
    assert summary['data']['scored segments'] == len(known)
    assert f'{len(known)} scores' in capsys.readouterr().out
    arguments = ['label', str(incomplete.bag), '--checkpoint', str(out), '--out', str(labelled)]
    assert cli.main(arguments) == 0
    assert verify(labelled).sound
    newest = [
        entry.record
        for entry in Bag(labelled).entries((StepRewards,))
        if entry.record.phase == incomplete.settings.phases
    ]
    lengths = np.concatenate([record.lengths for record in newest])
    assert sorted(lengths.tolist()) == sorted(s.length for s in [*known, *missing])
