"""Checks of one run in a bag, record by record."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors

from codetr_ros.bags.episodes import Numbers, SharedNumbers, SourceChecks
from codetr_ros.bags.findings import Findings
from codetr_ros.bags.reader import Entry
from codetr_ros.config import Lengths
from codetr_ros.config.cuts import Cuts
from codetr_ros.config.delays import LONGEST
from codetr_ros.records import (
    PROTOCOL_VERSION,
    Commit,
    CompositeReward,
    EpisodeResult,
    Policy,
    Preference,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
    describe,
)
from codetr_ros.records.chain import Chain, named, states_digests, void
from codetr_ros.records.checks import check_preference
from codetr_ros.records.numbering import Judgement
from codetr_ros.system.parsing import parse_json


class RunChecks:
    """Checks of everything with one run id in one namespace.

    Args:
        namespace: of the run's topics.
        run_id: its id.
        findings: where faults are added.
        ordered: whether a commit comes after all that it names, as our recorder writes it. Others
            write messages in the order in which they happen to arrive.
    """

    def __init__(
        self, namespace: str, run_id: str, findings: Findings, ordered: bool = True
    ) -> None:
        self.name = f'run {run_id!r} in {namespace}'
        self.sources: dict[str, SourceChecks] = {}
        self.phases = 0  # committed
        self.whole = 0  # phases, from the first on, that have all that their commits name
        self._ordered = ordered
        self._waiting: list[tuple[Commit, Any]] = []  # for what they name
        self._scorers: dict[str, Numbers] = {}
        self._findings = findings
        self._run: RunSpec | None = None
        self._cuts: Cuts | None = None
        self._missing = False  # whether segments may have no score
        self._elsewhere = False  # others than the simulator score, when and what they like
        self._permitted = 0
        self._parts: tuple[int, int, int] | None = None  # phase, next part, parts
        self._chain = Chain(1)
        self._made_of: dict[int, str] = {}  # phase -> digest of its commit
        self._stated = 0  # commits with digests
        self._take: dict[type, Callable[[Any, Any], None]] = {
            RunSpec: self._spec,
            TaskSpec: self._task,
            Transitions: lambda record, place: self._source(record).transitions(record, place),
            TrueRewards: lambda record, place: self._source(record).true_rewards(record, place),
            CompositeReward: self._score,
            Preference: self._preference,
            Commit: lambda record, place: self._waiting.append((record, place)),
            StepRewards: self._labels,
            Policy: self._policy,
            EpisodeResult: self._result,
        }

    def take(self, entry: Entry, dropped: bool = False) -> None:
        """Check the next record.

        Args:
            entry: of the bag.
            dropped: whether its source was left out of the phase.
        """
        check = self._take.get(entry.kind)
        if dropped:
            self._dropped(entry.record, entry.place)
        elif check is not None:
            check(entry.record, entry.place)
        self._chain.note(entry.record)
        while self._waiting and (self._ordered or self._arrived(self._waiting[0][0])):
            self._commit(*self._waiting.pop(0))

    def _arrived(self, commit: Commit) -> bool:
        """Whether the newest of everything that a commit names is there."""
        numbers = {name: source.numbers for name, source in self.sources.items()}
        out = void(commit)
        return all(
            key in out or last < 0 or (name in there and last < there[name].next)
            for key, last in named(commit).items()
            for name in (key[1],)
            for there in (numbers if key[0] is Transitions else self._scorers,)
        )

    def _dropped(self, record: Any, place: Any) -> None:
        """Check a record of a source that was left out."""
        if isinstance(record, Transitions):
            self._source(record).dropped(record, place)
        elif isinstance(record, CompositeReward):
            numbers = self._numbered(record)
            if record.sequence >= numbers.next:  # else it came after the commit
                numbers.take(record.sequence, place)

    def _void(self, commit: Commit) -> None:
        """Go on behind the numbers that a commit voids."""
        out = void(commit)
        for (kind, name), last in named(commit).items():
            if (kind, name) not in out:
                continue
            if kind is Transitions:
                source = self._source_of(name)
                source.ends.pop(commit.phase, None)
                source.phases_dropped += 1
                source.numbers.skip(last)
                source.commit(last)
            else:
                self._numbers_of(name).skip(last)

    def _source(self, record: Any) -> SourceChecks:
        return self._source_of(record.source)

    def _source_of(self, name: str) -> SourceChecks:
        if name not in self.sources:
            self.sources[name] = SourceChecks(name, self._cuts, self._findings, self._elsewhere)
        return self.sources[name]

    def _add(self, kind: str, place: Any, text: str) -> None:
        self._findings.add(kind, place, f'{self.name}: {text}')

    def _spec(self, record: RunSpec, place: Any) -> None:
        if self._run is not None:
            same = record.settings == self._run.settings
            which = 'the same' if same else 'other'
            self._add('run', place, f'announced again, with {which} settings')
            return
        self._run = record
        digest = hashlib.sha256(record.settings.encode()).hexdigest()
        if digest != record.settings_hash:
            self._add('run', place, f'settings have the hash {digest}, not {record.settings_hash}')
        if not 1 <= record.protocol_version <= PROTOCOL_VERSION:
            self._add(
                'run', place, f'protocol {record.protocol_version}, this is {PROTOCOL_VERSION}'
            )
        try:
            settings = parse_json(record.settings)
            Lengths.of(settings['delay'])  # refuses what is no delay
            self._cuts = Cuts(settings['delay'], record.seed)
            self._elsewhere = settings.get('scorer', 'simulator') != 'simulator'
            self._missing = self._elsewhere or settings.get('score_missing', 0) > 0
            free = settings.get('pace') == 'free'
            self._chain.lag = None if free else 1 + bool(settings.get('overlap'))
        except (ValueError, LookupError, TypeError) as error:
            self._add('run', place, f'settings cannot be read: {error}')
        for source in self.sources.values():
            source.cuts = self._cuts
            source.elsewhere = self._elsewhere

    def _task(self, record: TaskSpec, place: Any) -> None:
        source = self._source(record)
        if source.spec is not None and _values(source.spec) != _values(record):
            self._add('run', place, f'{record.source!r} announces another task than before')
        source.spec = record

    def _score(self, record: CompositeReward, place: Any) -> None:
        if not self._numbered(record).take(record.sequence, place):
            return
        if not np.isfinite(record.value) and not (self._missing and np.isnan(record.value)):
            self._add('value', place, f'{describe(record)} is not finite')
        if record.length < 1:
            self._add('value', place, f'{describe(record)} has no steps')
            return
        self._source(record).score(record, place)

    def _numbered(self, record: Judgement) -> Numbers:
        """The numbers of a scorer, whose scores and preferences have one sequence."""
        return self._numbers_of(record.scorer)

    def _numbers_of(self, scorer: str) -> Numbers:
        if scorer not in self._scorers:
            kind = SharedNumbers if self._elsewhere else Numbers
            self._scorers[scorer] = kind(f'composite rewards of {scorer!r}', self._findings)
        return self._scorers[scorer]

    def _preference(self, record: Preference, place: Any) -> None:
        if not self._numbered(record).take(record.sequence, place):
            return
        try:
            check_preference(record, LONGEST)
        except RecordError as error:
            self._add('value', place, str(error))
            return
        # both are looked for like segments that are scored
        first = CompositeReward(
            run_id=record.run_id,
            source=record.source,
            scorer=record.scorer,
            sequence=record.sequence,
            episode=record.episode,
            first_step=record.first_step,
            length=record.length,
            value=record.outcome,
        )
        second = replace(
            first,
            source=record.other_source,
            episode=record.other_episode,
            first_step=record.other_first_step,
            length=record.other_length,
        )
        for each in (first, second):
            self._source(each).score(each, place)

    def _commit(self, record: Commit, place: Any) -> None:
        if record.phase != self.phases:
            kind = 'gap' if record.phase > self.phases else 'duplicate'
            self._add(
                kind, place, f'commit of phase {record.phase} where phase {self.phases} is next'
            )
        whole = record.phase == self.phases == self.whole
        self.phases = max(self.phases, record.phase + 1)
        self._void(record)
        for name, last in zip(record.sources, record.transitions.tolist(), strict=True):
            if name in record.dropped:
                continue
            source = self.sources.get(name)
            there = source.numbers if source else None
            whole &= self._named('transitions', name, last, there, record.phase, place)
            if source is None:
                continue
            end = source.ends.pop(record.phase, None)
            if end != last and there and last < there.next:
                ends = 'none' if end is None else end
                self._add(
                    'commit', place, f'commit of phase {record.phase} ends with transitions '
                    f'{last} of {name!r}, the phase itself with {ends}'
                )  # fmt: skip
            source.commit(last)
        for name, last in zip(record.scorers, record.scores.tolist(), strict=True):
            if name in record.dropped:
                continue
            there = self._scorers.get(name)
            whole &= self._named('composite rewards', name, last, there, record.phase, place)
            if there is not None:
                there.commit(last)
        self.whole += whole
        self._digests(record, place)

    def _digests(self, record: Commit, place: Any) -> None:
        """Compare what a commit states with what the bag has, and go on behind it."""
        self._stated += states_digests(record)
        for text in self._chain.differences(record):
            self._add('digest', place, f'commit of phase {record.phase} has another of {text}')
        self._chain.follow(record)
        self._made_of[record.phase] = self._chain.last

    def _named(
        self, what: str, name: str, last: int, there: Numbers | None, phase: int, place: Any
    ) -> bool:
        """Whether everything is there up to the number that a commit names."""
        newest = there.next - 1 if there else -1
        if last > newest:
            self._add(
                'commit',
                place,
                f'commit of phase {phase} names {what} {last} of {name!r}, the newest before it '
                f'is {newest if newest >= 0 else "none"}',
            )
        return last < 0 or (there is not None and there.whole > last)

    def _labels(self, record: StepRewards, place: Any) -> None:
        expected = (record.phase, 0)
        if self._parts is not None:
            phase, part, parts = self._parts
            if part < parts:
                expected = (phase, part)
            elif record.phase <= phase:
                self._add('duplicate', place, f'{describe(record)} comes again')
        if (record.phase, record.part) != expected:
            self._add(
                'gap', place, f'{describe(record)} where part {expected[1]} of phase '
                f'{expected[0]} is next'
            )  # fmt: skip
        self._parts = record.phase, record.part + 1, record.parts
        made_of = self._made_of.get(record.phase, '')
        if record.commit and made_of and record.commit != made_of:
            self._add('digest', place, f'{describe(record)} was made of another commit')
        if not np.isfinite(record.labels).all():
            self._add('value', place, f'{describe(record)}: labels not finite')
        if not record.source:
            return
        source = self._source(record)
        spans = zip(
            record.episodes.tolist(), record.first_steps.tolist(), record.lengths.tolist(),
            strict=True,
        )  # fmt: skip
        if missing := [span for span in spans if not source.labelled(span)]:
            self._add(
                'record', place, f'{describe(record)} labels {len(missing)} segments that the bag '
                f'does not have, the first at episode {missing[0][0]} step {missing[0][1]}'
            )  # fmt: skip

    def _policy(self, record: Policy, place: Any) -> None:
        if not record.steps.any():
            return  # the last one: it permits nothing
        if record.phase != self._permitted:
            kind = 'gap' if record.phase > self._permitted else 'duplicate'
            self._add(
                kind, place, f'policy of phase {record.phase} where that of {self._permitted} '
                'is next'
            )  # fmt: skip
        self._permitted = max(self._permitted, record.phase + 1)
        try:
            tensors = load_tensors(record.weights) if record.weights else {}
        except SafetensorError as error:
            self._add('value', place, f'{describe(record)}: weights cannot be read: {error}')
            return
        for name, values in tensors.items():
            if not np.isfinite(values).all():
                self._add('value', place, f'{describe(record)}: weights of {name} not finite')

    def _result(self, record: EpisodeResult, place: Any) -> None:
        for name in ('true_return', 'composite_return', 'score'):
            if not np.isfinite(getattr(record, name)):
                self._add('value', place, f'{describe(record)}: {name} not finite')

    def finish(self, place: Any) -> None:
        """Report what never came, and add remarks on what is no fault."""
        for commit in self._waiting:
            self._commit(*commit)
        for numbers in self._scorers.values():
            numbers.finish(place)
        commits = self.phases > 0 or (self._run is not None and self._ordered)
        for source in self.sources.values():
            source.finish(self._scorers if commits else None, place)
            if source.phases_dropped:
                self._findings.remarks.append(
                    f'{self.name}: {source.name!r} was left out of {source.phases_dropped} phases '
                    f'in which it had steps to take; {source.steps_dropped} that came were dropped'
                )
            if commits and source.tail:
                self._findings.remarks.append(
                    f'{self.name}: the last {source.tail} transitions of {source.name!r} are of a '
                    'phase that was not committed'
                )
            if source.ahead:
                self._findings.remarks.append(
                    f'{self.name}: {source.ahead} scores and true rewards of {source.name!r} are '
                    'of steps that the bag does not have, of a phase that was not committed'
                )
            if self._cuts is None and source.steps > source.scored:
                self._findings.remarks.append(
                    f'{self.name}: {source.steps - source.scored} of {source.steps} steps of '
                    f'{source.name!r} are in no scored segment'
                )
            if source.spec is None and source.steps:
                if self._run is None:
                    self._findings.remarks.append(
                        f'{self.name}: {source.name!r} has not announced its task'
                    )
                else:
                    self._add('run', place, f'{source.name!r} has not announced its task')
        if self.phases > self._stated:
            self._findings.remarks.append(
                f'{self.name}: {self.phases - self._stated} commits state no digests (protocol '
                '1): a value that was changed with its checksum goes unnoticed there'
            )
        if self._run is None and self.phases:
            self._add(
                'run', place, 'has commits, but no settings: the record of the run is missing'
            )
        if self._parts is not None and self._parts[1] < self._parts[2]:
            phase, part, parts = self._parts
            self._findings.remarks.append(
                f'{self.name}: labels of phase {phase} end with part {part} of {parts}'
            )


def _values(record: TaskSpec) -> tuple[Any, ...]:
    return tuple(getattr(record, name) for name in TaskSpec.__slots__)
