import weakref

import numpy as np
import pytest
from scipy import stats

from codetr_ros.cores import in_process
from codetr_ros.records import CompositeReward, Record, StepRewards, TrueRewards
from codetr_ros.runs.recovery import Recovery, RecoveryError
from helpers.builders import score, step_rewards, tiny

SETTINGS = tiny(delay=2, steps=600, phase_steps=100, warmup_steps=100, evaluate_every=100)


def true_rewards(
    episode: int, first_step: int, *rewards: float, source: str = 'sim', phase: int = 0
) -> TrueRewards:
    values = np.array(rewards, np.float32)
    return TrueRewards(
        run_id='run',
        source=source,
        sequence=0,
        phase=phase,
        episode=episode,
        first_step=first_step,
        rewards=values,
    )


def labels(phase: int, *segments: tuple[int, int, list[float]], **changes) -> StepRewards:
    """Labels of segments: episode, first step, label of each step."""
    numbers = [
        np.array(column, np.uint32) for column in zip(*[s[:2] for s in segments], strict=True)
    ]
    lengths = np.array([len(s[2]) for s in segments], np.uint32)
    values = np.concatenate([np.array(s[2], np.float32) for s in segments])
    fields = {'episodes': numbers[0], 'first_steps': numbers[1], 'lengths': lengths}
    return step_rewards(phase=phase, **fields, labels=values, **changes)


def observe(*records: Record, settings=SETTINGS, recorded=False) -> list[dict[str, float]]:
    recovery = Recovery(settings, recorded)
    for record in records:
        recovery.receive(record)
    return recovery.rows


def test_the_newest_labels_are_compared_with_the_true_rewards_of_their_steps():
    true = [1.0, 5.0, 2.0, 2.5, -1.0, 0.0, 3.0]
    said = [0.0, 1.0, 0.5, 0.7, 0.1, 0.2, 0.9]
    (row,) = observe(
        true_rewards(0, 0, *true[:3]),
        true_rewards(0, 3, true[3]),
        labels(0, (0, 0, [9.0, -9.0]), part=0, parts=2),
        labels(0, (0, 2, said[2:4]), part=1, parts=2),
        true_rewards(1, 0, *true[4:], 77.0),
        labels(1, (0, 0, said[:2]), (1, 0, said[4:6]), (1, 2, said[6:])),
    )[1:]

    assert (row['step'], row['steps']) == (200, 7), 'the step without a label does not count'
    assert row['pearson'] == pytest.approx(stats.pearsonr(said, true).statistic)
    assert row['spearman'] == pytest.approx(stats.spearmanr(said, true).statistic)
    centred = [
        [x[0] - (x[0] + x[1]) / 2, x[1] - (x[0] + x[1]) / 2]
        for y in (said, true)
        for x in (y[0:2], y[2:4], y[4:6])
    ]
    within = [np.append(np.ravel(centred[i : i + 3]), 0.0) for i in (0, 3)]
    assert row['within'] == pytest.approx(stats.pearsonr(*within).statistic)


def score_of(episode: int, first_step: int, value: float, **changes) -> CompositeReward:
    return score(episode=episode, first_step=first_step, length=2, value=value, **changes)


def test_segments_shown_range_from_the_lowest_to_the_highest_score_of_the_last_comparison():
    recovery = Recovery(SETTINGS.changed({'memory_steps': 16}))
    steps = np.arange(20.0)
    scores = [3.0, 9.0, 1.0, 8.0, 2.0, 7.0, 5.0, 6.0, 4.0, 0.0]
    given = [(0, 2 * i, [10.0 + 2 * i, 11.0 + 2 * i]) for i in range(10)]
    # a score may come before its steps, and after them
    for i in (4, 5, 6):
        recovery.receive(score_of(0, 2 * i, scores[i]))
    recovery.receive(true_rewards(0, 0, *steps))
    for i in (0, 1, 2, 3, 7, 8, 9):
        recovery.receive(score_of(0, 2 * i, scores[i]))
    recovery.receive(labels(0, *given))

    shown = recovery.segments

    assert [one.value for one in shown] == [0.0, 1.0, 4.0, 5.0, 7.0, 8.0], (
        'the first two have left'
    )
    for one in shown:
        i = scores.index(one.value)
        assert (one.source, one.episode, one.first) == ('sim', 0, 2 * i)
        assert one.true.tolist() == steps[2 * i : 2 * i + 2].tolist()
        assert one.labels.tolist() == given[i][2]


