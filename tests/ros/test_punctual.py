"""A process that must not wait for others sends nothing through shared memory."""

import os
import re
import subprocess
import sys

import pytest

from codetr_ros.processes import middleware

PROGRAM = """
import os, sys
from pathlib import Path
from codetr_ros.ros.link import Link
from codetr_ros.ros.process import in_ros

def body(arguments, stop):
    link = Link('punctual')
    threads = {path.read_text().strip() for path in Path('/proc/self/task').glob('*/comm')}
    for kind in ('shm', 'udp'):
        print(kind, any(name.startswith('dds.' + kind) for name in threads))
    link.close()
    return 0

sys.exit(in_ros('punctual', [], None, body, punctual=sys.argv[1] == 'True'))
"""


@pytest.mark.skipif(not os.path.isdir('/proc/self/task'), reason='needs the threads in /proc')
@pytest.mark.parametrize('punctual', [True, False])
def test_only_a_punctual_node_has_no_shared_memory(ros_domain, punctual):
    for visible in ('LOCALHOST', 'SUBNET'):
        environ = {k: v for k, v in os.environ.items() if k != middleware.PROFILE}
        environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = visible
        done = subprocess.run(
            [sys.executable, '-c', PROGRAM, str(punctual)],
            env=environ, capture_output=True, text=True, check=True, timeout=180,
        )  # fmt: skip
        # the middleware prints there too, where a port that it looks for is taken
        used = dict(re.findall(r'^(shm|udp) (\w+)$', done.stdout, re.MULTILINE))
        assert used == {'shm': str(not punctual), 'udp': 'True'}, done.stdout
