"""The memory D against a naive one that keeps everything in lists."""

import numpy as np
import pytest

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import RecordError
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.memories import DELAY, Naive, filled, labels, memory, score


@pytest.mark.parametrize('sources', [('sim',), ('a', 'b')])
@pytest.mark.parametrize('capacity', [1000, 30])
def test_every_sampled_step_is_one_that_was_put_in_with_its_own_label(sources, capacity):
    m, naive, truth = filled(3, sources, episodes=25, capacity=capacity)
    known = {}
    for (source, number), episode in naive.episodes.items():
        for t, action in enumerate(episode['actions']):
            last = t == len(episode['actions']) - 1
            known[episode['observations'][t].tobytes()] = (
                action,
                episode['observations'][t + 1],
                last and episode['terminated'],
                truth[source, number, t],
            )
    assert m.steps <= capacity and m.labelled.count == m.steps
    batch = m.labelled.sample(np.random.default_rng(0), 6000)
    seen = set()
    for i in range(6000):
        key = batch.observations[i].tobytes()
        action, following, terminated, label = known[key]
        seen.add(key)
        np.testing.assert_array_equal(batch.actions[i], action)
        np.testing.assert_array_equal(batch.next_observations[i], following)
        assert batch.terminated[i] == terminated and batch.rewards[i] == label
    assert len(seen) == m.steps  # 6000 draws with replacement leave no step out


@pytest.mark.parametrize('context', [0, 5])
def test_a_segment_batch_holds_the_steps_of_its_episode_and_zeros_beyond(context):
    m, naive, _ = filled(5, ('a', 'b'), episodes=9)
    ids = m.segments.ids()
    batch = m.segments.batch(ids, context)
    at = 0
    for source, numbers, firsts, lengths in m.segments.spans(ids):
        for number, first, length in zip(numbers, firsts, lengths, strict=True):
            episode = naive.episodes[source, int(number)]
            before = min(context, int(first))
            assert (batch.context[at], batch.lengths[at]) == (before, before + length)
            end = int(first + length)
            expected = np.array(episode['observations'][int(first) - before : end + 1])
            np.testing.assert_array_equal(batch.observations[at, : len(expected)], expected)
            assert not batch.observations[at, len(expected) :].any()
            taken = np.array(episode['actions'][int(first) - before : end])
            np.testing.assert_array_equal(batch.actions[at, : len(taken)], taken)
            assert not batch.actions[at, len(taken) :].any()
            at += 1
    assert at == len(ids)


def test_windows_end_with_each_step_and_say_what_precedes_its_segment():
    m, naive, _ = filled(7, episodes=5)
    ids, window = m.segments.ids(), 6
    rows = list(m.segments.windows(ids, window, 7))
    observations = [
        b.observations[i, : b.lengths[i] + 1] for b in rows for i in range(len(b.lengths))
    ]
    contexts = [c for b in rows for c in b.context.tolist()]
    at = 0
    for source, numbers, firsts, lengths in m.segments.spans(ids):
        for number, first, length in zip(
            numbers.tolist(), firsts.tolist(), lengths.tolist(), strict=True
        ):
            everything = np.array(naive.episodes[source, number]['observations'])
            for t in range(first, first + length):
                begin = max(0, t + 1 - window)
                np.testing.assert_array_equal(observations[at], everything[begin : t + 2])
                assert contexts[at] == max(0, first - begin)
                at += 1
    assert at == len(observations)


@pytest.mark.parametrize('sources', [('sim',), ('a', 'b')])
@pytest.mark.parametrize('capacity', [1000, 30])
def test_steps_that_are_drawn_are_found_in_their_segments(sources, capacity):
    m, _, truth = filled(3, sources, episodes=25, capacity=capacity)
    places, firsts = np.unique(m.labelled.draw(np.random.default_rng(1), 20), return_index=True)
    drawn = m.labelled.sample(np.random.default_rng(1), 20).rewards[firsts]

    ids, within = m.labelled.located(places)
    spans = [
        (source, episode, first + i, length)
        for source, *columns in m.segments.step_spans(ids, within)
        for episode, first, length in zip(*(c.tolist() for c in columns), strict=True)
        for i in range(length)
    ]

    assert sorted(truth[span[:3]] for span in spans) == sorted(drawn.tolist())
    assert any(length > 1 for *_, length in spans), 'some follow on each other'
    beside = [(s, e, n + 1) for s, e, n, length in spans if length == 1]
    crossing = [key for key in beside if key in {span[:3] for span in spans}]
    assert all(number % DELAY == 0 for *_, number in crossing), 'a run is of one segment'


