"""Algorithm 1 with plain calls instead of topics: the same cores, in the same order, in one
process.

A run over topics with the same seed, pace and thread count ends with the same weights. Here the
parts take turns, so evaluation lengthens the run by its own time; over topics no phase waits for
it.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch

from codetr_ros.config import Settings, settled
from codetr_ros.cores.core import Core
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.cores.people import SimulatedPeople
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.recording import RunBag
from codetr_ros.cores.simulator import Simulator
from codetr_ros.records import TOPICS, Record, RunSpec, StepRewards
from codetr_ros.records.identity import identity
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs import reports as node_reports
from codetr_ros.runs.reports import NodeReport

Attend = Callable[[Mapping[str, tuple[str, Core[Record]]]], None]
"""Takes the parts of a run, each with its role by its name, before they begin."""

MakeScorer = Callable[[RunSpec, Settings], Core[Record]]
"""Makes the part that scores, where others than the simulator do."""


@dataclass
class Member:
    """A part of a run, with what it has published and received so far, by topic."""

    role: str
    core: Core[Record]
    work: Iterator[Iterable[Record] | None]
    published: Counter[str] = field(default_factory=Counter)
    received: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    processor_seconds: float = 0.0


class Parts:
    """The parts of a run, and what passes between them.

    Args:
        settings: the run's settings, decided.
        run_id: its name.
        folder: where checkpoints and reports go; None: neither is written.
        observe: called with every record, in order.
        tick: called after every slice of work.
        scorer: makes who scores; None: simulated people, where the settings name them.
    """

    def __init__(
        self,
        settings: Settings,
        run_id: str,
        folder: Path | None,
        observe: Callable[[Record], None],
        tick: Callable[[], None],
        scorer: MakeScorer | None = None,
    ) -> None:
        self.settings = settings
        self.spec: RunSpec = settings.run_spec(run_id)
        self.bag: RunBag | None = None
        self.repeats: set[tuple[type, tuple[object, ...]]] = set()
        """What the bag holds already and will be published once more: it is dropped then."""
        self._folder = folder
        self._observe = observe
        self._tick = tick
        spec = self.spec
        checkpoints = folder / run_folder.CHECKPOINTS if folder else None
        self.simulators = {
            name: Simulator(spec, settings, name) for name in settings.simulator_names
        }
        if scorer is None and settings.scorer == 'simulated':
            scorer = SimulatedPeople
        self.people = None if scorer is None else scorer(spec, settings)
        self.recorder = Recorder(spec, settings, 'record')
        self.reward = (
            Labeller(spec, settings, 'reward', checkpoints) if settings.labels_steps else None
        )
        self.learner = Learner(spec, settings, 'learner', checkpoints)
        self.evaluator = Evaluator(spec, settings, 'evaluate')
        cores: dict[str, tuple[str, Core[Record]]] = {
            **{name: ('sim', core) for name, core in self.simulators.items()},
            **({'score': ('score', self.people)} if self.people is not None else {}),
            'record': ('record', self.recorder),
            **({'reward': ('reward', self.reward)} if self.reward is not None else {}),
            'learner': ('learner', self.learner),
            'evaluate': ('evaluate', self.evaluator),
        }
        self.members = {
            name: Member(role, core, core.work()) for name, (role, core) in cores.items()
        }

    @property
    def cores(self) -> dict[str, tuple[str, Core[Record]]]:
        """Role and core of each part, by its name."""
        return {name: (member.role, member.core) for name, member in self.members.items()}

    @property
    def finished(self) -> bool:
        """Whether every part has done all that the run asks of it."""
        return all(member.core.finished for member in self.members.values())

    def announce(self) -> None:
        """Begin the run."""
        if self.bag is not None:
            self.bag.write(self.spec)
        self._observe(self.spec)

    def slice(self, name: str) -> bool:
        """Let a part do a slice of its work; whether there was any."""
        records = self.given_by(name)
        for record in records or ():
            self.publish(name, record)
        return records is not None

    def given_by(self, name: str) -> list[Record] | None:
        """What a part yields after a slice of its work; None if there is nothing to do."""
        member = self.members[name]
        began, processor = time.perf_counter(), time.process_time()
        records = next(member.work)
        member.seconds += time.perf_counter() - began
        member.processor_seconds += time.process_time() - processor
        self._tick()
        return None if records is None else list(records)

    def publish(self, name: str, record: Record, without: str = '') -> None:
        """Record what a part has published, and hand it to all that take such records in, but for
        one that has it already.
        """
        kept, have_it = record, {without}
        if isinstance(record, StepRewards):
            # also of those that the bag holds: it keeps the first labels, commits name all
            self.recorder.receive(record)
            kept = self.recorder.kept(record)
            have_it.add('record')
        key = type(record), identity(record)
        if key in self.repeats:
            self.repeats.remove(key)
            return
        if self.bag is not None:
            self.bag.write(kept)
        self.count(name, record)
        for reader, member in self.members.items():
            if type(record) in member.core.subscribes and reader not in have_it:
                member.core.receive(record)
        self._observe(record)

    def count(self, name: str, record: Record) -> None:
        """Count a record that a part has published, and all that take it in."""
        topic = TOPICS[type(record)]
        self.members[name].published[topic] += 1
        for member in self.members.values():
            member.received[topic] += type(record) in member.core.subscribes

    def run(self) -> None:
        """Let all parts take turns until the run has ended.

        Raises:
            RuntimeError: every part waits for another, which is a fault of this program.
        """
        while not self.finished:
            busy = [name for name in self.members if self.slice(name)]
            if not busy and not self.finished:
                waiting = [n for n, member in self.members.items() if not member.core.finished]
                raise RuntimeError(
                    'every part of the run waits for another: '
                    f'{", ".join(waiting)} have not finished'
                )

    def end(self) -> dict[str, NodeReport]:
        """Close all parts and the bag; the report of each part, which is also written."""
        reports = {}
        for member in self.members.values():
            member.core.close()
        if self.bag is not None:
            self.bag.close()
        for name, member in self.members.items():
            reports[name] = node_reports.node_report(
                member.core.report(),
                role=member.role,
                name=name,
                published=+member.published,
                received=+member.received,
                refused={},
                cpu_s=member.processor_seconds,
                wall_s=member.seconds,
                finished=member.core.finished,
                error=None,
                own=self.bag.report() if self.bag is not None and name == 'record' else None,
            )
            if self._folder is not None:
                path = run_folder.report_path(self._folder, member.role, name)
                node_reports.write(path, reports[name])
        return reports


def run(
    settings: Settings,
    run_id: str,
    folder: Path | None = None,
    observe: Callable[[Record], None] = lambda record: None,
    tick: Callable[[], None] = lambda: None,
    attend: Attend = lambda cores: None,
    bag: bool = False,
    scorer: MakeScorer | None = None,
) -> dict[str, NodeReport]:
    """Run Algorithm 1 to its end.

    Args:
        settings: the run's settings; `threads` auto is decided here.
        run_id: its name.
        folder: where checkpoints and reports go; None: neither is written.
        observe: called with every record, in order. An error that it raises ends the run, after a
            checkpoint.
        tick: called after every slice of work; an error that it raises does the same.
        attend: called with the parts, each with its role by its name, before they begin.
        bag: record the run in the folder's bag.
        scorer: makes who scores; None: simulated people, where the settings name them.

    Returns:
        A report for each part of the run, as the nodes write them.

    Raises:
        BagError: the bag cannot be written.
        RuntimeError: every part waits for another, which is a fault of this program.
    """
    settings = settled(settings)
    torch.set_num_threads(settings.thread_count)
    parts = Parts(settings, run_id, folder, observe, tick, scorer)
    if bag and folder is not None:
        parts.bag = RunBag(folder / run_folder.BAG, settings, namespace_of(run_id))
    attend(parts.cores)
    return driven(parts, parts.announce)


def driven(parts: Parts, begin: Callable[[], None] = lambda: None) -> dict[str, NodeReport]:
    """Let a run begin and go on to its end; its reports, which are written however it ends."""
    try:
        begin()
        parts.run()
    finally:
        reports = parts.end()
    return reports


def namespace_of(run_id: str) -> str:
    """The namespace of a run unless the user names another."""
    return f'/run_{run_id}'
