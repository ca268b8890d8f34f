"""Bags written message by message by the recorder's own writer, here and in a child."""

import os
import subprocess
import sys
import textwrap

from mcap.stream_reader import StreamReader

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.topics import BagTopic
from helpers.builders import transitions

TRANSITIONS = BagTopic('/r/transitions', 'codetr_msgs/msg/Transitions', 100, False)
COMMITS = BagTopic('/r/commits', 'codetr_msgs/msg/Commit', 16, True)


def raw(sequence: int, **changes) -> bytes:
    record = transitions(sequence=sequence, **changes)
    return encode(record, sequence * 10**9)


def sequences(path) -> list[int]:
    """Sequence numbers in a file that may have lost its end."""
    found = []
    with path.open('rb') as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                if type(record).__name__ == 'Message':
                    found.append(record.sequence)
        except Exception as error:  # noqa: BLE001 - where the file was cut off
            found_end = type(error).__name__
            assert found_end in ('EndOfFile', 'InvalidMagic', 'RecordLengthLimitExceeded')
    return found


CHILD = """
    import sys
    from pathlib import Path
    sys.path[:0] = {paths!r}
    from codetr_ros.bags.writer import McapWriter
    from helpers.bag_writing import TRANSITIONS, raw
    writer = McapWriter(Path({folder!r}), [TRANSITIONS])
"""


def child(folder, body: str) -> subprocess.Popen:
    head = textwrap.dedent(CHILD).format(paths=sys.path, folder=str(folder))
    return subprocess.Popen(
        [sys.executable, '-c', head + textwrap.dedent(body)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ,
    )


def files(folder):
    """The files of a bag in order."""
    return sorted(folder.glob('*.mcap'), key=lambda path: int(path.stem.rsplit('_', 1)[1]))
