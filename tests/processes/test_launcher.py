import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from codetr_ros import config
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import Command, LaunchError, Node, Processes
from codetr_ros.processes.supervise import Interrupts, Silence, supervise, why_it_gave_up
from codetr_ros.records import Commit, Presence
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports
from codetr_ros.runs.reports import NodeReport
from helpers.executables import prefix

PATIENCE = 20.0  # seconds after which a test gives up; nothing waits for it to pass


READY = 'import signal, sys, time\n'


ENDS_WHEN_ASKED = """
def end(*_):
    with open(sys.argv[1], 'a') as file:
        print(sys.argv[2], file=file)
    sys.exit(0)
signal.signal(signal.SIGINT, end)
"""


DEAF = 'signal.signal(signal.SIGINT, signal.SIG_IGN)\n'


WAIT = "print('ready', flush=True)\nwhile True: time.sleep(60)\n"


class Said(list[str]):
    """What people are told."""

    def __call__(self, text: str) -> None:
        self.append(text)


@pytest.fixture
def said() -> Said:
    return Said()


@pytest.fixture
def processes(said: Said) -> Iterator[Processes]:
    with Processes(said, stop_deadline=PATIENCE) as started:
        yield started


def python(name: str, program: str, *arguments: object, role: str | None = None) -> Command:
    # -S -E: without site-packages a child starts in a fraction of the time.
    call = (sys.executable, '-S', '-E', '-c', program, *map(str, arguments))
    return Command(name, role or name, call)


def wait_until(true: Callable[[], bool], what: str) -> None:
    give_up = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < give_up, f'waited {PATIENCE} s for {what}'
        threading.Event().wait(0.005)


def start(processes: Processes, logs: Path, *commands: Command) -> None:
    """Start them and wait until each that says so is ready for signals."""
    processes.start(commands, logs, os.environ)
    for node in processes.nodes:
        if 'ready' in node.command.arguments[4]:
            wait_until(lambda n=node: 'ready\n' in n.log.read_text(), f'{node.name} to be ready')


def exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def poll(processes: Processes) -> Callable[[], None]:
    """For `supervise`: hands nothing on, and fails rather than hang."""
    give_up = time.monotonic() + PATIENCE

    def look() -> None:
        assert time.monotonic() < give_up, [node.how_it_ended() for node in processes.nodes]
        threading.Event().wait(0.005)

    return look


def test_the_recorder_is_asked_to_end_after_everybody_else_has(
    tmp_path: Path, processes: Processes, said: Said
) -> None:
    order = tmp_path / 'order'
    program = READY + ENDS_WHEN_ASKED + WAIT
    start(
        processes,
        tmp_path,
        python('record', program, order, 'record'),
        python('sim', program, order, 'sim'),
        python('learner', program, order, 'learner'),
    )

    processes.stop()

    names = order.read_text().split()
    assert sorted(names[:2]) == ['learner', 'sim']
    assert names[2] == 'record'
    assert [node.code for node in processes.nodes] == [0, 0, 0]
    assert said == []


def test_a_process_that_does_not_end_when_asked_is_named_and_killed(
    tmp_path: Path, processes: Processes, said: Said
) -> None:
    processes.stop_deadline = 0.05
    start(processes, tmp_path, python('reward', READY + DEAF + WAIT))

    processes.stop()

    (node,) = processes.nodes
    assert node.code == -signal.SIGKILL
    assert node.killed
    assert said == ['reward did not end 0.05 s after SIGINT: killing it']


def test_a_killed_process_takes_what_it_has_started_with_it(
    tmp_path: Path, processes: Processes
) -> None:
    program = (
        READY
        + DEAF
        + 'import subprocess\n'
        + "child = subprocess.Popen(['sleep', '600'])\nprint(child.pid, flush=True)\n"
        + WAIT
    )
    start(processes, tmp_path, python('reward', program))
    (node,) = processes.nodes
    pid = int(node.log.read_text().splitlines()[-2])
    assert exists(pid)

    processes.kill(processes.nodes)

    wait_until(lambda: not exists(pid) or _is_zombie(pid), 'the grandchild to be gone')


def _is_zombie(pid: int) -> bool:
    # Nobody waits for orphans in a container whose first process does not: dead is dead.
    return Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0] == 'Z'


def test_a_second_request_shortens_the_deadline(
    tmp_path: Path, processes: Processes, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launcher, 'HURRIED_DEADLINE', 0.05)
    processes.hurry = lambda: True
    start(processes, tmp_path, python('learner', READY + DEAF + WAIT))

    processes.stop()

    assert said == ['learner did not end 0.05 s after SIGINT: killing it']