def test_a_segment_whose_first_steps_have_left_the_memory_is_not_shown():
    recovery = Recovery(SETTINGS.changed({'memory_steps': 3}))
    recovery.receive(true_rewards(0, 0, 1.0, 2.0, 3.0, 4.0, 5.0))
    recovery.receive(labels(0, (0, 0, [1.0, 2.0]), (0, 2, [3.0, 4.0])))
    assert [(one.first, one.value) for one in recovery.segments] == [(2, None)]

    recovery.receive(true_rewards(1, 0, 9.0, 8.0))
    recovery.receive(labels(1, (0, 2, [3.0, 4.0]), (1, 0, [9.0, 8.0])))
    (one,) = recovery.segments
    assert (one.episode, one.labels.tolist()) == (1, [9.0, 8.0])


def test_mean_and_deviation_of_both_sides_stand_beside_their_correlation():
    true, given = [1.0, 2.0, 4.0, 3.0], [0.0, 2.0, 1.0, -1.0]
    (row,) = observe(true_rewards(0, 0, *true), labels(0, (0, 0, given[:2]), (0, 2, given[2:])))

    assert (row['true_mean'], row['inferred_mean']) == (2.5, 0.5)
    assert (row['true_std'], row['inferred_std']) == pytest.approx((np.std(true), np.std(given)))


def test_labels_given_again_to_some_steps_of_a_segment_leave_it_one_segment():
    true, said = [1.0, 2.0, 4.0, 3.0], [0.0, 2.0, 1.0, -1.0]
    whole, runs = (
        observe(true_rewards(0, 0, *true), labels(0, *first), *again)[-1]
        for first, again in (
            ([(0, 0, said[:2]), (0, 2, said[2:])], []),
            (
                [(0, 0, [9.0, 8.0]), (0, 2, [7.0, said[3]])],
                [labels(1, (0, 1, said[1:2]), (0, 2, said[2:3]), (0, 0, said[:1]))],
            ),
        )
    )

    assert {**runs, 'step': 0} == {**whole, 'step': 0}


def test_segments_of_two_sources_are_not_taken_for_one():
    settings = SETTINGS.changed({'simulators': 2})
    (row,) = observe(
        true_rewards(0, 0, 1.0, 2.0),
        true_rewards(0, 0, 12.0, 11.0, source='sim_2'),
        labels(0, (0, 0, [1.0, 2.0]), part=0, parts=2),
        labels(0, (0, 0, [11.0, 12.0]), part=1, parts=2, source='sim_2'),
        settings=settings,
    )

    assert row['within'] == pytest.approx(0.0), 'right in one segment, wrong in the other'
    assert row['pearson'] > 0.9


def test_only_the_newest_steps_that_the_memory_holds_are_compared():
    settings = SETTINGS.changed({'memory_steps': 4})
    rows = observe(
        true_rewards(0, 0, 1.0, 2.0, 3.0),
        true_rewards(1, 0, 5.0, 6.0, 4.0),
        labels(0, (0, 2, [3.0]), (1, 0, [5.0, 6.0]), (1, 2, [4.0]), part=0, parts=2),
        labels(0, (0, 0, [-1.0, -2.0]), part=1, parts=2),
        settings=settings,
    )

    assert rows[0]['steps'] == 4
    assert rows[0]['pearson'] == pytest.approx(1)


def test_steps_that_a_version_has_labelled_no_more_have_left_the_memory_and_do_not_count():
    records = [
        true_rewards(0, 0, 1.0, 2.0, 3.0, 4.0),
        labels(0, (0, 0, [9.0, -9.0]), (0, 2, [3.0, 4.0]), version=0),
        labels(1, (0, 2, [3.5, 4.0]), version=1),
    ]
    assert [row['steps'] for row in observe(*records)] == [4, 2]
    some = SETTINGS.changed({'relabel_steps': 2})
    assert [row['steps'] for row in observe(*records, settings=some)] == [4, 4]


def test_true_rewards_may_come_before_the_labels_of_earlier_phases():
    settings = SETTINGS.changed({'memory_steps': 2})
    first, second = true_rewards(0, 0, 1.0, 2.0), true_rewards(1, 0, 4.0, 3.0, phase=1)
    said = labels(0, (0, 0, [1.0, 2.0])), labels(1, (1, 0, [4.0, 3.5]))

    in_turn = observe(first, said[0], second, said[1], settings=settings)
    assert in_turn == observe(first, second, *said, settings=settings)
    assert [row['steps'] for row in in_turn] == [2, 2]


