"""Curves of other methods that are shown beside a run's own: of the same task, or not at all."""

import io

import pytest

from codetr_ros import config
from codetr_ros.records import EpisodeResult
from codetr_ros.runs import references, report_text
from codetr_ros.runs.progress import Progress
from helpers.summaries import run_summary

DEFAULT = config.load('quick')


def test_the_default_task_has_curves_of_the_even_spread_and_of_raw_scores() -> None:
    beside = references.of(DEFAULT)

    assert beside is not None, 'run benchmarks/default_task.py again: the preset has changed'
    assert [curve.label for curve in beside.curves] == [
        'an even spread',
        'raw scores',
    ]
    for curve in beside.curves:
        assert curve.seeds == 10
        assert curve.steps[-1] == DEFAULT.steps
        for low, mean, high in zip(curve.low, curve.mean, curve.high, strict=True):
            assert low <= mean <= high


def test_the_method_the_seed_and_what_is_shown_do_not_matter() -> None:
    same = DEFAULT.changed({'method': 'evidence', 'seed': 7, 'evaluate_episodes': 3})

    assert references.of(same) is references.of(DEFAULT)


@pytest.mark.parametrize(
    'changes',
    [{'task': 'Pusher-v5'}, {'delay': 25}, {'steps': 9000}, {'sac.batch': 64}, {'score_noise': 1}],
    ids=str,
)
def test_another_task_score_or_learner_has_no_curves(changes: dict[str, object]) -> None:
    assert references.of(DEFAULT.changed(changes)) is None


def result(step: int, episode: int) -> EpisodeResult:
    return EpisodeResult(
        run_id='r',
        source='evaluate',
        purpose='evaluation',
        version=0,
        step=step,
        episode=episode,
        length=50,
        terminated=False,
        true_return=-12.0,
        composite_return=-12.0,
        score=-0.24,
    )


def test_each_evaluation_is_shown_beside_what_was_recorded() -> None:
    shown = io.StringIO()
    progress = Progress(DEFAULT, shown)
    for episode in range(DEFAULT.evaluate_episodes):
        progress.receive(result(3000, episode))

    beside = references.of(DEFAULT)
    assert beside is not None
    for curve in beside.curves:
        assert f'{curve.label} {curve.at(3000):.1f}' in shown.getvalue()
    assert beside.beside(3001) == ''


def test_the_results_of_other_settings_have_no_rows_of_recorded_runs() -> None:
    rows = dict(report_text.result_rows(run_summary()))

    assert not [name for name in rows if name.startswith('...')]
