"""Run `codetr train --in-process` and note when its loop begins and ends, for `throughput.py`.

    python benchmarks/marked_train.py MARKS train [FLAGS]

writes to the file MARKS the times of the first permission to simulate and of the last phase's
commit, in nanoseconds. No file of an in-process run holds these times, but its summary receives
every record. The script imports only modules that the command imports itself, so that the
command's own times do not change.
"""

import json
import sys
import time
from pathlib import Path

from codetr_ros.cli import train
from codetr_ros.records import Commit, Policy, Record


class Marks(train.Summary):
    """A summary that notes times."""

    times: dict[type, int] = {}

    def receive(self, record: Record) -> None:
        """Note the first permission and the latest commit."""
        if isinstance(record, Policy):
            self.times.setdefault(Policy, time.time_ns())
        elif isinstance(record, Commit):
            self.times[Commit] = time.time_ns()
        super().receive(record)


def main() -> int:
    """Run the command line; returns the command's exit code."""
    path, _, *arguments = sys.argv[1:]
    train.Summary = Marks
    code = train.main([*arguments, '--in-process'])
    if code == 0:
        Path(path).write_text(json.dumps([Marks.times[Policy], Marks.times[Commit]]))
    return code


if __name__ == '__main__':
    sys.exit(main())
