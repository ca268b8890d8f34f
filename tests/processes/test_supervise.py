import os
import signal
from pathlib import Path

import pytest

from codetr_ros.processes.launcher import Processes
from codetr_ros.processes.supervise import (
    Interrupts,
    Silence,
    failed_at,
    supervise,
    why_it_gave_up,
)
from codetr_ros.records import Commit
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports
from codetr_ros.runs.reports import NodeReport
from helpers.builders import presence
from helpers.programs import (
    ENDS_WHEN_ASKED,
    PATIENCE,
    READY,
    WAIT,
    Said,
    poll,
    python,
    start,
)


def test_a_run_whose_processes_all_end_well_has_not_failed(
    tmp_path: Path, processes: Processes
) -> None:
    start(processes, tmp_path, python('sim', ''), python('learner', ''))

    failure = supervise(processes, poll(processes), Interrupts(), Silence())

    assert failure is None


@pytest.mark.parametrize(
    ('program', 'reason'),
    [
        ('raise SystemExit(3)', 'learner ended with exit code 3'),
        (
            'import os, signal; os.kill(os.getpid(), signal.SIGKILL)',
            'learner was ended by SIGKILL',
        ),
    ],
)
def test_a_process_that_dies_stops_the_whole_run_and_is_named(
    tmp_path: Path, processes: Processes, said: Said, program: str, reason: str
) -> None:
    start(
        processes,
        tmp_path,
        python('sim', READY + ENDS_WHEN_ASKED + WAIT, '/dev/null', ''),
        python('learner', program),
    )

    failure = supervise(processes, poll(processes), Interrupts(), Silence())

    assert failure == reason
    assert said == [f'{reason}: stopping sim']
    assert processes.running() == []
    assert [n.name for n in processes.nodes if n.unasked_failure] == ['learner']


def test_of_several_that_have_failed_meanwhile_the_first_is_named(
    tmp_path: Path, processes: Processes
) -> None:
    end = 'raise SystemExit(1)'
    start(processes, tmp_path, *(python(name, end) for name in ('sim', 'record', 'learner')))
    for node in processes.nodes:
        node.process.wait(PATIENCE)
    for name, at in (('sim', 2000.0), ('record', 1000.0), ('learner', 3000.0)):
        path = run_folder.report_path(tmp_path, name, name)
        reports.write(path, NodeReport(role=name, name=name, error='it waited for another'))
        os.utime(path, (at, at))

    failure = supervise(
        processes,
        poll(processes),
        Interrupts(),
        Silence(),
        failed_at=lambda node: failed_at(node, tmp_path),
    )

    assert failure == 'record ended with exit code 1'


def test_who_was_killed_and_left_no_report_has_failed_before_those_that_gave_up_on_it(
    tmp_path: Path, processes: Processes
) -> None:
    start(processes, tmp_path, python('sim', ''), python('learner', ''))
    killed, gave_up = processes.nodes
    report = NodeReport(role='learner', name='learner', error='it waited for another')
    reports.write(run_folder.report_path(tmp_path, 'learner', 'learner'), report)

    assert failed_at(killed, tmp_path) < failed_at(gave_up, tmp_path)


def test_a_process_that_ends_well_but_too_early_stops_the_run(
    tmp_path: Path, processes: Processes
) -> None:
    (tmp_path / 'nodes').mkdir()
    tired = NodeReport(role='learner', name='learner', finished=False, error='tired')
    reports.write(run_folder.report_path(tmp_path, 'learner', 'learner'), tired)
    start(
        processes,
        tmp_path,
        python('sim', READY + ENDS_WHEN_ASKED + WAIT, '/dev/null', ''),
        python('learner', ''),
    )

    failure = supervise(
        processes,
        poll(processes),
        Interrupts(),
        Silence(),
        lambda node: why_it_gave_up(node, tmp_path),
    )

    assert failure == 'learner ended before the run had finished: tired'
    assert processes.running() == []


def test_a_process_without_a_report_is_named(tmp_path: Path, processes: Processes) -> None:
    start(processes, tmp_path, python('learner', ''))
    (node,) = processes.nodes

    assert why_it_gave_up(node, tmp_path) == 'learner ended without a report'
    report = NodeReport(role='learner', name='learner', finished=True)
    reports.write(run_folder.report_path(tmp_path, 'learner', 'learner'), report)
    assert why_it_gave_up(node, tmp_path) is None


