"""`codetr train --in-process` that also notes when its loop began and ended; for `throughput.py`.

    python benchmarks/marked_train.py MARKS train [FLAGS]

writes to the file MARKS when the first permission to simulate was given and when the last phase
was committed, in nanoseconds. No file of an in-process run says so, but its summary is handed
every record. Nothing is imported before the command that the command would not import itself, so
that the command's own times stay what they are.
"""

import json
import sys
import time
from pathlib import Path

from codetr_ros.cli import train
from codetr_ros.records import Commit, Policy, Record


class Marks(train.Summary):
    """A summary that looks at the clock."""

    found: dict[type, int] = {}

    def receive(self, record: Record) -> None:
        """Note the first permission and the latest commit."""
        if isinstance(record, Policy):
            self.found.setdefault(Policy, time.time_ns())
        elif isinstance(record, Commit):
            self.found[Commit] = time.time_ns()
        super().receive(record)


def main() -> int:
    """The command line; the command's exit code."""
    path, _, *arguments = sys.argv[1:]
    train.Summary = Marks
    code = train.main([*arguments, '--in-process'])
    if code == 0:
        Path(path).write_text(json.dumps([Marks.found[Policy], Marks.found[Commit]]))
    return code


if __name__ == '__main__':
    sys.exit(main())
