"""How a node's process ends when the middleware does not let go of it."""

import subprocess
import sys

import pytest

HANGS = (
    'from codetr_ros.ros.signals import Stop\nimport ctypes, signal, sys\n'
    'print("saved")\n'
    'Stop().install().end_within(1, int(sys.argv[1]))\n'
    'signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})\n'
    'def middleware():\n'
    '    ctypes.PyDLL(None).pause()\n'  # in C, and holds the interpreter
    'middleware()\n'
)


@pytest.mark.parametrize('code', [0, 1])
def test_a_node_that_hangs_at_its_very_end_says_where_and_ends_with_its_own_exit_code(code):
    done = subprocess.run(
        [sys.executable, '-c', HANGS, str(code)],
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )

    assert done.returncode == code
    assert done.stdout == 'saved\n'
    assert 'in middleware' in done.stderr
