import os
import signal
from pathlib import Path

import pytest

from codetr_ros.processes import restarts
from codetr_ros.processes.launcher import Node, Processes
from codetr_ros.processes.restarts import Restarts
from codetr_ros.processes.supervise import Interrupts, Silence, is_over, supervise
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports
from codetr_ros.runs.reports import NodeReport
from helpers.programs import Said, poll, python, start

KILLED = -signal.SIGKILL
DIES_TWICE = """
import os, signal, sys
count = sys.argv[1]
open(count, 'a').write('x')
if len(open(count).read()) < 3:
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_node_is_started_again_so_often_within_the_time_and_no_oftener() -> None:
    now = [0.0]
    some = Restarts(most=2, within=10.0, clock=lambda: now[0])

    assert [some.permit('sim', KILLED) for _ in range(3)] == [True, True, False]
    assert some.permit('reward', KILLED)  # each node has its own number
    now[0] = 10.0
    assert some.permit('sim', KILLED)
    assert some.counts == {'sim': 3, 'reward': 1}


@pytest.mark.parametrize('code', [None, 0, 1, 2, -signal.SIGINT, -signal.SIGTERM])
def test_a_node_that_has_a_reason_to_end_is_not_started_again(code: int | None) -> None:
    assert not Restarts().permit('sim', code)


@pytest.mark.parametrize(
    ('most', 'within', 'text'),
    [
        (-1, 1.0, '--restarts -1 must be from 0'),
        (1, 0.0, '--restarts-within 0 must be more than 0'),
        (1, float('nan'), '--restarts-within nan must be more than 0'),
    ],
)
def test_numbers_that_make_no_sense_are_refused(most: int, within: float, text: str) -> None:
    assert (reason := restarts.wrong(most, within)) and reason.startswith(text)
    assert restarts.wrong(0, 1.0) is None


def test_a_killed_node_is_started_again_and_its_log_goes_on(
    tmp_path: Path, processes: Processes, said: Said
) -> None:
    start(processes, tmp_path, python('sim', DIES_TWICE, tmp_path / 'count'))
    some = Restarts()

    assert supervise(processes, poll(processes), Interrupts(), Silence(), restarts=some) is None

    assert some.counts == {'sim': 2}
    assert said == [f'sim was ended by SIGKILL: starting it again (number {n})' for n in (1, 2)]
    assert (tmp_path / 'sim.log').read_text().count('$ ') == 3


def test_a_node_that_is_killed_too_often_ends_the_run(
    tmp_path: Path, processes: Processes
) -> None:
    start(processes, tmp_path, python('sim', DIES_TWICE, tmp_path / 'count'))

    failure = supervise(
        processes, poll(processes), Interrupts(), Silence(), restarts=Restarts(most=1)
    )

    assert failure == ('sim was ended by SIGKILL (started again 1 times within 600 s before)')


def test_a_node_that_is_killed_when_all_is_done_is_left_alone(
    tmp_path: Path, processes: Processes
) -> None:
    for role in ('learner', 'record'):
        report = NodeReport(role=role, name=role, finished=True)
        reports.write(run_folder.report_path(tmp_path, role, role), report)
    start(processes, tmp_path, python('learner', DIES_TWICE, tmp_path / 'count'))
    some = Restarts()

    failure = supervise(
        processes,
        poll(processes),
        Interrupts(),
        Silence(),
        restarts=some,
        over=lambda node: is_over(node, tmp_path),
    )

    assert failure is None and not some.counts
    (node,) = processes.nodes
    run_folder.report_path(tmp_path, 'record', 'record').unlink()
    assert not is_over(node, tmp_path)  # the recorder may still need something of it


def test_a_node_that_dies_while_another_is_started_again_is_started_again_too(
    tmp_path: Path, processes: Processes
) -> None:
    first = f"""
import os, time
if not os.path.exists({str(tmp_path / 'again')!r}):
    open({str(tmp_path / 'again')!r}, 'w').close()
    time.sleep(600)
"""
    start(
        processes,
        tmp_path,
        python('record', first),
        python('sim', DIES_TWICE, tmp_path / 'count'),
    )
    some = Restarts()

    def over(node: Node) -> bool:
        record = processes.nodes[0]
        if node.name == 'sim' and not some.counts['record'] and record.code is None:
            while not (tmp_path / 'again').exists():
                pass
            os.kill(record.process.pid, signal.SIGKILL)
            record.process.wait()
        return False

    failure = supervise(
        processes, poll(processes), Interrupts(), Silence(), restarts=some, over=over
    )

    assert failure is None
    assert some.counts == {'sim': 2, 'record': 1}
