"""What the recorder keeps of the labels when it keeps first ones only."""

import tracemalloc
from collections import deque

import numpy as np
import pytest

from codetr_ros.bags.first_labels import FirstLabels
from helpers.builders import step_rewards, tiny

DELAY, EPISODE, MEMORY = 5, 20, 1000  # steps
NEVER = {'evaluate_every': 0, 'memory_steps': MEMORY}


def part(phase, segments, source='sim', steps=DELAY):
    """Labels of some segments, each named by its episode and first step."""
    episodes, firsts = np.array(segments, np.uint32).reshape(-1, 2).T
    lengths = np.full(len(episodes), steps, np.uint32)
    labels = np.arange(lengths.sum(), dtype=np.float32)
    return step_rewards(
        phase=phase, source=source, episodes=episodes, first_steps=firsts, lengths=lengths,
        labels=labels,
    )  # fmt: skip


def kept(first, given):
    """The segments of a part that go into the bag."""
    left = first.keep(given)
    left = given if left is None else left
    return list(zip(left.episodes.tolist(), left.first_steps.tolist(), strict=True))


def test_only_what_is_labelled_for_the_first_time_is_kept_with_its_labels():
    first = FirstLabels(tiny(**NEVER))
    assert first.keep(part(0, [(0, 0), (0, 5)])) is None
    left = first.keep(part(1, [(0, 0), (0, 10), (0, 5), (1, 0)]))
    assert left.episodes.tolist() == [0, 1] and left.first_steps.tolist() == [10, 0]
    assert left.labels.tolist() == [5, 6, 7, 8, 9, 15, 16, 17, 18, 19]
    assert left.source == 'sim'
    nothing = first.keep(part(2, [(0, 5), (1, 0)]))
    assert len(nothing.labels) == len(nothing.episodes) == 0 and nothing.source == ''


def test_sources_are_told_apart():
    first = FirstLabels(tiny(**NEVER))
    assert kept(first, part(0, [(0, 0)])) == [(0, 0)]
    assert kept(first, part(0, [(0, 0)], source='two')) == [(0, 0)]
    assert kept(first, part(1, [(0, 0)], source='two')) == []


def test_all_labels_are_kept_where_the_policy_is_evaluated():
    settings = tiny(memory_steps=MEMORY)
    evaluated = next(phase for phase in range(settings.phases) if settings.evaluated(phase))
    first = FirstLabels(settings)
    first.keep(part(0, [(0, 0)]))
    assert first.keep(part(evaluated, [(0, 0), (0, 5)])) is None
    assert kept(first, part(evaluated + 1, [(0, 0), (0, 5)])) == []


def test_an_empty_part_is_kept_as_it_is():
    assert FirstLabels(tiny(**NEVER)).keep(part(0, [])) is None


@pytest.mark.parametrize('seed', range(5))
def test_it_agrees_with_a_list_of_everything_while_old_episodes_are_evicted(seed):
    """Scores of some segments come phases late, as a person's do."""
    rng = np.random.default_rng(seed)
    first = FirstLabels(tiny(**NEVER))
    seen, late, episode = set(), [], 0
    held = deque(maxlen=MEMORY // EPISODE)  # episodes in the memory: whole, the oldest goes
    for phase in range(200):
        scored, late = [s for s in late if s[0] in held and rng.random() < 0.3], []
        for _ in range(rng.integers(0, 4)):
            held.append(episode)
            for step in range(0, EPISODE, DELAY):
                (scored if rng.random() < 0.8 else late).append((episode, step))
            episode += 1
        again = [s for s in seen if s[0] in held]
        given = [*scored, *again]
        rng.shuffle(given)
        assert sorted(kept(first, part(phase, given))) == sorted(scored)
        seen.update(scored)


def test_what_it_remembers_does_not_grow_with_the_run():
    first = FirstLabels(tiny(**NEVER))

    def run(episodes):
        for episode in episodes:
            first.keep(part(0, [(episode, step) for step in range(0, EPISODE, DELAY)]))

    run(range(100))
    tracemalloc.start()
    try:
        run(range(100, 2000))
        assert tracemalloc.get_traced_memory()[0] < 20_000  # 200 segments are held
    finally:
        tracemalloc.stop()


def test_a_label_of_a_forgotten_episode_is_written_twice_rather_than_lost():
    first = FirstLabels(tiny(**NEVER))
    first.keep(part(0, [(0, 0)]))
    first.keep(part(0, [(1, 0)], steps=MEMORY + 1))
    assert kept(first, part(1, [(0, 0)])) == [(0, 0)]


def spans(phase, *rows):
    """Labels of spans of steps: episode, first step, length."""
    episodes, firsts, lengths = np.array(rows, np.uint32).T
    labels = np.arange(lengths.sum(), dtype=np.float32)
    return step_rewards(
        phase=phase, episodes=episodes, first_steps=firsts, lengths=lengths, labels=labels
    )


def test_later_labels_of_some_steps_of_a_segment_are_no_first_ones():
    first = FirstLabels(tiny(**NEVER))
    first.keep(spans(0, (0, 0, 5), (0, 10, 5), (1, 0, 3)))
    left = first.keep(
        spans(1, (0, 5, 5), (1, 3, 5), (0, 1, 2), (0, 4, 1), (0, 10, 1), (0, 12, 3), (1, 2, 1))
    )
    assert list(zip(left.episodes.tolist(), left.first_steps.tolist(), strict=True)) == [
        (0, 5), (1, 3),
    ]  # fmt: skip
    assert left.lengths.tolist() == [5, 5] and left.labels.tolist() == list(range(10))
    assert len(first.keep(spans(2, (0, 9, 1), (1, 7, 1))).lengths) == 0
