import os
import subprocess
import sys
from pathlib import Path

import pytest

from codetr_ros import cli
from codetr_ros.cli import doctor


def test_doctor_names_each_check_and_fails_only_if_one_does(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = doctor.Check('ROS', 'fail', 'not there', 'install it')
    good = [doctor.Check('torch', 'ok', '2.0'), doctor.Check('GPU', 'warn', 'hot', 'cool it')]
    monkeypatch.setattr(doctor, 'CHECKS', (lambda: good,))
    assert cli.main(['doctor']) == 0
    monkeypatch.setattr(doctor, 'CHECKS', (lambda: good, lambda: bad))
    assert cli.main(['doctor']) == 1

    lines = capsys.readouterr().out.splitlines()[-5:]
    assert lines == [
        'ok    torch: 2.0',
        'warn  GPU: hot',
        '      -> cool it',
        'fail  ROS: not there',
        '      -> install it',
    ]


@pytest.mark.parametrize(
    ('environ', 'status'),
    [
        ({}, 'ok'),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DOMAIN_ID': '7'}, 'ok'),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'warn'),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}, 'fail'),
        ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'EVERYWHERE'}, 'fail'),
        ({'ROS_DOMAIN_ID': 'mine'}, 'fail'),
        ({'ROS_DOMAIN_ID': '500'}, 'fail'),
    ],
)
def test_doctor_judges_discovery(environ: dict[str, str], status: str) -> None:
    check = doctor.discovery(environ)

    assert check.status == status
    assert bool(check.remedy) == (status != 'ok')


def test_doctor_counts_what_dead_processes_left_in_shared_memory(tmp_path: Path) -> None:
    assert doctor.leftovers(tmp_path).status == 'ok'
    for segment in ('fastrtps_0123456789abcdef', 'fastrtps_fedcba9876543210'):
        (tmp_path / segment).write_bytes(bytes(1_000_000))
        (tmp_path / f'{segment}_el').touch()
    (tmp_path / 'other').write_bytes(bytes(1000))

    check = doctor.leftovers(tmp_path)
    assert check.status == 'warn'
    assert '4 files of dead processes' in check.detail
    assert '2.0 MB' in check.detail
    assert 'shm clean' in check.remedy

    import fcntl

    with (tmp_path / 'fastrtps_0123456789abcdef_el').open('rb') as alive:
        fcntl.flock(alive, fcntl.LOCK_EX)
        assert '2 files of dead processes' in doctor.leftovers(tmp_path).detail


def test_doctor_says_when_shared_memory_is_missing(tmp_path: Path) -> None:
    assert doctor.shared_memory(tmp_path / 'none').status == 'warn'


def test_doctor_finds_out_what_draws_and_names_why_nothing_does() -> None:
    environ = {name: value for name, value in os.environ.items() if name != 'MUJOCO_GL'}
    found = doctor.drawing(environ)
    assert found.status in ('ok', 'warn')
    assert ('egl' in found.detail) or ('osmesa' in found.detail)

    none = doctor.drawing(environ | {'MUJOCO_GL': 'disable'})
    assert (none.status, none.detail[:14]) == ('warn', 'none: disable:')
    assert 'reports have no frames of the robot' in none.remedy


def test_doctor_goes_on_where_mujoco_cannot_be_imported_with_its_driver() -> None:
    program = 'from codetr_ros.cli import doctor; print(doctor.simulators())'
    done = subprocess.run(
        [sys.executable, '-c', program],
        env=os.environ | {'MUJOCO_GL': 'nothing'},
        capture_output=True,
        text=True,
        check=False,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    assert "status='fail'" in done.stdout
    assert 'MUJOCO_GL=nothing' in done.stdout
    assert 'unset MUJOCO_GL' in done.stdout