def test_a_step_has_the_same_window_alone_as_with_its_segment():
    m, _, _ = filled(7, episodes=5)
    ids, window = m.segments.ids(), 6
    whole = [
        b.part(slice(i, i + 1))
        for b in m.segments.windows(ids, window, 7)
        for i in range(len(b.lengths))
    ]
    places = np.arange(1, m.labelled.count, 3)
    chosen = m.segments.step_windows(*m.labelled.located(places), window, 5)
    single = [b.part(slice(i, i + 1)) for b in chosen for i in range(len(b.lengths))]
    for place, one in zip(places.tolist(), single, strict=True):
        other, steps = whole[place], int(one.lengths[0])
        assert (one.lengths, one.context) == (other.lengths, other.context)
        np.testing.assert_array_equal(
            one.observations[0, : steps + 1], other.observations[0, : steps + 1]
        )
        np.testing.assert_array_equal(one.actions[0, :steps], other.actions[0, :steps])


def test_labels_tell_which_version_gave_them():
    naive, m = Naive(0), memory()
    m.append(naive.chunk('sim', 10))
    for first in (4, 0):  # scored in another order
        m.score(score('sim', 0, first, DELAY))
    assert m.labelled.versions().tolist() == [] and m.segments.versions(
        m.segments.ids()
    ).tolist() == [-1, -1]
    m.apply(labels('sim', [(0, 0, 4), (0, 4, 4)], np.ones(8), version=2))
    m.apply(labels('sim', [(0, 3, 2)], np.ones(2), version=5))
    assert m.labelled.versions().tolist() == [2, 2, 2, 5, 5, 2, 2, 2]
    assert m.segments.versions(m.segments.ids()).tolist() == [5, 2]


def test_the_oldest_whole_episodes_leave_first_and_an_unfinished_one_stays():
    naive, m = Naive(0), memory(capacity=10)
    m.append(naive.chunk('sim', 6, 'truncated'))
    m.append(naive.chunk('sim', 5, 'truncated'))
    m.append(naive.chunk('sim', 3))
    m.score(score('sim', 0, 0, DELAY))
    m.score(score('sim', 1, 0, DELAY))
    assert m.evict() == 6 and m.steps == 8 and m.evicted == 6
    assert [numbers.tolist() for _, numbers, _, _ in m.segments.spans(m.segments.ids())] == [[1]]
    m.append(naive.chunk('sim', 9, 'truncated'))
    assert (
        m.evict() == 5 and m.steps == 12
    )  # the newest episode alone is too large, and is kept whole


@pytest.mark.parametrize('sources', [('sim',), ('b', 'a')])
def test_critics_that_see_it_get_how_far_each_steps_segment_had_come(sources):
    m, naive, truth = filled(3, sources, episodes=9, capacity=60, progress=True)
    known = {}
    for (source, number), episode in naive.episodes.items():
        steps = len(episode['actions'])
        for t in range(steps):
            first = t - t % DELAY
            ended = t + 1 in (first + DELAY, steps)
            worth = sum(float(truth[source, number, i]) for i in range(first, t + 1))
            before = [worth - float(truth[source, number, t]), t - first]
            after = [0.0, 0] if ended else [worth, t + 1 - first]
            known[episode['observations'][t].tobytes()] = np.array([before, after]) / DELAY
    batch = m.labelled.sample(np.random.default_rng(0), 2000)
    for i in range(2000):
        before, after = known[batch.observations[i, :O].tobytes()]
        np.testing.assert_allclose(batch.observations[i, O:], before, atol=1e-6)
        np.testing.assert_allclose(batch.next_observations[i, O:], after, atol=1e-6)
    assert m.bytes_per_step == memory().bytes_per_step + 16


def test_steps_without_a_label_are_never_sampled():
    naive, m = Naive(0), memory()
    m.append(naive.chunk('sim', 6))
    with pytest.raises(ValueError, match='no step of the memory is labelled'):
        m.labelled.sample(np.random.default_rng(0), 1)
    m.apply(labels('sim', [(0, 0, DELAY)], np.arange(DELAY)))
    assert m.labelled.count == DELAY
    assert set(m.labelled.sample(np.random.default_rng(0), 200).rewards.tolist()) == {
        0.0,
        1.0,
        2.0,
        3.0,
    }


def test_labels_of_evicted_episodes_are_counted_and_passed_over():
    naive, m = Naive(0), memory(capacity=5)
    m.append(naive.chunk('sim', 4, 'truncated'))
    m.append(naive.chunk('sim', 4, 'truncated'))
    m.evict()
    assert m.apply(labels('sim', [(0, 0, 4), (1, 0, 4)], np.arange(8))) == 4
    assert sorted(m.labelled.sample(np.random.default_rng(0), 99).rewards.tolist())[0] == 4.0


