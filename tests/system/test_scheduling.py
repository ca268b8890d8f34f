"""Every thread of a process is scheduled in real time, or it is stated why none is."""

import subprocess
import sys

PROGRAM = """
import os, threading
from codetr_ros.system.scheduling import real_time
threading.Thread(target=threading.Event().wait, daemon=True).start()
why = real_time()
kinds = {os.sched_getscheduler(int(task)) for task in os.listdir('/proc/self/task')}
assert (kinds == {os.SCHED_RR}) if why is None else ('rtprio 10' in why), (kinds, why)
os._exit(0)
"""


def test_all_threads_get_real_time_or_the_reason_is_stated():
    subprocess.run([sys.executable, '-c', PROGRAM], check=True, timeout=180)
