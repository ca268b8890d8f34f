"""The memory D against a naive one that keeps everything in lists."""

import tracemalloc

import numpy as np
import pytest

from codetr_ros.memory import store
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, RecordError, StepRewards, Transitions
from helpers import builders

OBSERVATION, ACTION, DELAY = 3, 2, 4


class Naive:
    """Episodes of one or more sources as plain lists: what the memory should be equal to."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.episodes: dict[tuple[str, int], dict] = {}
        self.sequence: dict[str, int] = {}
        self.current: dict[str, int] = {}

    def chunk(
        self, source: str, steps: int, end: str | None = None, phase: int = 0
    ) -> Transitions:
        number = self.current.setdefault(source, 0)
        key = (source, number)
        if key not in self.episodes:
            first = self.rng.normal(size=OBSERVATION).astype(np.float32)
            self.episodes[key] = {
                'observations': [first],
                'actions': [],
                'terminated': False,
                'ended': False,
            }
        episode = self.episodes[key]
        first_step = len(episode['actions'])
        for _ in range(steps):
            episode['observations'].append(self.rng.normal(size=OBSERVATION).astype(np.float32))
            episode['actions'].append(self.rng.uniform(-1, 1, ACTION).astype(np.float32))
        if end:
            episode['ended'], episode['terminated'] = True, end == 'terminated'
            self.current[source] = number + 1
        sequence = self.sequence.get(source, 0)
        self.sequence[source] = sequence + 1
        return Transitions(
            run_id='run',
            source=source,
            sequence=sequence,
            phase=phase,
            episode=number,
            first_step=first_step,
            steps=steps,
            observations=np.array(episode['observations'][first_step:]),
            actions=np.array(episode['actions'][first_step:]),
            terminated=end == 'terminated',
            truncated=end == 'truncated',
            phase_end=False,
            scores_due=0,
        )


def score(
    source: str, episode: int, first: int, length: int, value: float = 1.0, sequence: int = 0
) -> CompositeReward:
    return CompositeReward(
        run_id='run',
        source=source,
        scorer=source,
        sequence=sequence,
        episode=episode,
        first_step=first,
        length=length,
        value=value,
    )


def labels(
    source: str, segments: list[tuple[int, int, int]], values: np.ndarray, version: int = 1
) -> StepRewards:
    e, f, n = (np.array(column, np.uint32) for column in zip(*segments, strict=True))
    return StepRewards(
        run_id='run',
        phase=0,
        version=version,
        part=0,
        parts=1,
        source=source,
        episodes=e,
        first_steps=f,
        lengths=n,
        labels=values.astype(np.float32),
    )


def memory(capacity: int = 1000, margin: int = 100) -> Trajectories:
    return Trajectories(OBSERVATION, ACTION, DELAY, capacity, margin)


def filled(
    seed: int = 0, sources: tuple[str, ...] = ('sim',), episodes: int = 6, capacity: int = 1000
):
    """A memory and the naive one it should equal, with chunks and segments of odd sizes."""
    naive, m = Naive(seed), memory(capacity)
    truth: dict[tuple[str, int, int], float] = {}
    for number in range(episodes):
        for source in sources:
            steps = int(naive.rng.integers(1, 14))
            cut = int(naive.rng.integers(0, steps))
            ending = 'terminated' if naive.rng.random() < 0.5 else 'truncated'
            if cut:
                m.append(naive.chunk(source, cut))
            m.append(naive.chunk(source, steps - cut, ending))
            for first in range(0, steps, DELAY):
                length = min(DELAY, steps - first)
                m.score(score(source, number, first, length, value=float(naive.rng.normal())))
                values = naive.rng.normal(size=length)
                m.apply(labels(source, [(number, first, length)], values))
                for i in range(length):
                    truth[source, number, first + i] = np.float32(values[i])
            m.evict()
    return m, naive, truth


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
