"""Whether a bag is sound: everything that is wrong with it, from one pass.

It compares every CRC, index and summary of an MCAP file; metadata.yaml with what is there; our
recorder's numbering of each topic's messages; and the records of each run with what a run must be:
numbers without gaps, episodes that go on where they ended, one score for each segment, commits
that name what is there, finite numbers, one run to a namespace.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codetr_ros.bags import metadata
from codetr_ros.bags.dropped import DroppedInBag
from codetr_ros.bags.episodes import missing_numbers
from codetr_ros.bags.errors import BagError, Damage
from codetr_ros.bags.findings import Findings
from codetr_ros.bags.raw import RawMessage
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.run_checks import RunChecks


@dataclass(frozen=True)
class Verdict:
    """The findings on a bag, and the runs in it."""

    bag: Path
    findings: Findings
    messages: int
    runs: dict[tuple[str, str], RunChecks]  # by namespace and run id

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings.counts

    def report(self) -> dict[str, Any]:
        """As JSON."""
        return {
            'bag': str(self.bag),
            'sound': self.sound,
            'messages': self.messages,
            'found': dict(self.findings.counts),
            'findings': [finding._asdict() for finding in self.findings.named],
            'remarks': self.findings.remarks,
            'runs': [
                {
                    'namespace': namespace,
                    'run_id': run_id,
                    'phases_committed': run.phases,
                    'phases_whole': run.whole,
                    'steps_dropped': {
                        name: source.steps_dropped
                        for name, source in sorted(run.sources.items())
                        if source.phases_dropped
                    },
                }
                for (namespace, run_id), run in sorted(self.runs.items())
            ],
        }


class _Numbering:
    """Our recorder numbers the messages of each topic: none may be missing, whatever its type."""

    def __init__(self, findings: Findings) -> None:
        self._next: dict[str, int] = {}
        self._findings = findings

    def take(self, raw: RawMessage) -> None:
        if not raw.channel.numbered:
            return
        topic, number = raw.channel.topic, raw.sequence
        due = self._next.get(topic, 0)
        if number > due:
            text = f'{topic}: {missing_numbers(due, number - 1)} missing'
            self._findings.add('gap', raw.place, text)
        elif number < due:
            text = f'{topic}: message {number} comes again or out of order, {due} is next'
            self._findings.add('duplicate', raw.place, text)
        self._next[topic] = max(due, number + 1)


def verify(path: Path | str) -> Verdict:
    """Read a bag from end to end and compare everything in it that can be compared.

    Raises:
        BagError: there is no bag there that can be read at all.
    """
    findings = Findings()

    def damaged(damage: Damage) -> None:
        lost = f' ({damage.lost} bytes lost)' if damage.lost else ''
        findings.add('index' if damage.harmless else 'file', damage.place, damage.text + lost)

    bag = Bag(path, damaged, thorough=True)
    dropped = DroppedInBag(bag)
    runs: dict[tuple[str, str], RunChecks] = {}
    first: dict[str, str] = {}
    numbering = _Numbering(findings)
    refused: set[str] = set()
    messages = 0
    for raw in bag.raw():
        messages += 1
        numbering.take(raw)
        try:
            entry = bag.entry(raw)
        except BagError as error:  # not one of ours, whatever it calls itself
            if raw.channel.type not in refused:
                refused.add(raw.channel.type)
                findings.add('record', raw.place, str(error))
            continue
        if entry is None:
            continue
        namespace, run_id = key = entry.namespace, entry.record.run_id
        if key not in runs:
            runs[key] = RunChecks(namespace, run_id, findings, raw.channel.numbered)
            if first.setdefault(namespace, run_id) != run_id:
                text = f'two runs are mixed in {namespace}: {first[namespace]!r} and {run_id!r}'
                findings.add('run', entry.place, text)
        runs[key].take(entry, dropped.holds(entry))
    for run in runs.values():
        run.finish(bag.path)
    if bag.path.is_dir():
        topics = {
            name: (topic.type, topic.count, topic.encoding) for name, topic in bag.topics.items()
        }
        for text in metadata.check(bag.path, topics, bag.in_files):
            findings.add('metadata', bag.path, text)
    if bag.unchecked:
        findings.remarks.append(
            f'{bag.unchecked} chunks or messages carry no CRC: a bit changed in them goes '
            'unnoticed where the result is still a possible message'
        )
    return Verdict(bag.path, findings, messages, runs)
