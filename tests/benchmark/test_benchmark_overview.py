import io
from pathlib import Path

from codetr_ros.benchmark.attempt import Job
from codetr_ros.benchmark.folder import Folder
from codetr_ros.benchmark.overview import Overview

JOBS = [
    Job(cell=f'cell_seed{i}', settings_hash='hash', steps=1000, phases=10, threads=1)
    for i in range(4)
]
GOOD = {'error': None, 'log': None}


class Clock:
    """Time that passes when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def overview(tmp_path: Path, live: bool = False) -> tuple[Overview, io.StringIO, Clock]:
    said, clock = io.StringIO(), Clock()
    Folder(tmp_path).attempts.mkdir(parents=True)
    return Overview(Folder(tmp_path), JOBS, 2, said, live, clock), said, clock


def learn(folder: Path, cell: str, phases: int) -> None:
    """Leave the checkpoints of an attempt that has learnt from so many phases."""
    for phase in range(phases):
        place = folder / 'attempts' / f'{cell}.0123abcd' / 'checkpoints' / f'learner-{phase:06d}'
        place.mkdir(parents=True)


def test_the_time_left_follows_from_the_steps_of_ended_and_running_cells(tmp_path: Path) -> None:
    shown, _, clock = overview(tmp_path)
    shown.started(JOBS[0])
    shown.started(JOBS[1])
    assert shown.seconds_left is None
    clock.now += 60
    shown.ended(JOBS[0], GOOD)
    learn(tmp_path, JOBS[1].cell, 5)

    assert shown.seconds_left == 60 * 2500 / 1500


def test_plain_lines_say_what_is_done_and_how_far_the_rest_is(tmp_path: Path) -> None:
    shown, said, clock = overview(tmp_path)
    with shown:
        shown.started(JOBS[0])
        learn(tmp_path, JOBS[0].cell, 4)
        clock.now += 31
        shown.tick()
        shown.tick()
        shown.ended(JOBS[0], GOOD)

    lines = said.getvalue().splitlines()
    assert lines == [
        'begun: cell_seed0',
        '2 of 6 done, 1 running, 0 failed, 31 s so far, about 4:39 min left; '
        'running: cell_seed0 40%',
        'done: cell_seed0 in 31 s (3 of 6 done, 0 running, 0 failed, 31 s so far, '
        'about 1:33 min left)',
    ]


def test_a_failed_cell_is_shown_with_the_end_of_its_log_and_remembered(tmp_path: Path) -> None:
    shown, said, _ = overview(tmp_path)
    shown.started(JOBS[0])
    shown.ended(JOBS[0], {'error': 'ended by SIGKILL', 'log': 'one\ntwo'})

    assert shown.failed == {JOBS[0].cell: 'ended by SIGKILL'}
    assert 'FAILED: cell_seed0 after 0 s: ended by SIGKILL\n    one\n    two\n' in said.getvalue()


def test_on_a_terminal_running_and_failed_cells_stay_in_sight(tmp_path: Path) -> None:
    shown, said, clock = overview(tmp_path, live=True)
    with shown:
        shown.started(JOBS[0])
        shown.started(JOBS[1])
        shown.ended(JOBS[1], {'error': 'no', 'log': None})
        clock.now += 1
        shown.tick()

    last = said.getvalue()
    assert '2 of 6 done, 1 running, 1 failed' in last
    assert 'failed: cell_seed1' in last
    assert 'cell_seed0' in last
