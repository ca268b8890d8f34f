"""What of a bag can be learnt from: nothing twice, nothing across a gap, nothing not finite."""

from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.bags.reader import Bag
from codetr_ros.offline import cutting, episodes
from codetr_ros.offline.cutting import stretches
from codetr_ros.offline.episodes import Index
from codetr_ros.offline.errors import FitError
from helpers.builders import run, score, task_spec, tiny, transitions
from helpers.foreign_bags import write


def index(tmp_path, *bags, run_id=None):
    paths = [write(tmp_path / f'bag_{i}', records) for i, records in enumerate(bags)]
    return Index([Bag(path) for path in paths], run_id).read()


def steps(count, parts, **changes):
    """An episode of `count` steps in chunks that begin at `parts`, one going on from another."""
    whole = transitions(steps=count, **changes)
    made = []
    for n, (begin, end) in enumerate(zip(parts, [*parts[1:], count], strict=True)):
        made.append(
            replace(
                whole,
                sequence=whole.sequence + n,
                first_step=whole.first_step + begin,
                steps=end - begin,
                observations=whole.observations[begin : end + 1],
                actions=whole.actions[begin:end],
                truncated=end == count,
            )
        )
    return made


def scores(*places, **changes):
    return [
        score(sequence=i, first_step=first, length=length, value=float(first), **changes)
        for i, (first, length) in enumerate(places)
    ]


def spans(found):
    return [(s.first, s.steps, s.segments.firsts.tolist()) for s in found]


def test_chunks_make_an_episode_and_scores_may_come_before_their_steps(tmp_path):
    a, b = steps(14, [0, 9])
    found = stretches(index(tmp_path, [a, *scores((0, 7), (7, 7)), b]), 7, 100)

    assert spans(found.usable) == [(0, 14, [0, 7])]
    assert found.usable[0].segments.values.tolist() == [0.0, 7.0]
    assert (found.unscored, dict(found.skipped)) == (
        0,
        {cutting.NO_STEPS: 0, cutting.TOO_LONG: 0},
    )


def test_steps_sent_again_are_taken_once(tmp_path):
    a, b = steps(14, [0, 7])
    found = index(tmp_path, [a, b, a, b, *scores((0, 7), (7, 7))])

    assert (found.steps, found.skipped[episodes.AGAIN]) == (14, 14)


def test_a_segment_across_a_gap_is_left_out_and_what_lies_beyond_it_is_not(tmp_path):
    a, _, c = steps(21, [0, 5, 9])
    found = stretches(index(tmp_path, [a, c, *scores((0, 7), (7, 7), (14, 7))]), 7, 100)

    assert spans(found.usable) == [(9, 12, [14])]
    assert found.skipped[cutting.NO_STEPS] == 2
    assert found.unscored == 17 - 7


def test_steps_that_do_not_join_are_kept_apart(tmp_path):
    a, b = steps(14, [0, 5])
    b = replace(b, observations=b.observations + 1)
    found = stretches(index(tmp_path, [a, b, *scores((0, 7), (7, 7))]), 7, 100)

    assert found.skipped[episodes.UNJOINED] == 1
    assert spans(found.usable) == [(5, 9, [7])]


def test_what_is_not_finite_is_left_out_and_may_come_again(tmp_path):
    (a,) = steps(7, [0])
    bad = replace(a, actions=np.where(a.actions > 0, np.nan, a.actions).astype(np.float32))
    found = index(tmp_path, [bad, score(value=np.inf), a, score()])

    assert (found.steps, found.scores) == (7, 1)
    assert found.skipped[episodes.UNSOUND] == 7
    assert found.skipped[episodes.NOT_FINITE] == 1


def test_a_step_counts_for_one_score_only(tmp_path):
    (a,) = steps(14, [0])
    found = stretches(index(tmp_path, [a, *scores((0, 7), (0, 7), (5, 7), (7, 3))]), 7, 100)

    assert spans(found.usable) == [(0, 14, [0, 7])]
    assert found.skipped[cutting.OVERLAP] == 2


def test_a_score_of_more_steps_than_the_delay_is_left_out(tmp_path):
    (a,) = steps(14, [0])
    found = stretches(index(tmp_path, [a, *scores((0, 9), (9, 4))]), 7, 100)

    assert spans(found.usable) == [(0, 14, [9])]
    assert found.skipped[cutting.TOO_LONG] == 1