def test_leaving_the_block_leaves_no_process_behind(tmp_path: Path, said: Said) -> None:
    nodes: list[Node] = []

    def fail() -> None:
        with Processes(said, stop_deadline=PATIENCE) as processes:
            nodes.extend(processes.nodes)
            start(
                processes, tmp_path, python('sim', READY + ENDS_WHEN_ASKED + WAIT, '/dev/null', '')
            )
            nodes.extend(processes.nodes)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()

    assert [node.code for node in nodes] == [0]


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='prctl is a Linux call')
def test_processes_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    parent = subprocess.Popen(
        [
            sys.executable,
            '-c',
            'import os, sys, time; from pathlib import Path\n'
            'from codetr_ros.processes.launcher import Command, Processes\n'
            'p = Processes(print)\n'
            f'child = {READY + ENDS_WHEN_ASKED + WAIT!r}\n'
            "call = (sys.executable, '-S', '-E', '-c', child, *sys.argv[1:])\n"
            "p.start([Command('sim', 'sim', call)], Path(sys.argv[1]).parent, os.environ)\n"
            'print(p.nodes[0].process.pid, flush=True)\n'
            'time.sleep(600)\n',
            tmp_path / 'order',
            'ended',
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        wait_until(lambda: 'ready\n' in (tmp_path / 'sim.log').read_text(), 'the child')
    finally:
        parent.kill()
        parent.wait()
    parent.stdout.close()

    wait_until((tmp_path / 'order').exists, 'the child to be told of the death of its parent')
    wait_until(lambda: not exists(pid) or _is_zombie(pid), 'the child to end')


def test_ctrl_c_in_the_terminal_reaches_the_parent_only(
    tmp_path: Path, processes: Processes
) -> None:
    start(processes, tmp_path, python('sim', READY + WAIT))

    (node,) = processes.nodes
    assert os.getpgid(node.process.pid) == node.process.pid != os.getpgid(0)
    assert os.getsid(node.process.pid) == node.process.pid


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


def test_silence_is_broken_by_news_but_not_by_presence() -> None:
    now = [0.0]
    silence = Silence(lambda: now[0])
    now[0] = 30
    silence.receive(
        Presence(
            run_id='r',
            role='sim',
            node='sim',
            instance_id='i',
            settings_hash='',
            finished=False,
            topics=(),
            published=(),
            missed=0,
        )
    )  # type: ignore[arg-type]
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


def test_what_cannot_be_started_is_named(tmp_path: Path, processes: Processes) -> None:
    missing = tmp_path / 'no such program'

    with pytest.raises(LaunchError, match=rf'sim \({missing}\) cannot be started: No such file'):
        processes.start([Command('sim', 'sim', (str(missing),))], tmp_path, os.environ)


def test_executables_are_found_in_the_environment_or_through_the_ament_prefix_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, 'prefix', str(tmp_path / 'venv'))
    ament = {
        'AMENT_PREFIX_PATH': f'{tmp_path / "empty"}{os.pathsep}{prefix(tmp_path / "install")}'
    }

    assert launcher.executable('sim', ament) == tmp_path / 'install/lib/sim_node/sim'
    prefix(tmp_path / 'venv')
    assert launcher.executable('sim', ament) == tmp_path / 'venv/lib/sim_node/sim'


def test_a_workspace_that_is_not_built_is_said_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, 'prefix', str(tmp_path))

    with pytest.raises(LaunchError) as refused:
        launcher.executable('reward', {})

    assert f'reward_node/reward is in none of {tmp_path}' in str(refused.value)
    assert 'colcon build' in str(refused.value)
    assert '--in-process' in str(refused.value)


def test_each_node_is_told_its_namespace_and_folder_and_the_learner_the_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, 'prefix', str(prefix(tmp_path)))
    settings = config.load('quick').changed({'simulators': 2})

    made = launcher.commands(settings, 'r1', Path('/runs/a b'), {})

    assert [c.name for c in made] == ['sim', 'sim_2', 'evaluate', 'reward', 'record', 'learner']
    call = {c.name: ' '.join(c.arguments[1:]) for c in made}
    assert call['sim'] == '--ros-args -r __ns:=/run_r1 -p folder:="/runs/a b"'
    assert call['sim_2'] == ('--ros-args -r __ns:=/run_r1 -r __node:=sim_2 -p folder:="/runs/a b"')
    assert call['learner'] == (
        '--ros-args -r __ns:=/run_r1 -p folder:="/runs/a b" '
        '-p config:="/runs/a b/config.yaml" -p run_id:="r1"'
    )


def test_no_evaluator_is_started_where_nothing_is_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, 'prefix', str(prefix(tmp_path)))
    settings = config.load('quick').changed({'evaluate_every': 0})

    roles = [c.role for c in launcher.commands(settings, 'r1', tmp_path, {})]

    assert roles == ['sim', 'reward', 'record', 'learner']


def test_nodes_look_at_this_host_only_unless_the_user_says_otherwise() -> None:
    settings = config.load('quick').changed({'threads': 3})

    plain = launcher.environment(settings, {'PATH': '/bin', 'OMP_NUM_THREADS': '64'})
    opened = launcher.environment(settings, {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'})

    assert plain['PATH'] == '/bin'
    assert plain['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert plain['RMW_FASTRTPS_PUBLICATION_MODE'] == 'SYNCHRONOUS'
    assert plain['OMP_NUM_THREADS'] == '3', 'threads decide the bits: the setting wins'
    assert plain['OMP_WAIT_POLICY'] == 'PASSIVE'
    assert opened['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SUBNET'


def test_the_end_of_a_log_is_shown_whatever_is_in_it(tmp_path: Path) -> None:
    log = tmp_path / 'sim.log'
    log.write_bytes(b'x' * 50_000 + b'\n\xff\xfe\nlast\n\n')

    assert launcher.end_of_log(log, lines=2) == '\ufffd\ufffd\nlast'
    assert 'cannot be read: No such file' in launcher.end_of_log(tmp_path / 'none')
