"""A recorder that is killed loses nothing that anybody has learnt from."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rclpy.serialization import deserialize_message, serialize_message

from codetr_ros.records import Commit, CompositeReward, Transitions
from codetr_ros.ros import messages
from codetr_ros.runs import folder as run_folder
from helpers.builders import tiny
from helpers.nodes import Nodes, Witness, domain

ENDLESS = 10_000_000  # steps
KILLED_IN = 5  # phase


class Listener:
    """What another subscriber than the nodes of the run has heard, as bytes."""

    def __init__(self, witness: Witness) -> None:
        self.heard: dict[type, list[bytes]] = {
            kind: [] for kind in (Transitions, CompositeReward, Commit)
        }
        self.commits_of_what_is_heard = 0
        for kind in self.heard:
            witness.link.subscribe(kind, self._store)

    def _store(self, kind: type, raw: bytes) -> None:
        self.heard[kind].append(raw)
        # the run does not wait until others hear it, too: they may find each topic seconds late
        self.commits_of_what_is_heard += kind is Commit and all(self.heard.values())

    def reached(self, kind: type, phase: int) -> bool:
        """Whether something of this kind and phase has been heard."""
        found = self.heard[kind]
        return bool(found) and decoded(kind, found[-1]).phase >= phase


def decoded(kind: type, raw: bytes) -> Any:
    return deserialize_message(raw, messages.message_type(kind))


def files(bag: Path) -> list[Path]:
    """The files of a bag in order."""
    return sorted(bag.glob('*.mcap'), key=lambda path: int(path.stem.rsplit('_', 1)[1]))


def read(bag: Path) -> dict[str, list[bytes]]:
    """Messages of a bag whose last file may have no end, by topic; checksums are compared."""
    found: dict[str, list[bytes]] = {}
    for path in files(bag):
        channels = {}
        with path.open('rb') as file:
            records = StreamReader(file, validate_crcs=True).records
            while True:
                try:
                    record = next(records)
                except (StopIteration, McapError):
                    break
                if type(record).__name__ == 'Channel':
                    channels[record.id] = record.topic.rsplit('/', 1)[1]
                elif type(record).__name__ == 'Message':
                    found.setdefault(channels[record.channel_id], []).append(record.data)
    return found


MOMENTS: dict[str, Callable[[Listener, Path], bool]] = {
    'amid the steps of a phase': lambda heard, bag: heard.reached(Transitions, KILLED_IN),
    'at a commit': lambda heard, bag: heard.reached(Commit, KILLED_IN),
    'amid a file': lambda heard, bag: sum(p.stat().st_size for p in files(bag)) > 250_000,
}


@pytest.mark.slow
@pytest.mark.parametrize('moment', MOMENTS)
def test_every_commit_that_was_heard_is_in_the_bag_with_all_that_it_names(tmp_path, moment):
    settings = tiny(steps=ENDLESS, memory_steps=10_000, evaluate_every=0)
    bag = tmp_path / 'run' / run_folder.BAG
    with domain(), Nodes(settings, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        listener = Listener(witness)
        for name in nodes.names:
            nodes.start(name, *(['bag_split_mb:=0.1'] if name == 'record' else []))
        witness.until(
            lambda: MOMENTS[moment](listener, bag) and listener.commits_of_what_is_heard > 3
        )
        nodes.send(signal.SIGKILL, 'record')
        assert nodes.wait('record')['record'] == -signal.SIGKILL
        witness.until(lambda: True)  # what it has published before it died
    check(read(bag), listener)
    *whole, _ = files(bag)
    assert whole
    for path in whole:
        with path.open('rb') as file:
            assert make_reader(file, validate_crcs=True).get_summary().statistics.message_count


def check(bag: dict[str, list[bytes]], listener: Listener) -> None:
    """Compare what the bag has with what was heard."""
    commits = [decoded(Commit, raw) for raw in listener.heard[Commit]]
    assert len(commits) >= 3
    recorded = {
        (c.phase, bytes(serialize_message(c)))
        for c in (decoded(Commit, raw) for raw in bag['commits'])
    }
    for commit in commits:
        assert (commit.phase, bytes(serialize_message(commit))) in recorded
    for kind, topic, who, names, numbers in (
        (Transitions, 'transitions', 'source', 'sources', 'transitions'),
        (CompositeReward, 'composite_rewards', 'scorer', 'scorers', 'scores'),
    ):
        heard = {number(kind, who, raw): raw for raw in listener.heard[kind]}
        there = {number(kind, who, raw): raw for raw in bag[topic]}
        for name, last in zip(
            getattr(commits[-1], names), np.asarray(getattr(commits[-1], numbers)), strict=True
        ):
            first = min(sequence for who_said, sequence in heard if who_said == name)
            assert first < last
            for sequence in range(last + 1):
                assert (name, sequence) in there
                # who listens and is slow misses some
                assert heard.get((name, sequence), there[name, sequence]) == there[name, sequence]


def number(kind: type, who: str, raw: bytes) -> tuple[str, int]:
    message = decoded(kind, raw)
    return getattr(message, who), message.sequence
