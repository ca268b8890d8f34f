"""An index of the episodes and scores of bags, made in one pass.

The index has the places of steps, not the steps: it takes about a byte per step where a score
comes every 25 steps. Bags are not trusted: steps sent twice are taken once, a gap ends a piece,
values that are not finite are left out, and all of this is counted.
"""

from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np

from codetr_ros.bags.dropped import DroppedInBag
from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings, SettingsError, load
from codetr_ros.offline import judged
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.sources import settings_of
from codetr_ros.records import CompositeReward, Preference, RunSpec, TaskSpec, Transitions
from codetr_ros.records.checks import LARGEST_SCORE, usable_score

UNKNOWN_TASK = 'unknown'
"""The task in the settings of a fit whose bags name none."""

AGAIN = 'steps sent again'
DROPPED = 'steps of sources that were left out of the phase'
COPIES = 'steps of episodes that another bag holds too'
UNSOUND = 'steps with values that are not finite'
UNJOINED = 'breaks where the next observation is not the one before'
NOT_FINITE = 'scores that are not finite'
TOO_LARGE = f'scores beyond {LARGEST_SCORE:g}'
CORRECTED = 'scores that their scorer has corrected'
COMPARED = 'preferences, which are learnt from with --schedule phases'


class Key(NamedTuple):
    """The source of episodes. Run ids need not be unique, so the bag is part of the key."""

    bag: int
    run_id: str
    source: str


@dataclass(slots=True)
class Piece:
    """Consecutive steps of an episode, without a gap."""

    first: int
    steps: int
    tail: bytes | None  # the last observation, while more may follow

    @property
    def end(self) -> int:
        """The step after the last."""
        return self.first + self.steps


@dataclass(slots=True)
class Episode:
    """The parts of an episode that a bag holds."""

    key: Key
    number: int
    pieces: list[Piece] = field(default_factory=list)
    # its scores, in the order in which they arrived
    firsts: 'array[int]' = field(default_factory=lambda: array('q'))
    lengths: 'array[int]' = field(default_factory=lambda: array('q'))
    values: 'array[float]' = field(default_factory=lambda: array('d'))
    scorers: list[str] = field(default_factory=list)

    def follows(self, chunk: Transitions) -> Piece | None:
        """The piece that a chunk continues, if any."""
        last = self.pieces[-1] if self.pieces else None
        return last if last and last.tail is not None and chunk.first_step == last.end else None


