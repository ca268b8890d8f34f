"""What a run's reward model learnt is learnt again from its bag, bit for bit, without nodes."""

import json
from pathlib import Path
from typing import Any

import pytest

from codetr_ros import cli
from codetr_ros.bags.verify import verify
from codetr_ros.config import threads
from codetr_ros.cores import in_process
from codetr_ros.records import Commit, CompositeReward, Record, RunSpec, StepRewards, Transitions
from codetr_ros.runs import checkpoints
from helpers.builders import tiny
from helpers.foreign_bags import write

DIGEST = 'reward_model_sha256'


def fit(bag: Path, out: Path, *flags: str, code: int = 0) -> dict[str, Any]:
    arguments = ['fit', str(bag), '--out', str(out), '--schedule', 'phases', *flags]
    assert cli.main(arguments) == code
    return json.loads((out / 'summary.json').read_text()) if code == 0 else {}


def test_folding_the_bag_ends_with_the_weights_and_labels_of_the_run(a_run, tmp_path):
    said = fit(a_run.bag, tmp_path / 'out')

    assert said[DIGEST] == a_run.reports['reward'].reward_model_sha256
    made = sum(len(r.lengths) for r in a_run.records if isinstance(r, StepRewards))
    assert said['recorded_labels'] == {'same': made, 'other': 0}
    assert said['phases'] == a_run.settings.phases
    assert said['changed_settings'] == {}


def test_what_people_stated_late_and_corrected_is_learnt_from_the_bag_as_in_the_run(tmp_path):
    settings = tiny(
        task='InvertedPendulum-v5',
        delay=10,
        steps=800,
        evaluate_every=0,
        method='evidence',
        scorer='simulated',
        people__count=2,
        people__late=130,
        people__preferences=0.3,
    )
    records: list[Record] = []
    reports = in_process.run(settings, 'calls', observe=records.append)
    bag = write(tmp_path / 'bag', records)

    said = fit(bag, tmp_path / 'out')

    assert said[DIGEST] == reports['reward'].reward_model_sha256
    rows = [r.lengths for r in records if isinstance(r, StepRewards)]
    assert said['recorded_labels'] == {'same': sum(map(len, rows)), 'other': 0}
    found = verify(bag)
    assert found.sound, found.findings.named


@pytest.mark.slow
def test_labels_of_what_the_learner_drew_are_made_again_from_the_bag(tmp_path):
    settings = tiny(
        steps=800,
        evaluate_every=0,
        relabel='drawn',
        codetr__labelling='window',
        codetr__window=5,
        sac__updates_per_step=0.05,
    )
    records: list[Record] = []
    in_process.run(settings, 'calls', observe=records.append)
    bag = write(tmp_path / 'bag', records)

    said = fit(bag, tmp_path / 'out')

    rows = [r.lengths for r in records if isinstance(r, StepRewards)]
    assert min(int(lengths.min()) for lengths in rows[1:]) == 1, 'single steps'
    assert said['recorded_labels'] == {'same': sum(map(len, rows)), 'other': 0}
    assert verify(bag).sound


@pytest.mark.parametrize(
    'changes',
    [{}, pytest.param({'evidence__link': 'choose'}, marks=pytest.mark.slow)],
    ids=['known', 'choose'],
)
def test_a_regression_on_maxima_is_fitted_again_from_the_bag(tmp_path, changes):
    """Each fit goes on from the one before: all of them must be done again."""
    settings = tiny(steps=600, evaluate_every=0, method='evidence', composite='max', **changes)
    records: list[Record] = []
    reports = in_process.run(settings, 'calls', observe=records.append)

    made = fit(write(tmp_path / 'bag', records), tmp_path / 'out')

    assert made[DIGEST] == reports['reward'].reward_model_sha256
    labels = sum(len(r.lengths) for r in records if isinstance(r, StepRewards))
    assert made['recorded_labels'] == {'same': labels, 'other': 0}


@pytest.mark.slow
def test_topics_may_have_been_recorded_in_another_order(a_run, tmp_path):
    """As by a recorder that hears the commits before the last scores, and some steps later."""
    records = list(a_run.records)
    order = sorted(
        range(len(records)),
        key=lambda i: i + {CompositeReward: 30, Transitions: 5}.get(type(records[i]), 0),
    )
    bag = write(tmp_path / 'bag', [records[i] for i in order])

    said = fit(bag, tmp_path / 'out')

    assert said[DIGEST] == a_run.reports['reward'].reward_model_sha256
    made = sum(len(r.lengths) for r in records if isinstance(r, StepRewards))
    assert said['recorded_labels'] == {'same': made, 'other': 0}
    assert said['skipped'] == {}


