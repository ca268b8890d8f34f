"""What is measured of the memory D: scale, moments, bytes, and runs of segments."""

import tracemalloc

import numpy as np
import pytest

from codetr_ros.memory import store
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import Transitions
from helpers import builders
from helpers.memories import ACTION, DELAY, OBSERVATION, Naive, filled, labels, memory, score


def test_the_scale_and_the_moments_are_those_of_what_is_held():
    m, naive, _ = filled(11, episodes=8)
    batch = m.segments.batch(m.segments.ids())
    assert m.segments.score_scale() == pytest.approx(
        np.sqrt(np.mean((batch.values / batch.lengths) ** 2))
    )
    before = np.concatenate([e['observations'][:-1] for e in naive.episodes.values()])
    mean, deviation = m.store.observation_moments()
    np.testing.assert_allclose(mean, before.mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(deviation, before.std(0), rtol=1e-5)


@pytest.mark.parametrize('size', [1e-200, 1e-300])
def test_scores_whose_squares_are_no_numbers_have_a_scale_too(size):
    scales = []
    for factor in (1.0, size):
        naive, m = Naive(0), memory()
        m.append(naive.chunk('sim', 3 * DELAY, 'truncated'))
        for i, value in enumerate((1.0, -2.0, 3.0)):
            m.score(builders.score(first_step=i * DELAY, length=DELAY, value=value * factor))
        scales.append(m.segments.score_scale())
    assert scales[1] == pytest.approx(scales[0] * size, rel=1e-12)


def test_the_memory_takes_the_bytes_it_states():
    naive, m = Naive(0), memory(capacity=100, margin=100)
    m.append(naive.chunk('sim', 100, 'truncated'))
    assert m.bytes_per_step == 4 * (OBSERVATION + ACTION) + 10
    assert m.nbytes == 100 * m.bytes_per_step + 4 * OBSERVATION


def test_moments_are_those_of_all_rows_at_once_however_they_are_read(monkeypatch):
    m, *_ = filled(4, ('a', 'b'), episodes=12, capacity=60)
    parts = [s.observations[np.arange(s.start, s.end) % s.capacity] for s in m.store.sources]
    rows = np.concatenate(parts).astype(np.float64)
    assert len(rows) > 21
    for size in (1, 7, 1000):
        monkeypatch.setattr(store, 'PART_ROWS', size)
        mean, deviation = m.store.observation_moments()
        np.testing.assert_array_equal(mean, rows.mean(0))
        np.testing.assert_array_equal(deviation, rows.std(0))


@pytest.mark.parametrize('delay', [5, 25])
@pytest.mark.parametrize('observation', [27, 105])
@pytest.mark.parametrize('scored', [True, False])
def test_a_step_of_ant_takes_at_most_a_tenth_more_than_its_own_numbers(scored, observation, delay):
    """Scored as in the reward node, or labelled and sampled as in the learner."""
    action, steps = 8, 40_000
    rng = np.random.default_rng(0)
    half = rng.integers(50, 450, 80)  # an episode of a bad policy ends early
    lengths = np.stack([half, np.full_like(half, 1000)], 1).ravel()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        m = Trajectories(observation, action, delay, steps, 0)
        for number, length in enumerate(lengths.tolist()):
            count = min(length, steps - m.steps)
            if not count:
                break
            seen = rng.random((count + 1, observation), np.float32)
            taken = rng.random((count, action), np.float32)
            m.append(
                Transitions(
                    run_id='run',
                    source='sim',
                    sequence=number,
                    phase=0,
                    episode=number,
                    first_step=0,
                    steps=count,
                    observations=seen,
                    actions=taken,
                    terminated=True,
                    truncated=False,
                    phase_end=False,
                    scores_due=0,
                )
            )
            firsts = range(0, count, delay)
            where = [(number, first, min(delay, count - first)) for first in firsts]
            if scored:
                for _, first, size in where:
                    m.score(score('sim', number, first, size, 1.0))
            else:
                m.apply(labels('sim', where, np.zeros(count)))
        assert m.steps == steps
        if scored:
            m.segments.sample(rng, 64)
        else:
            m.labelled.sample(rng, 256)
        del seen, taken, where
        held = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    own = 4 * (observation + action) + 4 + 4 + 1 + 1  # label, its version, two flags
    assert own * steps < m.nbytes < held < 1.1 * own * steps, held / (own * steps)


def test_scoring_and_evicting_for_long_keeps_the_table_of_segments_small():
    naive, m = Naive(0), memory(capacity=40, margin=40)
    for episode in range(400):
        m.append(naive.chunk('sim', 8, 'truncated'))
        m.score(score('sim', episode, 0, DELAY, float(episode)))
        m.score(score('sim', episode, DELAY, DELAY, float(episode)))
        m.evict()
    values = m.segments.batch(m.segments.ids()).values
    assert values.tolist() == [float(e) for e in range(395, 400) for _ in range(2)]
    assert m.nbytes < 80 * m.bytes_per_step + 200 * 41


def test_runs_are_whole_scored_segments_of_one_episode_that_end_with_the_given_one():
    memory = Trajectories(OBSERVATION, ACTION, 5, 1000, 100)
    numbers = {}
    for source, episode, steps, unscored in (
        ('b', 0, 18, ()),
        ('b', 1, 5, ()),
        ('a', 0, 20, (5,)),
    ):
        memory.append(
            builders.transitions(
                source=source,
                episode=episode,
                steps=steps,
                observations=np.zeros((steps + 1, OBSERVATION), np.float32),
                actions=np.zeros((steps, ACTION), np.float32),
                truncated=True,
            )
        )
        for first in range(0, steps, 5):
            if first not in unscored:
                length = min(5, steps - first)
                where = {'source': source, 'episode': episode, 'first_step': first}
                memory.score(builders.score(length=length, **where))
    for number in memory.segments.ids():
        ((source, (episode,), (first,), _),) = memory.segments.spans(np.array([number]))
        numbers[source, int(episode), int(first)] = int(number)
    names = {number: name for name, number in numbers.items()}
    asked = [('b', 0, 15), ('b', 0, 5), ('b', 1, 0), ('a', 0, 15), ('a', 0, 0)]
    runs = memory.segments.runs(np.array([numbers[name] for name in asked]), 3)
    assert [[names[int(number)][2] for number in run] for run in runs] == [
        [5, 10, 15],
        [0, 5],
        [0],
        [10, 15],  # the one at 5 has no score
        [0],
    ]
    assert all(
        names[int(n)][:2] == name[:2] for run, name in zip(runs, asked, strict=True) for n in run
    )


def test_a_run_ends_where_the_segment_before_is_cut_short():
    memory = Trajectories(OBSERVATION, ACTION, 5, 1000, 100, regular=False)
    memory.append(
        builders.transitions(
            steps=20,
            observations=np.zeros((21, OBSERVATION), np.float32),
            actions=np.zeros((20, ACTION), np.float32),
        )
    )
    for first, length in ((0, 5), (5, 3), (10, 5), (15, 2)):
        memory.score(builders.score(first_step=first, length=length))
    ids = memory.segments.ids()
    assert [len(run) for run in memory.segments.runs(ids, 4)] == [1, 2, 1, 2]
