"""A signal ends a node at any moment of its process, also while it imports."""

import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from codetr_ros.ros.signals import Stop, Stopped
from helpers.playing import output, process

SIGNALS = pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=lambda s: s.name)
IMPORTS = (
    'from codetr_ros.ros.signals import Stop\nStop().install(starting=True)\n'
    'print("imports", flush=True)\nimport endless\n'
)


@SIGNALS
def test_a_node_that_imports_what_makes_it_a_node_ends_at_once(tmp_path, number):
    (tmp_path / 'endless.py').write_text('import time\nwhile True: time.sleep(0.01)\n')
    node = subprocess.Popen(
        [sys.executable, '-c', IMPORTS],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {'PYTHONPATH': os.pathsep.join([str(tmp_path), *sys.path])},
    )
    try:
        assert node.stdout is not None
        assert node.stdout.readline() == 'imports\n'
        node.send_signal(number)
        _, said = node.communicate(timeout=180)
    finally:
        node.kill()
    assert (node.returncode, said) == (0, f'stopped by {number.name} before it had started\n')


@SIGNALS
@pytest.mark.parametrize('what', ['imports', 'compiles'])
def test_a_node_that_imports_or_compiles_takes_leave_and_ends(play, tmp_path, number, what):
    play = play(roles=('learner', 'sim', 'record'))
    took = [ended_by(play, tmp_path, number, what)]
    while min(took) >= 5.0 and len(took) < 3:  # the machine may have held it
        took.append(ended_by(play, tmp_path, number, what))
    assert min(took) < 5.0  # `ros2 launch` kills after ten


def ended_by(play, folder, number, what):
    """Seconds in which a signal ends a node that imports or compiles."""
    with process(what, f'folder:={folder}') as node:
        play.until(lambda: 'imports' in read(node), node)
        began = time.monotonic()
        node.send_signal(number)
        said = output(node)
        took = time.monotonic() - began
        play.until(lambda: play.presence_of('reward')[-1].finished)
    assert node.returncode == 0, said
    assert f'stopped by {number.name}' in said
    assert 'Traceback' not in said
    (folder / 'nodes' / 'reward-reward.json').unlink()
    return took


def read(node):
    """What the node has printed by now, without waiting for more."""
    if select.select([node.stdout], [], [], 0)[0]:
        return os.read(node.stdout.fileno(), 1 << 16).decode()
    return ''


def test_a_signal_that_an_import_has_caught_is_not_forgotten():
    stop = Stop().install()
    try:
        with pytest.raises(Stopped), stop.cutting_short(), suppress(BaseException):  # as some do
            os.kill(os.getpid(), signal.SIGTERM)
        assert stop.signal is signal.SIGTERM
        with pytest.raises(Stopped), stop.cutting_short():
            raise AssertionError('not entered')
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