def test_a_long_episode_is_cut_between_segments_and_loses_none(tmp_path):
    (a,) = steps(100, [0])
    places = [(i, 7) for i in range(0, 98, 7)]
    found = stretches(index(tmp_path, [a, *scores(*places)]), 7, 30).usable

    assert [s.steps for s in found] == [28, 28, 28, 16]
    assert [f for s in found for f in s.segments.firsts.tolist()] == [p[0] for p in places]
    ends = [s.first + s.steps for s in found]
    assert [s.first for s in found][1:] == ends[:-1]


def test_the_same_run_in_two_bags_is_learnt_from_once(tmp_path):
    a, b = steps(14, [0, 7])
    other = transitions(source='sim_2', truncated=True)
    found = index(tmp_path, [a, b, *scores((0, 7))], [a, b, *scores((0, 7)), other])

    assert found.steps == 14 + 5
    assert found.skipped[episodes.COPIES] == 14
    assert found.scores == 1


def test_a_copy_is_known_though_its_scores_come_before_its_steps(tmp_path):
    (a,) = steps(14, [0])
    found = index(tmp_path, [a, *scores((0, 7))], [*scores((0, 7)), a, *scores((7, 7))])

    assert (found.steps, found.scores, found.skipped[episodes.COPIES]) == (14, 1, 14)
    assert len(stretches(found, 7, 100).usable) == 1


def test_other_steps_under_the_same_names_in_another_bag_are_learnt_from(tmp_path):
    (a,) = steps(7, [0])
    b = replace(a, observations=a.observations + 1)
    found = index(tmp_path, [a, score()], [b, score()])

    assert len(stretches(found, 7, 100).usable) == 2


@pytest.mark.parametrize(
    ('other', 'said'),
    [
        ([task_spec(observation_size=4)], "'sim' in .*bag_1 has observation size 4, 'sim' in "),
        ([transitions(actions=np.zeros((5, 3), np.float32))], 'has action size 3, .* has 2'),
        (
            [replace(run(tiny(composite='max')), run_id='b')],
            "run 'b' in .*bag_1 is scored by composite = max .*another one by sum",
        ),
    ],
)
def test_bags_that_no_one_model_can_learn_from_are_refused_by_name(tmp_path, other, said):
    first = [run(), task_spec(), transitions(steps=7), score()]

    with pytest.raises(FitError, match=said):
        index(tmp_path, first, other)


def test_nothing_to_learn_from_is_said(tmp_path):
    with pytest.raises(FitError, match='no Transitions to learn from: `codetr convert` makes'):
        index(tmp_path, [run()])
    with pytest.raises(FitError, match='5 steps, but no CompositeReward'):
        index(tmp_path / 'other', [transitions()])


def test_the_delay_is_that_of_the_run_or_else_the_longest_segment(tmp_path):
    data = [*steps(9, [0]), *scores((0, 4), (4, 5), (9, 4000))]
    assert index(tmp_path / 'a', [run(), *data]).facts()['delay'] == 7

    unknown = index(tmp_path / 'b', data)
    assert unknown.facts() == {'delay': 5, 'task': 'unknown'}
    assert unknown.notes == [
        'delay = 5, the longest scored segment: no bag holds the settings of a run'
    ]

    longer = index(tmp_path / 'c', [run(), *steps(9, [0]), *scores((0, 9))])
    assert longer.facts()['delay'] == 9
    assert longer.notes == ['delay = 9, the longest scored segment: a run in the bags has 7']


def judged(scorer, sequence, first_step, value):
    return score(scorer=scorer, sequence=sequence, first_step=first_step, length=7, value=value)


def test_scores_of_several_on_scales_of_their_own_are_brought_to_one_and_corrections_count(
    tmp_path,
):
    worth = [1.0, 4.0, 2.0, 5.0, 3.0, 2.5, 4.5, 1.5, 3.5, 5.5]
    ann = [judged('ann', n, 7 * n, 0.0) for n in range(10)]
    ann += [judged('ann', 10 + n, 7 * n, value) for n, value in enumerate(worth)]
    ben = [judged('ben', n, 7 * n, 100 + 10 * value) for n, value in enumerate(worth)]
    settings = tiny(scorer='topic')
    records = [run(settings), task_spec(), transitions(steps=70), *ann, *ben]
    found = index(tmp_path, records)
    (episode,) = found.episodes.values()
    assert found.skipped['scores that their scorer has corrected'] == 10
    assert (found.scores, list(episode.firsts)) == (10, [7 * n for n in range(10)])
    assert np.abs(np.array(episode.values) - worth).max() < 0.1
