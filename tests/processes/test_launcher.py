import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from codetr_ros import config
from codetr_ros.processes import launcher
from codetr_ros.processes.launcher import Command, LaunchError, Node, Processes
from helpers.builders import tiny
from helpers.executables import prefix
from helpers.programs import (
    DEAF,
    ENDS_WHEN_ASKED,
    PATIENCE,
    READY,
    WAIT,
    Said,
    exists,
    python,
    start,
    wait_until,
)


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
    try:
        return Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0] == 'Z'
    except (FileNotFoundError, ProcessLookupError):  # somebody has waited for it
        return True


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


def test_nodes_get_the_namespace_and_the_deadline_that_the_user_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, 'prefix', str(prefix(tmp_path)))

    made = launcher.commands(
        config.load('quick'), 'r1', tmp_path, {}, namespace='/lab/a', peer_deadline=0
    )

    for command in made:
        assert '__ns:=/lab/a' in command.arguments
        assert command.arguments[-2:] == ('-p', 'peer_deadline:=0.0')


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
    opened = launcher.environment(
        settings, {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET', 'GOMP_SPINCOUNT': '7'}
    )

    assert plain['PATH'] == '/bin'
    assert plain['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert plain['RMW_FASTRTPS_PUBLICATION_MODE'] == 'SYNCHRONOUS'
    assert plain['OMP_NUM_THREADS'] == '3', 'threads decide the bits: the setting wins'
    assert plain['OMP_WAIT_POLICY'] == 'PASSIVE'
    assert plain['GOMP_SPINCOUNT'] == '2000'
    assert opened['GOMP_SPINCOUNT'] == '7', 'no setting decides it, and it decides no bits'
    assert opened['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SUBNET'


def test_the_end_of_a_log_is_shown_whatever_is_in_it(tmp_path: Path) -> None:
    log = tmp_path / 'sim.log'
    log.write_bytes(b'x' * 50_000 + b'\n\xff\xfe\nlast\n\n')

    assert launcher.end_of_log(log, lines=2) == '\ufffd\ufffd\nlast'
    assert 'cannot be read: No such file' in launcher.end_of_log(tmp_path / 'none')


def test_a_run_on_a_robot_starts_the_robot_node_in_place_of_simulators(tmp_path):
    settings = tiny(task='robot/arm', pace='free', evaluate_every=0)
    there = prefix(tmp_path)
    (there / 'lib/sim_node/robot').write_text('')
    (there / 'lib/sim_node/robot').chmod(0o755)
    robot = {'mapping': '/a b/m.yaml', 'autostart': True}
    made = launcher.commands(
        settings, 'run', tmp_path, {'AMENT_PREFIX_PATH': str(there)}, robot=robot
    )
    assert [(c.name, c.role) for c in made] == [
        ('robot', 'sim'), ('reward', 'reward'), ('record', 'record'), ('learner', 'learner'),
    ]  # fmt: skip
    words = made[0].arguments
    assert words[0].endswith('lib/sim_node/robot')
    assert 'mapping:="/a b/m.yaml"' in words
    assert 'autostart:=true' in words