@pytest.mark.slow
def test_the_last_checkpoint_holds_these_very_weights(a_run, tmp_path):
    said = fit(a_run.bag, tmp_path / 'out')

    newest = checkpoints.latest(tmp_path / 'out' / 'checkpoints', 'reward')
    tensors, meta = checkpoints.load(newest)
    assert checkpoints.digest(checkpoints.of_model(tensors)) == said[DIGEST]
    assert (meta['observation_size'], meta['action_size']) == (10, 2)
    assert meta['settings'] == threads.settled(a_run.settings).canonical()


def test_a_setting_that_the_run_did_not_have_is_said_and_teaches_something_else(a_run, tmp_path):
    said = fit(a_run.bag, tmp_path / 'out', '--codetr.learning-rate', '0.002')

    assert said['changed_settings'] == {'codetr.learning_rate': 0.002}
    assert said[DIGEST] != a_run.reports['reward'].reward_model_sha256
    assert said['recorded_labels']['same'] == 0


@pytest.mark.slow
def test_a_run_that_started_from_a_saved_model_is_folded_from_it(a_run, tmp_path):
    said = fit(a_run.bag, tmp_path / 'own')

    start = ['--checkpoint', str(tmp_path / 'own')]
    frozen = fit(a_run.bag, tmp_path / 'frozen', *start, '--frozen')
    assert frozen[DIGEST] == said[DIGEST]
    live = fit(a_run.bag, tmp_path / 'live', *start)
    assert live['gradient_steps'] == 2 * said['gradient_steps']
    fit(a_run.bag, tmp_path / 'nothing', '--frozen', code=1)


@pytest.mark.slow
def test_a_bag_cut_after_a_commit_is_folded_up_to_there(a_run, tmp_path):
    ends = [i for i, r in enumerate(a_run.records) if isinstance(r, Commit)]
    bag = write(tmp_path / 'cut', a_run.records[: ends[2] + 1])

    assert fit(bag, tmp_path / 'out')['phases'] == 3


def test_a_phase_that_is_not_whole_is_named_and_not_learnt_from(a_run, tmp_path, capsys):
    records = list(a_run.records)
    lost = next(i for i, r in enumerate(records) if isinstance(r, Transitions) and r.phase == 3)
    del records[lost]
    bag = write(tmp_path / 'bag', records)

    fit(bag, tmp_path / 'out', code=2)

    said = capsys.readouterr().err
    assert "phase 3 of run 'calls' is committed, but not all that belongs to it" in said
    assert '--schedule epochs' in said


def test_a_damaged_summary_beside_the_bag_is_refused_before_anything_is_learnt(
    a_run, tmp_path, capsys
):
    bag = write(tmp_path / 'run' / 'bag', a_run.records)
    (tmp_path / 'run' / 'summary.json').write_text('{')

    fit(bag, tmp_path / 'out', code=2)

    assert 'summary.json cannot be read as JSON' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_two_runs_in_a_bag_must_be_told_apart(a_run, tmp_path, capsys):
    other = a_run.settings.run_spec('other')
    bag = write(tmp_path / 'bag', [*a_run.records, other])

    fit(bag, tmp_path / 'out', code=2)
    assert 'holds the runs calls, other: choose one with --run' in capsys.readouterr().err
    fit(bag, tmp_path / 'out', '--run', 'mine', code=2)
    assert "holds no run 'mine'; it holds calls, other" in capsys.readouterr().err
    said = fit(bag, tmp_path / 'chosen', '--run', 'calls')
    assert said[DIGEST] == a_run.reports['reward'].reward_model_sha256


def test_a_bag_that_does_not_say_how_its_run_learnt_is_refused(a_run, tmp_path, capsys):
    bag = write(tmp_path / 'bag', [r for r in a_run.records if not isinstance(r, RunSpec)])

    fit(bag, tmp_path / 'out', code=2)

    assert 'holds no RunSpec' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('flags', 'said'),
    [
        (['--config', 'cpu'], "--schedule phases learns under the run's own settings"),
        (['--delay', '0'], 'delay = 0: a segment has 1 to 100000 steps'),
        (['--patience', '0'], 'patience = 0: Input should be greater than or equal to 1'),
    ],
)
def test_flags_that_make_no_sense_are_refused_before_anything_is_made(
    a_run, tmp_path, capsys, flags, said
):
    fit(a_run.bag, tmp_path / 'out', *flags, code=2)

    assert said in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
