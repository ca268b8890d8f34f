"""What is in a bag, counted in one pass."""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from codetr_ros.bags.dropped import DroppedInBag
from codetr_ros.bags.errors import Damage
from codetr_ros.bags.reader import Bag
from codetr_ros.records import (
    Commit,
    CompositeReward,
    EpisodeResult,
    Policy,
    Preference,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
)
from codetr_ros.system.parsing import ParseError, parse_json

SETTINGS = (
    *('task', 'composite', 'delay', 'score_missing', 'score_noise', 'score_levels', 'scorer'),
    *('method', 'steps', 'seed', 'simulators', 'envs'),
)
"""The settings that are shown."""
_SMALL = 2.0**-64  # a sum of numbers so much smaller cannot overflow, and is as exact


@dataclass
class Range:
    """Count, lowest, highest and mean of numbers. Those that are not finite are only counted."""

    count: int = 0
    not_finite: int = 0
    low: float = float('inf')
    high: float = float('-inf')
    total: float = 0.0  # times `_SMALL`

    def add(self, value: float) -> None:
        """Include a number."""
        if not math.isfinite(value):
            self.not_finite += 1
            return
        self.count += 1
        self.low = min(self.low, value)
        self.high = max(self.high, value)
        self.total += value * _SMALL

    def report(self) -> dict[str, float | int]:
        """As JSON; only the count where there are no numbers."""
        summary: dict[str, float | int] = {'count': self.count}
        if self.count:
            mean = self.total / self.count / _SMALL
            summary |= {'min': self.low, 'max': self.high, 'mean': mean}
        return summary | ({'not_finite': self.not_finite} if self.not_finite else {})


@dataclass
class SourceCounts:
    """A simulator or robot in a run."""

    task: str = ''
    observation_size: int = 0
    action_size: int = 0
    horizon: int = 0
    steps: int = 0
    steps_dropped: int = 0  # of `steps`: of phases that it was left out of
    phases_dropped: int = 0  # in which it had steps to take
    chunks: int = 0
    episodes: int = 0  # begun
    terminated: int = 0
    truncated: int = 0


@dataclass
class RunCounts:
    """A run in a bag: everything with one run id in one namespace."""

    namespace: str
    run_id: str
    settings: dict[str, Any] = field(default_factory=dict)
    sources: dict[str, SourceCounts] = field(default_factory=dict)
    phases: Range = field(default_factory=Range)
    scores: Range = field(default_factory=Range)
    scored_steps: int = 0
    unscored: int = 0  # segments without a score
    preferences: int = 0
    scorers: dict[str, int] = field(default_factory=dict)  # judgements of each
    policy_versions: Range = field(default_factory=Range)
    model_versions: Range = field(default_factory=Range)
    labels: int = 0
    evaluations: dict[int, Range] = field(default_factory=dict)  # true return, by step

    def take(self, record: Any, dropped: bool = False) -> None:
        """Count a record; `dropped` if its source was left out of the phase."""
        if isinstance(record, RunSpec):
            self._settings(record)
        elif isinstance(record, TaskSpec):
            source = self.sources.setdefault(record.source, SourceCounts())
            source.task, source.horizon = record.task, record.horizon
            source.observation_size = record.observation_size
            source.action_size = record.action_size
        elif isinstance(record, Transitions):
            self._steps(record, dropped)
        elif isinstance(record, CompositeReward):
            self.scorers[record.scorer] = self.scorers.get(record.scorer, 0) + 1
            if math.isnan(record.value) and self._may_lack_scores:
                self.unscored += 1
            else:
                self.scores.add(record.value)
                self.scored_steps += record.length
        elif isinstance(record, Preference):
            self.scorers[record.scorer] = self.scorers.get(record.scorer, 0) + 1
            self.preferences += 1
        elif isinstance(record, Commit):
            self.phases.add(record.phase)
            for name in set(record.dropped) & set(record.sources):
                self.sources.setdefault(name, SourceCounts()).phases_dropped += 1
        elif isinstance(record, Policy):
            self.policy_versions.add(record.version)
        elif isinstance(record, StepRewards):
            self.model_versions.add(record.version)
            self.labels += len(record.labels)
        elif isinstance(record, EpisodeResult) and record.purpose == 'evaluation':
            self.evaluations.setdefault(record.step, Range()).add(record.true_return)

    @property
    def _may_lack_scores(self) -> bool:
        elsewhere = self.settings.get('scorer', 'simulator') != 'simulator'
        return elsewhere or bool(self.settings.get('score_missing'))

    def _settings(self, record: RunSpec) -> None:
        try:
            settings = parse_json(record.settings)
        except ParseError:
            return  # `verify` reports it
        if isinstance(settings, dict):
            self.settings = {name: _plain(settings[name]) for name in SETTINGS if name in settings}

    def _steps(self, record: Transitions, dropped: bool) -> None:
        source = self.sources.setdefault(record.source, SourceCounts())
        source.observation_size = record.observations.shape[1]
        source.action_size = record.actions.shape[1]
        source.steps += record.steps
        source.steps_dropped += record.steps * dropped
        source.chunks += 1
        source.episodes += record.first_step == 0
        source.terminated += record.terminated
        source.truncated += record.truncated

    def report(self) -> dict[str, Any]:
        """As JSON."""
        return {
            'namespace': self.namespace,
            'run_id': self.run_id,
            'settings': self.settings,
            'sources': {name: vars(source) for name, source in sorted(self.sources.items())},
            'steps': sum(source.steps for source in self.sources.values()),
            'episodes': sum(source.episodes for source in self.sources.values()),
            'phases': self.phases.report(),
            'segments_scored': self.scores.count + self.scores.not_finite,
            'steps_scored': self.scored_steps,
            'segments_unscored': self.unscored,
            'scores': self.scores.report(),
            'preferences': self.preferences,
            'scorers': dict(sorted(self.scorers.items())),
            'policy_versions': self.policy_versions.report(),
            'model_versions': self.model_versions.report(),
            'labels': self.labels,
            'evaluations': {n: r.report() for n, r in sorted(self.evaluations.items())},
        }


def _plain(value: Any) -> Any:
    """A value of damaged settings as strict JSON, which has no NaN: such a value becomes text."""
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except ValueError:
        return str(value)


def survey(path: Path | str) -> dict[str, Any]:
    """What is in a bag, as JSON. Faults are counted and do not end the survey.

    Raises:
        BagError: there is no bag there, or its messages are not those that we read.
    """
    faults = 0

    def damaged(_: Damage) -> None:
        nonlocal faults
        faults += 1

    bag = Bag(path, damaged)
    dropped = DroppedInBag(bag)
    runs: dict[tuple[str, str], RunCounts] = {}
    first = last = None
    for raw in bag.raw():
        first = raw.log_time if first is None else min(first, raw.log_time)
        last = raw.log_time if last is None else max(last, raw.log_time)
        entry = bag.entry(raw)
        if entry is not None:
            key = entry.namespace, entry.record.run_id
            run = runs.setdefault(key, RunCounts(*key))
            run.take(entry.record, dropped.holds(entry))
    return {
        'bag': str(bag.path),
        'files': [{'name': file.name, 'bytes': file.stat().st_size} for file in bag.files],
        'bytes': sum(file.stat().st_size for file in bag.files),
        'first_ns': first,
        'last_ns': last,
        'topics': {
            name: {'type': topic.type, 'messages': topic.count, 'bytes': topic.bytes}
            for name, topic in bag.topics.items()
        },
        'runs': [run.report() for _, run in sorted(runs.items())],
        'faults': faults,
    }
