"""What was published is in the bag, all of it, and the summary says the same."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from codetr_ros.config import Settings, load
from helpers.builders import tiny
from helpers.runs import train


def read(bag: Path) -> dict[str, list[Any]]:
    """Every message of a bag by the last part of its topic, decoded by rosbags alone."""
    found: dict[str, list[Any]] = {}
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic.rsplit('/', 1)[1], []).append(message)
    return found


def check(summary: dict[str, Any], settings: Settings) -> dict[str, list[Any]]:
    """Compare a run's bag with its summary and with what its settings say; the bag's messages."""
    for topic, counts in summary['messages'].items():
        said = f'{topic}: {counts}'
        assert counts['lost'] == counts['duplicated'] == counts['refused'] == 0, said
        if topic in ('transitions', 'commits', 'step_rewards'):
            assert counts['received_by_learner'] == counts['published'], said
        if topic in ('transitions', 'commits', 'composite_rewards'):
            assert counts['received_by_reward'] == counts['published'], said
    bag = read(Path(summary['bag']))
    for topic in (
        'transitions',
        'composite_rewards',
        'true_rewards',
        'step_rewards',
        'policy',
        'metrics',
        'episodes',
        'commits',
        'task',
        'run',
    ):
        published = summary['messages'][topic]['published']
        assert len(bag[topic]) == summary['messages'][topic]['recorded'] == published > 0, topic
    check_steps(bag, settings)
    check_labels(bag, settings)
    return bag


def check_steps(bag: dict[str, list[Any]], settings: Settings) -> None:
    """Every step once, in order; every ended segment has its score; every phase its commit."""
    chunks = bag['transitions']
    assert sum(m.steps for m in chunks) == settings.steps
    assert [m.sequence for m in chunks] == list(range(len(chunks)))
    place = (0, 0)
    whole, ended = Counter[int](), {}
    for m in chunks:
        assert (m.episode, m.first_step) == place
        whole[m.episode] += m.steps
        ended[m.episode] = m.terminated or m.truncated
        place = (m.episode + 1, 0) if ended[m.episode] else (m.episode, m.first_step + m.steps)
    expected = []
    for episode, steps in whole.items():
        full, rest = divmod(steps, settings.delay)
        expected += [(episode, i * settings.delay, settings.delay) for i in range(full)]
        if rest and ended[episode]:
            expected.append((episode, full * settings.delay, rest))
    assert [(m.episode, m.first_step, m.length) for m in bag['composite_rewards']] == expected
    assert [m.phase for m in bag['commits']] == list(range(settings.phases))
    true = {(m.episode, m.first_step): m.rewards for m in bag['true_rewards']}
    for m in chunks:
        assert len(true[m.episode, m.first_step]) == m.steps


def check_labels(bag: dict[str, list[Any]], settings: Settings) -> None:
    """Each scored segment has its first label, of the phase in which it ended, or of the last of
    the warm-up.
    """
    ends = {
        (m.episode, m.first_step + step): m.phase
        for m in bag['transitions']
        for step in range(m.steps)
    }
    due = {
        (m.episode, m.first_step, m.length): max(
            ends[m.episode, m.first_step + m.length - 1], settings.warmup_phases - 1
        )
        for m in bag['composite_rewards']
    }
    first: dict[tuple[int, int, int], int] = {}
    for m in bag['step_rewards']:
        assert m.lengths.sum() == len(m.labels) and np.isfinite(m.labels).all()
        for segment in zip(
            m.episodes.tolist(), m.first_steps.tolist(), m.lengths.tolist(), strict=True
        ):
            first.setdefault(segment, m.phase)
    assert first == due


@pytest.mark.slow
def test_the_default_run_loses_nothing_and_its_bag_holds_everything(tmp_path):
    """The default task and settings, shortened to what shows it."""
    settings = load('quick').changed({'steps': 4000})
    summary, said = train(settings, tmp_path / 'run', installed=True)
    check(summary, settings)
    assert summary['steps'] == 4000 and summary['phases'] == 4
    assert 'lost' in said
    status = json.loads((tmp_path / 'run' / 'status.json').read_text())
    assert (status['state'], status['phase'], status['lost']) == ('finished', 4, 0)
    assert {node['role'] for node in status['nodes']} == set(settings.roles)


@pytest.mark.slow
@pytest.mark.parametrize('what', ['first', 'all'])
def test_the_bag_holds_the_labels_that_the_settings_ask_for(tmp_path, what):
    settings = tiny(record_relabels=what, steps=1000, memory_steps=10_000)
    summary, _ = train(settings, tmp_path / 'run')
    bag = check(summary, settings)
    counts = summary['messages']['step_rewards']
    times = Counter()
    for m in bag['step_rewards']:
        times.update(zip(m.episodes.tolist(), m.first_steps.tolist(), strict=True))
    if what == 'all':
        assert len(bag['step_rewards']) == counts['recorded'] == counts['published']
        assert max(times.values()) == settings.phases - settings.warmup_phases + 1
    else:
        # once when first labelled, and again wherever all labels are kept: at each of the
        # evaluations
        evaluations = sum(settings.evaluated(version) for version in range(settings.phases))
        assert min(times.values()) >= 1 and max(times.values()) <= 1 + evaluations


@pytest.mark.slow
def test_two_hundred_thousand_steps_at_the_highest_rate_lose_nothing(tmp_path):
    """Tiny networks and next to no learning: the nodes go as fast as they can."""
    settings = tiny(
        steps=200_000,
        phase_steps=1000,
        warmup_steps=1000,
        evaluate_every=50_000,
        memory_steps=20_000,
        delay=25,
        sac__updates_per_step=0.01,
        codetr__gradient_steps=1,
        codetr__tokens='merged',
    )
    summary, _ = train(settings, tmp_path / 'run')
    check(summary, settings)