@pytest.mark.parametrize(
    ('wrong', 'said'),
    [
        (score('sim', 0, 0, 3), 'there is no such segment'),
        (score('sim', 0, 1, DELAY), 'start at multiples of 4'),
        (score('sim', 0, DELAY, DELAY), 'this episode has 6 steps'),
        (score('sim', 7, 0, DELAY), 'no such episode is here'),
        (score('other', 0, 0, DELAY), 'no such episode is here'),
        (score('sim', 0, 0, DELAY, 9.0), 'has its composite reward already'),
    ],
)
def test_a_score_for_a_segment_that_does_not_exist_or_again_is_refused_and_changes_nothing(
    wrong, said
):
    naive, m = Naive(0), memory()
    m.append(naive.chunk('sim', 6))
    m.score(score('sim', 0, 0, DELAY, 1.5))
    with pytest.raises(RecordError, match=said):
        m.score(wrong)
    assert m.segments.batch(m.segments.ids()).values.tolist() == [1.5]


def test_a_short_segment_counts_only_at_the_end_of_an_ended_episode():
    naive, m = Naive(0), memory()
    m.append(naive.chunk('sim', 6))
    with pytest.raises(RecordError, match='no such segment'):
        m.score(score('sim', 0, DELAY, 2))
    m.append(naive.chunk('sim', 1, 'terminated'))
    m.score(score('sim', 0, DELAY, 3))
    assert len(m.segments.ids()) == 1


def test_steps_that_do_not_follow_on_are_refused_and_change_nothing():
    naive, m = Naive(0), memory()
    m.append(naive.chunk('sim', 3))
    naive.chunk('sim', 2)
    gap = naive.chunk('sim', 2)
    with pytest.raises(
        RecordError, match="'sim' sent episode 0 step 5 .* episode 0 step 3 follows"
    ):
        m.append(gap)
    assert m.steps == 3


def test_a_source_whose_first_steps_are_refused_is_not_in_the_memory():
    naive, m = Naive(0), memory()
    naive.chunk('sim', 2)
    with pytest.raises(RecordError, match="'sim' sent episode 0 step 2"):
        m.append(naive.chunk('sim', 2))
    assert m.store.sources == [] and m.nbytes == 0
    with pytest.raises(RecordError, match=r"'sim', which sent no steps; sources: \[\]"):
        m.apply(labels('sim', [(0, 0, 2)], np.ones(2)))


def test_segments_keep_their_source_when_one_with_an_earlier_name_appears():
    naive, m = Naive(0), memory()
    m.append(naive.chunk('b', 5))
    m.score(score('b', 0, 0, DELAY, 1.5))
    before = m.segments.batch(m.segments.ids())
    m.append(naive.chunk('a', 3))
    ids = m.segments.ids()
    assert [source for source, *_ in m.segments.spans(ids)] == ['b']
    np.testing.assert_array_equal(m.segments.batch(ids).observations, before.observations)


def test_steps_whose_first_observation_is_another_are_refused():
    naive, m = Naive(0), memory()
    m.append(naive.chunk('sim', 3))
    chunk = naive.chunk('sim', 2)
    chunk.observations[0] += 1
    with pytest.raises(RecordError, match='the first observation is not the one'):
        m.append(chunk)


# ------------------------------------------------------------------------------------------------
# segments that may lie anywhere


def scattered(*spans):
    """An episode of 30 steps with scored segments at (first step, length)."""
    m = Trajectories(O, A, 10, 100, 10, regular=False)
    m.append(builders.transitions(steps=30, truncated=True))
    for number, (first, length) in enumerate(spans):
        m.score(builders.score(sequence=number, first_step=first, length=length))
    return m


@pytest.mark.parametrize('span', [(4, 2), (0, 5), (3, 10), (1, 9), (12, 3), (2, 10), (14, 10)])
def test_a_score_of_steps_that_another_one_covers_is_refused(span):
    m = scattered((3, 4), (10, 5))
    meets = any(a < span[0] + span[1] and span[0] < a + n for a, n in ((3, 4), (10, 5)))
    assert meets
    with pytest.raises(RecordError, match='another score covers some of these|has its composite'):
        m.score(builders.score(first_step=span[0], length=span[1]))
    assert len(m.segments.ids()) == 2


@pytest.mark.parametrize('span', [(0, 3), (7, 3), (15, 10), (8, 1), (29, 1)])
def test_a_score_of_steps_that_none_covers_is_taken(span):
    m = scattered((3, 4), (10, 5))
    m.score(builders.score(first_step=span[0], length=span[1]))
    assert len(m.segments.ids()) == 3


def test_a_run_has_the_segments_that_end_where_the_next_begins():
    m = scattered((0, 2), (2, 5), (7, 1), (10, 4), (14, 3))
    ids = m.segments.ids()
    runs = [run.tolist() for run in m.segments.runs(ids, 3)]
    assert runs == [[0], [0, 1], [0, 1, 2], [3], [3, 4]]
    assert [run.tolist() for run in m.segments.runs(ids[2:3], 2)] == [[1, 2]]