def test_a_process_that_stays_when_all_else_has_ended_is_named_and_ended(
    tmp_path: Path, processes: Processes
) -> None:
    now = [0.0]
    start(
        processes,
        tmp_path,
        python('sim', ''),
        python('record', READY + ENDS_WHEN_ASKED + WAIT, '/dev/null', ''),
    )
    look = poll(processes)

    def minutes_pass() -> None:
        look()
        if len(processes.running()) == 1:
            now[0] += 60

    failure = supervise(
        processes, minutes_pass, Interrupts(), Silence(lambda: now[0]), deadline=90
    )

    assert failure == 'record did not end within 90 s after the rest of the run'
    assert processes.running() == []


@pytest.mark.parametrize(
    'program',
    ['raise SystemExit(3)', 'import os; os.kill(os.getpid(), 9)', ''],
    ids=['gives up', 'is killed', 'ends too early'],
)
def test_a_process_without_which_the_run_ends_well_may_fail(
    tmp_path: Path, processes: Processes, said: Said, program: str
) -> None:
    start(processes, tmp_path, python('sim', ''), python('evaluate', program))

    failure = supervise(
        processes,
        poll(processes),
        Interrupts(),
        Silence(),
        lambda node: 'evaluate ended early' if node.name == 'evaluate' else None,
        dispensable=lambda node: node.name == 'evaluate',
    )

    assert failure is None
    (line,) = said
    assert line.startswith('evaluate ') and line.endswith(': the run goes on without it')


def test_a_process_without_which_the_run_ends_well_is_not_waited_for_long(
    tmp_path: Path, processes: Processes, said: Said
) -> None:
    now = [0.0]
    start(processes, tmp_path, python('sim', ''), python('evaluate', READY + WAIT))
    look = poll(processes)

    def seconds_pass() -> None:
        look()
        now[0] += 20 * (len(processes.running()) == 1)

    failure = supervise(
        processes,
        seconds_pass,
        Interrupts(),
        Silence(lambda: now[0]),
        dispensable=lambda node: node.name == 'evaluate',
    )

    assert failure is None
    assert said == ['evaluate did not end with the rest of the run: the run goes on without it']
    assert [node.unasked_failure for node in processes.nodes] == [False, False]


def test_silence_is_broken_by_news_but_not_by_presence() -> None:
    now = [0.0]
    silence = Silence(lambda: now[0])
    now[0] = 30
    silence.receive(presence('sim'))
    assert silence.seconds == 30
    silence.receive(
        Commit(run_id='r', phase=0, sources=(), transitions=(), scorers=(), scores=(), dropped=())
    )  # type: ignore[arg-type]
    assert silence.seconds == 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_all_processes_and_is_no_failure(
    tmp_path: Path, processes: Processes, said: Said, number: signal.Signals
) -> None:
    before = signal.getsignal(number)
    start(processes, tmp_path, python('sim', READY + ENDS_WHEN_ASKED + WAIT, '/dev/null', ''))

    with Interrupts() as interrupts:
        os.kill(os.getpid(), number)
        failure = supervise(processes, poll(processes), interrupts, Silence())

    assert failure is None
    assert interrupts.count == 1
    assert not interrupts.again()
    assert [node.code for node in processes.nodes] == [0]
    assert said == ['stopping: nodes end their slice and save (Ctrl-C again to hurry)']
    assert signal.getsignal(number) == before


@pytest.mark.parametrize(
    ('handler', 'failure'),
    [('sys.exit(3)', 'sim ended with exit code 3'), (None, None)],
    ids=['fails', 'had not come so far as to handle signals'],
)
def test_a_process_that_ends_badly_after_an_interrupt_is_named(
    tmp_path: Path, processes: Processes, handler: str | None, failure: str | None
) -> None:
    taken = 'signal.SIG_DFL' if handler is None else f'lambda *_: {handler}'
    start(
        processes,
        tmp_path,
        python('sim', READY + f'signal.signal(signal.SIGINT, {taken})\n' + WAIT),
    )

    with Interrupts() as interrupts:
        os.kill(os.getpid(), signal.SIGINT)
        said = supervise(processes, poll(processes), interrupts, Silence())

    assert said == failure


def test_code_that_does_not_look_is_interrupted_by_the_second_request() -> None:
    with Interrupts() as interrupts:
        interrupts.raising = True
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupts.count == 1
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
