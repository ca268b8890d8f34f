"""Forked processes behave as processes do that were executed: what the tests of runs rely on."""

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.forked import Forked


def forked(function: str, *arguments: str, folder: Path | None = None, **more: str) -> Forked:
    environment = os.environ | {'PYTHONUNBUFFERED': '1'} | more
    name = f'helpers.forked_programs:{function}'
    return Forked(('program', *arguments), environment, function=name, folder=folder)


def test_it_has_its_arguments_environment_folder_and_session(tmp_path):
    program = forked('shows', 'one', 'two', folder=tmp_path, CODETR_SEEN='yes')
    shown, _ = program.communicate(60)
    assert program.returncode == 0
    assert shown.split('\n') == [
        "['program', 'one', 'two'] yes",
        str(tmp_path),
        f'{program.pid} {program.pid}',
        'threads 1',
        '',
    ]


@pytest.mark.parametrize(
    ('what', 'code', 'shown'),
    [
        ('returns', 3, ''),
        ('exits', 4, ''),
        ('complains', 1, 'no such thing\n'),
        ('fails', 1, 'ZeroDivisionError'),
    ],
)
def test_it_ends_with_the_exit_code_and_the_complaint_of_its_program(what, code, shown):
    program = forked('ends', what)
    output, _ = program.communicate(60)
    assert program.returncode == code
    assert shown in output and output.count('at its exit\n') == 1


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM])
def test_a_signal_ends_it_and_is_its_exit_code(number):
    program = forked('waits')
    assert program.stdout.readline() == 'ready\n'
    assert program.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        program.wait(0.01)
    program.send_signal(number)
    assert program.wait(60) == program.poll() == -number
    program.kill()  # of what has ended does nothing
    program.communicate(60)


def test_it_ends_when_who_asked_for_it_does():
    program = forked('asks')
    other = int(program.stdout.readline())
    assert os.path.exists(f'/proc/{other}')
    program.kill()
    ended, _ = program.communicate(60)  # the other has written into the same pipe, and closed it
    assert ended == 'interrupted\n'


def test_more_threads_than_the_server_has_imported_with_are_refused():
    with pytest.raises(ValueError, match='OMP_NUM_THREADS = 2: a fork has 1 for good'):
        forked('shows', OMP_NUM_THREADS='2')


def test_random_numbers_are_its_own():
    first, second = (forked('draws').communicate(60)[0] for _ in range(2))
    assert first != second and len(first.split()) == 2


def test_without_a_server_nothing_is_left_behind():
    program = (
        'import sys, time\n'
        f'sys.path[:0] = {sys.path!r}\n'
        'import os\nfrom helpers.forked import Forked\n'
        "f = Forked(('x',), os.environ, function='helpers.forked_programs:waits')\n"
        'f.stdout.readline()\nprint(f.pid, flush=True)\ntime.sleep(600)\n'
    )
    tests = subprocess.Popen([sys.executable, '-c', program], stdout=subprocess.PIPE, text=True)
    number = int(tests.stdout.readline())
    ending = os.pidfd_open(number)
    tests.kill()
    tests.communicate()

    assert select.select([ending], [], [], 60)[0], 'it lives on'
    os.close(ending)
