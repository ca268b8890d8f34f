"""Simulated people: they see what the simulator does, and score segments as people do.

Each has a scale of its own. They answer some time after they were asked, leave out some segments,
and err now and then. They know the true rewards, as a person who watches the robot sees how well
it does; nothing of that reaches anybody but through their judgements. All of it is drawn by the
run's seed, so that a run in process can be repeated.

What they do: docs/people.md#simulated-people.
"""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.cores.core import Part
from codetr_ros.records import (
    EQUAL,
    FIRST,
    SECOND,
    Commit,
    CompositeReward,
    Preference,
    Record,
    RunSpec,
    ScoreRequest,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.checks import check_run
from codetr_ros.runs.reports import CoreReport
from codetr_ros.seeding import generator
from codetr_ros.simulation.composite import composite
from codetr_ros.simulation.people_scales import Scale, scales

Asked = tuple[str, int, int, int]
"""Source, episode, first step and length of a segment."""


@dataclass(frozen=True)
class _Due:
    """What one person will state."""

    at: int  # steps of the run that must have passed
    who: int
    first: Asked
    second: Asked | None  # compared with it; None: scored


class SimulatedPeople(Part):
    """Answers requests for scores, in the place of people.

    Args:
        run: the run.
        settings: its settings.
        name: with which the names of the scorers begin.
    """

    subscribes: tuple[type, ...] = (Transitions, TrueRewards, ScoreRequest, Commit)

    def __init__(self, run: RunSpec, settings: Settings, name: str = 'person') -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self._people = settings.people
        self._scales: list[Scale] = []
        self.names = [
            f'{name}_{chr(ord("a") + i)}' if settings.people.count > 1 else name
            for i in range(settings.people.count)
        ]
        self._sequences = [0] * settings.people.count
        self._steps = 0
        self._rewards: dict[tuple[str, int], list[float]] = {}  # of the newest episodes
        self._held: deque[tuple[tuple[str, int], int]] = deque()  # and their steps
        self._requests: deque[ScoreRequest] = deque()
        self._due: deque[_Due] = deque()
        self._given = 0
        self._counts: Counter[str] = Counter()

    def receive(self, record: Record) -> None:
        """Note a record.

        Raises:
            RecordError: it is of another run; nothing has changed then.
        """
        check_run(record, self._run)
        if isinstance(record, Transitions):
            self._steps += record.steps
        elif isinstance(record, TrueRewards):
            self._watch(record)
        elif isinstance(record, ScoreRequest):
            self._requests.append(record)
        elif isinstance(record, Commit) and record.phase == self._settings.phases - 1:
            self.finished = True  # nothing is learnt from what comes now

    def _watch(self, record: TrueRewards) -> None:
        key = record.source, record.episode
        self._rewards.setdefault(key, []).extend(record.rewards.tolist())
        self._held.append((key, len(record.rewards)))
        held = sum(steps for _, steps in self._held) if len(self._held) % 64 == 0 else 0
        while held > self._settings.memory_steps:
            key, steps = self._held.popleft()
            held -= steps
            if not any(other == key for other, _ in self._held):
                del self._rewards[key]

    def find_scales(self) -> None:
        """Find out what is poor and what is perfect, if that is not known: takes seconds. Over
        topics it is done before the run begins, which waits for nobody later.

        Raises:
            TaskError: the task is unknown or cannot be used.
            SettingsError: a perfect segment is no better than those of the random policy.
        """
        if not self._scales:
            self._scales = scales(self._settings)

    def work(self) -> Iterator[list[Record] | None]:
        """Yield judgements when they are due."""
        self.find_scales()
        yield []
        while True:
            while self._requests:
                self._consider(self._requests.popleft())
            given: list[Record] = []
            while self._due and self._due[0].at <= self._steps and not self.finished:
                due = self._due.popleft()
                if (record := self._judge(due)) is not None:
                    given.append(record)
            yield given or None

    def _consider(self, request: ScoreRequest) -> None:
        """Decide who answers what of a request, and when."""
        people = self._people
        rng = generator(self._settings.seed, 'people', 'asked', request.phase)
        columns = (request.episodes, request.first_steps, request.lengths)
        rows = [column.tolist() for column in columns]
        asked: list[Asked] = list(zip(request.sources, *rows, strict=True))
        while asked:
            one = asked.pop(0)
            second = asked.pop(0) if asked and rng.random() < people.preferences else None
            everybody = rng.random() < people.shared
            chosen = int(rng.integers(people.count))
            for who in range(people.count) if everybody else (chosen,):
                if people.judgements and self._given >= people.judgements:
                    self._counts['segments not judged, no judgement was left'] += 1
                elif rng.random() < people.skipped:
                    self._counts['segments left out'] += 1
                else:
                    self._given += 1
                    self._due.append(_Due(self._steps + people.late, who, one, second))

    def _judge(self, due: _Due) -> Record | None:
        values = [self._worth(asked) for asked in (due.first, due.second) if asked]
        if None in values:
            self._counts['segments forgotten before they were judged'] += 1
            return None
        worths = [float(value) for value in values if value is not None]
        sequence = self._sequences[due.who]
        self._sequences[due.who] += 1
        name, scale = self.names[due.who], self._scales[due.who]
        rng = generator(self._settings.seed, 'people', name, sequence)
        wrong = rng.random() < self._people.wrong
        self._counts['wrong judgements'] += wrong
        source, episode, first_step, length = due.first
        if due.second is None:
            self._counts['scores'] += 1
            return CompositeReward(
                run_id=self._run.run_id,
                source=source,
                scorer=name,
                sequence=sequence,
                episode=episode,
                first_step=first_step,
                length=length,
                value=scale.any(rng) if wrong else scale.score(worths[0]),
            )
        self._counts['preferences'] += 1
        better = FIRST if worths[0] > worths[1] else SECOND
        alike = abs(worths[0] - worths[1]) < scale.just_noticeable
        outcome = 1 - better if wrong else (EQUAL if alike else better)
        return Preference(
            run_id=self._run.run_id,
            scorer=name,
            sequence=sequence,
            source=source,
            episode=episode,
            first_step=first_step,
            length=length,
            other_source=due.second[0],
            other_episode=due.second[1],
            other_first_step=due.second[2],
            other_length=due.second[3],
            outcome=outcome,
        )

    def _worth(self, asked: Asked) -> float | None:
        """The true score of a segment; None if its steps are forgotten."""
        source, episode, first, length = asked
        rewards = self._rewards.get((source, episode), [])[first : first + length]
        if len(rewards) < length:
            return None
        settings = self._settings
        longest = settings.lengths.most or max(length, 1)
        return composite(settings.composite, np.array(rewards), settings.beta, longest)

    def waiting_for(self) -> str:
        """What the people wait for, in words."""
        return f'{len(self._due)} judgements that are due later' if self._due else 'requests'

    def close(self) -> None:
        """Nothing to save: what they state is in the bag."""

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        left = {'judgements that came too late': len(self._due)} if self._due else {}
        return CoreReport(
            duplicated=dict(self.duplicated),
            refused=dict(self.refused),
            counters=dict(self._counts) | left,
        )
