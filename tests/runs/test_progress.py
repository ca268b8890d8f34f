"""What people see of a run while it goes on."""

import io
import re

import pytest

from codetr_ros.records import Presence
from codetr_ros.runs.progress import Progress, duration
from helpers import builders
from helpers.summaries import SETTINGS, Clock, a_run, commit


def presence(node: str, missed: int = 0) -> Presence:
    return builders.presence('sim', {'task': 1}, run_id='r', node=node, missed=missed)


def test_progress_shows_what_nodes_say_that_they_lack() -> None:
    clock, stream = Clock(), io.StringIO()
    progress = Progress(SETTINGS, stream, live=False, clock=clock)
    progress.receive(presence('/r/sim'))
    progress.receive(presence('/r/reward', missed=2))
    progress.receive(presence('/r/learner', missed=3))
    progress.receive(presence('/r/reward'))  # it has come after all
    clock.now += 10
    progress.tick()

    assert progress.lost == 3
    assert 'lost messages 3' in stream.getvalue()


def test_progress_without_a_terminal_says_a_line_for_each_evaluation_and_few_others() -> None:
    clock, stream = Clock(), io.StringIO()
    with Progress(SETTINGS, stream, live=False, clock=clock) as progress:
        for record in a_run():
            clock.now += 1
            progress.receive(record)
            progress.receive(presence('sim'))

    lines = stream.getvalue().splitlines()
    evaluations = [line for line in lines if line.startswith(('random policy', 'after'))]
    assert evaluations == [
        'random policy: true return 20.0 +- 10.0, score 0.500 (2 episodes)',
        'after 1000 steps: true return 25.0 +- 25.0, score 0.025 (2 episodes)',
        'after 2000 steps: true return 125.0 +- 25.0, score 0.125 (2 episodes)',
        'after 2500 steps: true return 225.0 +- 25.0, score 0.225 (2 episodes)',
    ]
    assert len(lines) - len(evaluations) <= 4, 'one in five seconds'
    assert any(line.startswith('phase 3 of 3, steps 2500 of 2500') for line in lines)


def test_progress_knows_speed_and_time_left() -> None:
    clock = Clock()
    progress = Progress(SETTINGS, io.StringIO(), live=False, clock=clock)
    assert progress.seconds_left is None
    for phase in (0, 1):
        clock.now += 10
        progress.receive(commit(phase))

    assert progress.steps == 2000
    assert progress.rate == pytest.approx(100)
    assert progress.seconds_left == pytest.approx(5)


def test_progress_on_a_terminal_shows_phase_evaluation_losses_and_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('TERM', 'xterm')
    monkeypatch.setenv('COLUMNS', '120')
    stream = io.StringIO()
    with Progress(SETTINGS, stream, live=True, clock=Clock()) as progress:
        progress.receive(presence('/run_r/sim'))
        for record in a_run():
            progress.receive(record)

    shown = re.sub(r'\x1b\[[^A-Za-z]*[A-Za-z]', '', stream.getvalue())
    for text in (
        '3 of 3',
        '2500 of 2500',
        'nodes: sim',
        'score 0.225',
        'critic loss',
        'lost messages',
    ):
        assert text in shown, text


@pytest.mark.parametrize(
    ('seconds', 'said'), [(0, '0 s'), (59.4, '59 s'), (185, '3:05 min'), (7800, '2:10 h')]
)
def test_durations_are_said_as_people_do(seconds: float, said: str) -> None:
    assert duration(seconds) == said