@dataclass
class Index:
    """Everything in some bags that a reward model can be fitted on.

    Args:
        bags: the bags.
        run_id: index this run only; all runs if None.
    """

    bags: Sequence[Bag]
    run_id: str | None = None
    runs: list[tuple[int, RunSpec]] = field(default_factory=list)
    settings: list[Settings] = field(default_factory=list)  # of the runs, where they are known
    tasks: list[str] = field(default_factory=list)
    observation_size: int = 0
    action_size: int = 0
    horizon: int = 0  # of their tasks, the longest; 0 where no bag states it
    episodes: dict[tuple[Key, int], Episode] = field(default_factory=dict)
    steps: int = 0
    scores: int = 0
    unscored: int = 0  # segments that state that they have no score
    skipped: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    topics: dict[Key, str] = field(default_factory=dict)  # of their steps
    phases: Counter[Key] = field(default_factory=Counter)  # that have begun
    _prints: dict[tuple[str, str, int, bytes], int] = field(default_factory=dict)
    _copies: set[tuple[Key, int]] = field(default_factory=set)
    # runs that others than the simulator scored: number of the bag, run id
    _judged: set[tuple[int, str]] = field(default_factory=set)
    _first: str = ''  # the source that set the sizes

    def read(self) -> 'Index':
        """Read the bags once.

        Raises:
            BagError: one cannot be read.
            FitError: the bags have different sizes or composite rewards, or nothing to learn from.
        """
        kinds = (RunSpec, TaskSpec, Transitions, CompositeReward, Preference)
        for number, bag in enumerate(self.bags):
            dropped = DroppedInBag(bag)
            for entry in bag.entries(kinds):
                record = entry.record
                if self.run_id is not None and record.run_id != self.run_id:
                    continue
                if dropped.holds(entry):
                    self.skipped[DROPPED] += getattr(record, 'steps', 0)
                    continue
                if isinstance(record, RunSpec):
                    self._run(number, record)
                elif isinstance(record, TaskSpec):
                    self._task(number, record)
                elif isinstance(record, Transitions):
                    key = Key(number, record.run_id, record.source)
                    self.topics.setdefault(key, entry.topic)
                    self.phases[key] = max(self.phases[key], record.phase + 1)
                    self._take(key, record)
                elif isinstance(record, CompositeReward):
                    self._score(Key(number, record.run_id, record.source), record)
                elif isinstance(record, Preference):
                    self.skipped[COMPARED] += 1
        self._settle()
        if not self.steps:
            raise FitError(
                f'{", ".join(str(b.path) for b in self.bags)}: no Transitions'
                f'{f" of run {self.run_id!r}" if self.run_id else ""} to learn from: '
                '`codetr convert` makes them from other topics'
            )
        if not self.scores:
            raise FitError(
                f'{", ".join(str(b.path) for b in self.bags)}: {self.steps} steps, but no '
                'CompositeReward: the steps have no scores to learn from'
            )
        return self

    def _run(self, number: int, run: RunSpec) -> None:
        if any(known.run_id == run.run_id and bag == number for bag, known in self.runs):
            return
        self.runs.append((number, run))
        try:
            mine = settings_of(run, self.bags[number])
        except SettingsError as error:  # of another version; its data can still be used
            self.notes.append(f'settings not known: {error}')
            return
        for other in self.settings:
            if (other.composite, other.beta) != (mine.composite, mine.beta):
                raise FitError(
                    f'run {run.run_id!r} in {self.bags[number].path} is scored by '
                    f'composite = {mine.composite} (beta = {mine.beta:g}), another one by '
                    f'{other.composite} (beta = {other.beta:g}): one model cannot learn both, '
                    'fit them apart'
                )
        self.settings.append(mine)
        if mine.scored_elsewhere:
            self._judged.add((number, run.run_id))

    def _task(self, number: int, spec: TaskSpec) -> None:
        who = f'{spec.source!r} in {self.bags[number].path}'
        self._sizes(spec.observation_size, spec.action_size, who)
        self.horizon = max(self.horizon, spec.horizon)
        if spec.task not in self.tasks:
            self.tasks.append(spec.task)
            if len(self.tasks) > 1:
                self.notes.append(f'several tasks of the same sizes: {", ".join(self.tasks)}')

    def _sizes(self, observations: int, actions: int, who: str) -> None:
        if not self._first:
            self.observation_size, self.action_size = observations, actions
            self._first = who
        for name, mine, theirs in (
            ('observation', observations, self.observation_size),
            ('action', actions, self.action_size),
        ):
            if mine != theirs:
                raise FitError(
                    f'{who} has {name} size {mine}, {self._first} has {theirs}: one model has '
                    'one size, fit them apart'
                )

    def _take(self, key: Key, chunk: Transitions) -> None:
        who = f'{chunk.source!r} in {self.bags[key.bag].path}'
        self._sizes(chunk.observations.shape[1], chunk.actions.shape[1], who)
        if not sound(chunk):
            self.skipped[UNSOUND] += chunk.steps
            return
        place = (key, chunk.episode)
        if place in self._copies or self._copied(place, chunk):
            self.skipped[COPIES] += chunk.steps
            return
        episode = self.episodes.get(place)
        if episode is None:
            episode = self.episodes[place] = Episode(key, chunk.episode)
        end = chunk.first_step + chunk.steps
        if any(p.first < end and chunk.first_step < p.end for p in episode.pieces):
            self.skipped[AGAIN] += chunk.steps
            return
        piece = episode.follows(chunk)
        if piece is not None and piece.tail != chunk.observations[0].tobytes():
            self.skipped[UNJOINED] += 1
            piece = None
        if piece is None:
            for old in episode.pieces:
                old.tail = None
            piece = Piece(chunk.first_step, 0, None)
            episode.pieces.append(piece)
        piece.steps += chunk.steps
        ended = chunk.terminated or chunk.truncated
        piece.tail = None if ended else chunk.observations[-1].tobytes()
        self.steps += chunk.steps

    def _copied(self, place: tuple[Key, int], chunk: Transitions) -> bool:
        """Whether an episode that begins here is in an earlier bag already, byte for byte."""
        known = self.episodes.get(place)
        if len(self.bags) == 1 or (known is not None and known.pieces):
            return False
        print_of = blake2b(chunk.observations.tobytes(), digest_size=8)
        print_of.update(chunk.actions.tobytes())
        key, number = place
        seen = (key.run_id, key.source, number, print_of.digest())
        if self._prints.setdefault(seen, key.bag) == key.bag:
            return False
        self._copies.add(place)
        if known is not None:  # scores that arrived before their steps
            none = int(np.isnan(known.values).sum())
            self.scores -= len(known.firsts) - none
            self.unscored -= none
            del self.episodes[place]
        return True

    def _score(self, key: Key, reward: CompositeReward) -> None:
        if not usable_score(reward.value) and not np.isnan(reward.value):
            self.skipped[TOO_LARGE if np.isfinite(reward.value) else NOT_FINITE] += 1
            return
        place = (key, reward.episode)
        if place in self._copies:
            return
        episode = self.episodes.get(place)
        if episode is None:  # its steps may follow: topics are not ordered among each other
            episode = self.episodes[place] = Episode(key, reward.episode)
        if key[:2] in self._judged and self._corrects(episode, reward):
            self.skipped[CORRECTED] += 1
            return
        episode.scorers.append(reward.scorer)
        episode.firsts.append(reward.first_step)
        episode.lengths.append(reward.length)
        episode.values.append(reward.value)
        if np.isnan(reward.value):
            self.unscored += 1
        else:
            self.scores += 1

    @staticmethod
    def _corrects(episode: Episode, reward: CompositeReward) -> bool:
        """Whether a score replaces one of the same scorer, which it does then."""
        same = (reward.first_step, reward.length, reward.scorer)
        there = zip(episode.firsts, episode.lengths, episode.scorers, strict=True)
        for at, known in enumerate(there):
            if known == same:
                episode.values[at] = reward.value
                return True
        return False

    def _settle(self) -> None:
        """Bring the scores of several scorers to one scale, run by run."""
        for run in sorted(self._judged):
            judged.settle(e for e in self.episodes.values() if e.key[:2] == run)
        if self._judged:
            every = [value for e in self.episodes.values() for value in e.values]
            self.unscored = int(np.isnan(every).sum())
            self.scores = len(every) - self.unscored

    @property
    def longest(self) -> int:
        """Steps of the longest scored segment that fits into a piece; 1 if there is none."""
        longest = 1
        for episode in self.episodes.values():
            most = max((piece.steps for piece in episode.pieces), default=0)
            longest = max(longest, max((n for n in episode.lengths if n <= most), default=1))
        return longest

    def within(self, settings: Settings) -> Settings:
        """The settings of a run for the episodes of these bags: how long a whole one may be."""
        return settings.within(self.horizon or self.longest)

    def base(self) -> Settings:
        """The settings of the first run that has them, else of the preset `quick`."""
        return self.settings[0] if self.settings else load('quick')

    def facts(self) -> dict[str, Any]:
        """Settings that the data decides: the task, and the steps that a score is of."""
        known = max((self.within(settings).longest for settings in self.settings), default=0)
        delay = max(known, self.longest)
        if delay != known:
            why = (
                f'a run in the bags has {known}' if known else 'no bag holds the settings of a run'
            )
            self.notes.append(f'delay = {delay}, the longest scored segment: {why}')
        tasks = [*self.tasks, *(settings.task for settings in self.settings), UNKNOWN_TASK]
        return {'delay': delay, 'task': tasks[0]}


def sound(chunk: Transitions) -> bool:
    """Whether all numbers of a chunk are finite."""
    return bool(np.isfinite(chunk.observations).all() and np.isfinite(chunk.actions).all())
