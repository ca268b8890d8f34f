"""Processes of this machine are known to live or to have ended, all others are not judged."""

import os
import subprocess
import sys

from codetr_ros.system.liveness import has_ended, own_name

NAMES_ITSELF = (
    'from codetr_ros.system.liveness import own_name\nprint(own_name(), flush=True)\ninput()\n'
)


def test_a_process_lives_until_it_has_ended():
    assert own_name()
    assert not has_ended(own_name())
    other = subprocess.Popen(
        [sys.executable, '-c', NAMES_ITSELF],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout is not None
    name = other.stdout.readline().strip()
    assert str(other.pid) in name
    assert not has_ended(name)
    other.kill()
    os.waitid(os.P_PID, other.pid, os.WEXITED | os.WNOWAIT)
    assert has_ended(name), 'before anybody has waited for it'
    other.communicate()
    assert has_ended(name)


def test_a_process_that_has_got_the_id_of_another_is_not_the_other():
    place, pid, started = own_name().split('-')
    assert has_ended(f'{place}-{pid}-{int(started) - 1}')


def test_of_a_process_of_another_machine_nothing_is_known():
    _, pid, started = own_name().split('-')
    for name in (f'elsewhere-{pid}-{started}', '', 'sim of the test', f'{own_name()[:12]}-x-1'):
        assert not has_ended(name)