def test_chunks_of_a_run_without_labels_are_not_kept():
    recovery, kept = Recovery(SETTINGS), []
    for phase in range(20):
        chunk = true_rewards(phase, 0, 1.0, phase=phase)
        kept.append(weakref.ref(chunk.rewards))
        recovery.receive(chunk)
        del chunk
    assert sum(array() is not None for array in kept) == SETTINGS.lag


def test_what_a_bag_lacks_labels_of_is_not_compared():
    """Of labels that are given again it has those of evaluations, unless it keeps all."""
    settings = SETTINGS.changed({'evaluate_every': 200})  # after phase 1, 3, 5
    given = [[(0, 0, [1.0, 2.0])]] * 6
    moving = [labels(p, *s, version=p) for p, s in enumerate(given)]
    between = [labels(p, *s, version=(p + 1) // 3) for p, s in enumerate(given)]
    true = true_rewards(0, 0, 1.0, 2.0)

    def steps(records, **changes) -> list[float]:
        chosen = settings.changed(changes)
        return [r['step'] for r in observe(true, *records, settings=chosen, recorded=True)]

    assert steps(moving) == [200, 400, 600]
    assert steps(between) == [200, 600], 'relabelled after phase 2, when nothing is evaluated'
    assert steps(between, record_relabels='all') == [200, 400, 600]
    assert steps(moving, relabel_steps=2) == []
    still = [labels(p, *s, version=0) for p, s in enumerate(given)]
    assert steps(still, relabel_steps=2) == [200, 400, 600], 'nothing is labelled again'


@pytest.mark.parametrize(
    ('records', 'said'),
    [
        ([], "'sim' published no true rewards"),
        ([true_rewards(0, 0, 1.0), true_rewards(0, 2, 1.0)], 'before episode 0, step 2'),
        ([true_rewards(0, 0, 1.0), true_rewards(2, 0, 1.0)], 'before episode 2, step 0'),
        ([true_rewards(0, 5, 1.0)], 'before episode 0, step 5'),
    ],
)
def test_true_rewards_that_are_missing_are_named(records, said):
    with pytest.raises(RecoveryError, match=said):
        observe(*records, labels(0, (0, 0, [1.0])))


def test_labels_beyond_the_true_rewards_are_refused():
    for beyond in (3, 0, [1.0]), (0, 1, [1.0, 1.0]):
        with pytest.raises(RecoveryError, match='up to episode 0, 2 steps'):
            observe(true_rewards(0, 0, 1.0, 2.0), labels(0, beyond))


def test_many_episodes_are_kept_apart():
    count = 200
    rng = np.random.default_rng(0)
    true = rng.normal(size=(count, 2)).astype(np.float32)
    chunks = [true_rewards(i, 0, *true[i]) for i in range(count)]
    segments = [(i, 0, list(true[i])) for i in range(count)]

    (row,) = observe(*chunks, labels(0, *segments))

    assert row['steps'] == 2 * count
    assert row['within'] == pytest.approx(1)


def test_there_is_a_row_for_each_evaluation_with_labels_and_none_without():
    empty = np.empty(0, np.uint32)
    nothing = step_rewards(
        source='', episodes=empty, first_steps=empty, lengths=empty, labels=empty.astype('f4')
    )
    settings = SETTINGS.changed({'evaluate_every': 200})
    said = [labels(phase, (0, 0, [1.0, 2.0])) for phase in range(4)]

    assert observe(true_rewards(0, 0, 1.0, 2.0), nothing) == []
    rows = observe(true_rewards(0, 0, 1.0, 2.0), *said, settings=settings)
    assert [row['step'] for row in rows] == [200, 400]


@pytest.mark.slow
def test_the_oracles_labels_are_the_truth_and_nobody_learns_from_the_comparison():
    settings = tiny(method='true', task='InvertedPendulum-v5', steps=600, warmup_steps=200)
    recovery = Recovery(settings)
    watched = in_process.run(settings, 'run', observe=recovery.receive)
    alone = in_process.run(settings, 'run')

    assert [row['step'] for row in recovery.rows] == [400, 600]
    assert all(row['steps'] > 0.9 * row['step'] for row in recovery.rows)
    # its rewards hardly vary: 1 for each step but the last of an episode
    assert all(row['pearson'] == pytest.approx(1) for row in recovery.rows)
    assert watched['learner'].policy_sha256 == alone['learner'].policy_sha256
