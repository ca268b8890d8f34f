"""When to publish each message of a bag: in its order, and never ahead of what the run permitted.

In a run the learner permits phase k once it has learnt from phase k - lag, which bounds what is
under way. In playback, phase k goes out once every role that learns from it has published its
`Metrics` of phase k - lag. So nothing overruns these roles, and they receive and learn the same as
in the run, in the same order. No ROS needed.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from pydantic import Field

from codetr_ros.bags.causal import causal
from codetr_ros.bags.definitions import encode, is_own
from codetr_ros.bags.older import as_now
from codetr_ros.bags.played_commits import PlayedCommits
from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings, SettingsError, from_canonical
from codetr_ros.records import (
    TOPICS,
    Commit,
    Metrics,
    Policy,
    Presence,
    Record,
    RunSpec,
    ScoreRequest,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.chain import named, publisher, void
from codetr_ros.records.digests import digest
from codetr_ros.records.numbering import Judgement, Numbering
from codetr_ros.runs.reports import CoreReport

BATCH = 64
"""The most messages in a slice."""


class PlayError(RuntimeError):
    """A bag that cannot be played: names the bag, the reason and the remedy."""


class Item(NamedTuple):
    """A message to be published."""

    record: Record
    data: bytes  # as this version writes it; empty: it is another record than in the bag
    log_time: int  # [ns] when it was received


@dataclass(frozen=True)
class RecordedRun:
    """A run in a bag.

    Attributes:
        run: its announcement.
        settings: its settings.
        sources: names of its sources.
        phases: how many were committed; the run may have been meant to have more.
    """

    run: RunSpec
    settings: Settings
    sources: tuple[str, ...]
    phases: int

    def cut(self) -> 'RecordedRun':
        """The same run, announced with as many steps as were committed, so that the nodes which
        learn from it finish with it.
        """
        steps = min(self.settings.steps, self.phases * self.settings.phase_steps)
        if steps == self.settings.steps:
            return self
        settings = self.settings.changed({'steps': steps})
        run = settings.run_spec(self.run.run_id)
        return RecordedRun(run, settings, self.sources, self.phases)


def recorded_run(bag: Bag, run_id: str | None = None) -> RecordedRun:
    """Read through a bag for the run that it holds.

    Args:
        bag: the bag.
        run_id: which run, where it holds several.

    Raises:
        PlayError: it holds no such run, several, or nothing that was committed.
        BagError: it is damaged.
    """
    runs: dict[str, RunSpec] = {}
    sources: dict[str, set[str]] = {}
    phases: Counter[str] = Counter()
    for entry in bag.entries({RunSpec, TaskSpec, Commit}):
        record = as_now(entry.record)
        if isinstance(record, RunSpec):
            runs[record.run_id] = record
        elif isinstance(record, TaskSpec):
            sources.setdefault(record.run_id, set()).add(record.source)
        elif isinstance(record, Commit):
            phases[record.run_id] = record.phase + 1
    wanted = [name for name in runs if run_id in (None, name)]
    if len(wanted) != 1:
        there = ', '.join(runs) or 'none'
        raise PlayError(
            f'{bag.path} holds {len(wanted)} runs {"" if run_id is None else f"{run_id!r} "}to be '
            f'played (there are: {there}): choose one with --run, or another bag'
        )
    run = runs[wanted[0]]
    if not phases[run.run_id]:
        raise PlayError(
            f'{bag.path}: no phase of run {run.run_id!r} was committed, and nothing was learnt '
            'from it: play another bag'
        )
    try:
        settings = from_canonical(run.settings, f'{bag.path}: run {run.run_id!r}')
    except SettingsError as error:
        raise PlayError(str(error)) from None
    names = tuple(sorted(sources.get(run.run_id, ())))
    return RecordedRun(run, settings, names, phases[run.run_id])


def items(bag: Bag, run_id: str) -> Iterator[Item]:
    """The messages of a run, in the bag's order. Its announcement and presence, which another
    recorder may have kept, are left out: playback publishes its own.

    Raises:
        BagError: the bag is damaged.
    """
    for raw in bag.raw():
        entry = bag.entry(raw)
        if entry is None or entry.kind in (RunSpec, Presence):
            continue
        if entry.record.run_id == run_id:
            record = as_now(entry.record)
            same = record is entry.record and is_own(raw.channel.type, raw.channel.definition)
            data = bytes(raw.data) if same else encode(record, entry.publish_time)
            yield Item(record, data, entry.log_time)


class Pace:
    """When messages are due at the pace at which they were recorded.

    Args:
        rate: how many times as fast.
        clock: seconds.
    """

    def __init__(self, rate: float = 1.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock = clock
        self._first: tuple[int, float] | None = None

    def due(self, log_time: int) -> bool:
        """Whether it is time for a message; the first one is due at once."""
        now = self._clock()
        if self._first is None:
            self._first = log_time, now
        recorded, began = self._first
        return now - began >= (log_time - recorded) / 1e9 / self._rate

    def restart(self) -> None:
        """Start again from the next message, after a wait for a role."""
        self._first = None


class PlaybackReport(CoreReport):
    """What was played."""

    phases: int = Field(description='phases played whole')


class Playback:
    """Yields the messages of a run, in slices, as fast as the roles that learn from them follow.

    Args:
        messages: of the run, in the bag's order.
        phases: how many to play.
        lag: phases from the one learnt from to the last that may be under way.
        learners: roles to wait for. If there are any, messages that belong to no phase that is
            played are left out.
        pace: when a message is due at the earliest; None: at once.
        commits: completes the commits; None: they go out as they were recorded.
    """

    missing = unlabelled = uncommitted = unpermitted = None  # it takes no phases in
    unannounced = False
    left_out: frozenset[str] = frozenset()
    gone_by: Collection[int] = ()
    due = permitted = None

    def __init__(
        self,
        messages: Iterable[Item],
        phases: int,
        lag: int,
        learners: Collection[str],
        pace: Pace | None = None,
        commits: PlayedCommits | None = None,
    ) -> None:
        self._commits = commits
        self.subscribes: tuple[type, ...] = (Metrics, *(commits.subscribes if commits else ()))
        self._messages = causal(messages, lag)
        self._phases = phases
        self._lag = lag
        self._pace = pace
        self._handled = dict.fromkeys(learners, -1)
        self._due: Counter[tuple[type, str]] = Counter()  # next sequence number of each publisher
        self._numbers: defaultdict[str, Numbering] = defaultdict(Numbering)  # of each scorer
        self._waiting = ''
        self.phase = -1  # the last whose commit was yielded
        self.counters: Counter[str] = Counter()
        self.duplicated: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.finished = False

    def receive(self, record: Record) -> None:
        """Note that a role has handled a phase, or what it has made for the next."""
        if self._commits is not None and isinstance(record, self._commits.subscribes):
            self._commits.note(record, recorded=False)
        if isinstance(record, Metrics) and record.role in self._handled:
            self._handled[record.role] = max(self._handled[record.role], record.phase)

    def fetched(self, phase: int) -> None:
        """Do nothing: no phase is missing."""

    def work(self) -> Iterator[list[Item] | None]:
        """Slices of a few messages; None while waiting for a role or for the time.

        Raises:
            PlayError: the bag lacks something that belongs to a phase.
        """
        batch: list[Item] = []
        for item in self._messages:
            if not self._wanted(item.record):
                continue
            while (reason := self._held_back(item)) is not None:
                if batch:
                    yield batch
                    batch = []
                self._waiting = reason
                yield None
            if isinstance(item.record, Commit):
                self._check(item.record)
                self.phase = item.record.phase
            batch.append(self._played(item))
            if len(batch) == BATCH:
                yield batch
                batch = []
        yield batch
        while late := self._late(self._phases - 1):
            self._waiting = late
            yield None
        self.finished = True
        while True:
            yield None

    def _played(self, item: Item) -> Item:
        """A message as it goes out.

        Raises:
            PlayError: a commit states otherwise what is played.
        """
        record, commits = item.record, self._commits
        if commits is None:
            return item
        if isinstance(record, Commit):
            record, differing = commits.completed(record)
            if differing:
                raise PlayError(
                    f'phase {record.phase} is not what its commit states: {"; ".join(differing)} '
                    'differ. `codetr bag verify` names all that differs; play another bag'
                )
        else:
            commits.note(record, recorded=True)
            if isinstance(record, StepRewards):
                record = commits.labelled(record)
        same = record is item.record or (
            isinstance(record, Commit) and digest(record) == digest(item.record)
        )
        return item if same else Item(record, b'', item.log_time)

    def _held_back(self, item: Item) -> str | None:
        """Why a message may not go out yet."""
        record = item.record
        if isinstance(record, Transitions) and (late := self._late(record.phase - self._lag)):
            if self._pace is not None:
                self._pace.restart()
            return late
        lacking = isinstance(record, Commit) and self._commits and self._commits.lacks(record)
        if lacking:
            return lacking
        if self._pace is not None and not self._pace.due(item.log_time):
            return 'the time at which the next message was recorded'
        return None

    def _late(self, phase: int) -> str:
        late = [role for role, handled in self._handled.items() if handled < phase]
        return f'{" and ".join(late)}, to have learnt from phase {phase}' if late else ''

    def _wanted(self, record: Record) -> bool:
        """Whether a record is to be played: not twice, and not what no commit names."""
        topic = TOPICS[type(record)]
        if self._handled and self._surplus(record):
            self.counters[f'{topic} of no phase that is played'] += 1
            return False
        if isinstance(record, Judgement):
            return self._new(record)
        if not isinstance(record, Transitions):
            return True
        key = publisher(record)
        if record.sequence < self._due[key]:
            self.counters[f'{topic} recorded twice'] += 1
            return False
        if record.sequence > self._due[key]:
            self._lacks(key, record.sequence - 1)
        self._due[key] += 1
        self.counters['steps'] += record.steps
        return True

    def _new(self, judgement: Judgement) -> bool:
        """Whether a judgement is played for the first time; scores and preferences come on two
        topics, so that a number may come before one below it.
        """
        key = publisher(judgement)
        if not self._numbers[key[1]].take(judgement.sequence):
            self.counters[f'{TOPICS[type(judgement)]} recorded twice'] += 1
            return False
        self._due[key] = self._numbers[key[1]].next
        return True

    def _surplus(self, record: Record) -> bool:
        if isinstance(record, Policy) and not record.steps.any():
            return False  # it announces that all phases have been permitted
        if isinstance(
            record, (Policy, Transitions, TrueRewards, Commit, StepRewards, ScoreRequest)
        ):
            return record.phase >= self._phases
        # a score does not name its phase: the commit does
        return isinstance(record, Judgement) and self.phase == self._phases - 1

    def _check(self, commit: Commit) -> None:
        """Refuse a commit that names something not played."""
        out = void(commit)
        for key, number in named(commit).items():
            if key in out:
                self.counters['phases of a source dropped'] += key[0] is Transitions
                self._numbers[key[1]].skip(number)
                self._due[key] = max(self._due[key], number + 1)
            elif number >= self._due[key]:
                self._lacks(key, number)

    def _lacks(self, key: tuple[type, str], last: int) -> None:
        raise PlayError(
            f'{TOPICS[key[0]]} {self._due[key]} to {last} of {key[1]!r} are not in the bag, after '
            f'phase {self.phase} was played: `codetr bag verify` lists what else is missing'
        )

    def done(self, role: str) -> bool:
        """Whether a role has learnt from all that is played; true of roles not waited for."""
        return self._handled.get(role, self._phases) >= self._phases - 1

    def waiting_for(self) -> str:
        """What the next message waits for, in words."""
        return self._waiting

    def close(self) -> None:
        """Nothing to save."""

    def report(self) -> PlaybackReport:
        """The counts so far."""
        return PlaybackReport(counters=dict(self.counters), phases=self.phase + 1)
