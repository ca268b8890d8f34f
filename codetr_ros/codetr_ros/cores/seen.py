"""What scorers see of a run: the steps of its segments, and which of them are asked for."""

import threading
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import Commit, Record, RunSpec, ScoreRequest, TaskSpec, Transitions
from codetr_ros.records.checks import check_run

Segment = tuple[str, int, int, int]
"""Source, episode, first step, length."""

MOST_STEPS = 100_000
"""Steps whose observations and actions are held for the curves; the oldest episodes go first."""
NEWEST = 16
"""Segments that are offered where nobody asks for any."""
KINDS: tuple[type, ...] = (TaskSpec, Transitions, ScoreRequest, Commit)
"""What has to be received for it."""


@dataclass
class _Episode:
    """Consecutive steps of an episode that have come."""

    begin: int  # the first of them: who joins a run late has not seen those before
    observations: list[Any] = field(default_factory=list)
    actions: list[Any] = field(default_factory=list)
    end: int = 0  # the step after the last of them
    ended: bool = False


class Seen:
    """Holds what a run has shown of its newest episodes. Scorers of one process share it.

    Args:
        run: the run.
        settings: its settings.

    Attributes:
        lock: held while anything here, or at a desk that reads it, changes.
        phase: the last that was committed; -1: none.
        taken: number of the last judgement that a commit took, by scorer.
        asked_after: the phase after which the newest request was made; None: nobody has asked.
        finished: the last phase is committed.
        changes: how often anything has changed.
    """

    def __init__(self, run: RunSpec, settings: Settings) -> None:
        self._run = run
        self._settings = settings
        self.lock = threading.RLock()
        self._episodes: OrderedDict[tuple[str, int], _Episode] = OrderedDict()
        self._held = 0  # steps
        self._cut: deque[Segment] = deque(maxlen=NEWEST)  # the newest, where nobody asks
        self._asked: list[Segment] = []  # the most valuable first
        self.asked_after: int | None = None
        self.phase = -1
        self.taken: dict[str, int] = {}
        self.finished = False
        self.changes = 0

    def receive(self, record: Record) -> None:
        """Note a record.

        Raises:
            RecordError: it is of another run; nothing has changed then.
        """
        check_run(record, self._run)
        with self.lock:
            self.changes += 1
            if isinstance(record, Transitions):
                self._append(record)
            elif isinstance(record, ScoreRequest):
                self._ask(record)
            elif isinstance(record, Commit):
                self.phase = max(self.phase, record.phase)
                self.taken.update(zip(record.scorers, record.scores.tolist(), strict=True))
                self.finished = self.finished or record.phase >= self._settings.phases - 1

    def _append(self, chunk: Transitions) -> None:
        key, ended = (chunk.source, chunk.episode), chunk.terminated or chunk.truncated
        episode = self._episodes.get(key)
        if episode is None or episode.end != chunk.first_step:  # new, or some did not come
            if episode is not None:
                self._forget(key)
            episode = self._episodes[key] = _Episode(chunk.first_step)
        episode.observations.append(chunk.observations[:-1])
        episode.actions.append(chunk.actions)
        episode.end = chunk.first_step + chunk.steps
        episode.ended = ended
        self._held += chunk.steps
        while self._held > MOST_STEPS and len(self._episodes) > 1:
            self._forget(next(iter(self._episodes)))
        after = chunk.first_step + chunk.steps
        cut = self._settings.cuts.segments(
            chunk.source, chunk.episode, chunk.first_step, after, ended
        )
        for first, length in cut:
            self._cut.append((chunk.source, chunk.episode, first, length))

    def _forget(self, key: tuple[str, int]) -> None:
        episode = self._episodes.pop(key)
        self._held -= episode.end - episode.begin

    def _ask(self, request: ScoreRequest) -> None:
        if self.asked_after is not None and request.phase < self.asked_after:
            return
        columns = (request.episodes, request.first_steps, request.lengths)
        rows = [column.tolist() for column in columns]
        self.asked_after = request.phase
        self._asked = list(zip(request.sources, *rows, strict=True))

    def knows(self, source: str) -> bool:
        """Whether steps of a source have come and are held."""
        with self.lock:
            return any(source == name for name, _ in self._episodes)

    def offered(self) -> list[Segment]:
        """Segments to judge, the most valuable first; where nobody asks, the newest first."""
        with self.lock:
            offered = self._asked or list(reversed(self._cut))
            return [segment for segment in offered if self.holds(segment)]

    def holds(self, segment: Segment) -> bool:
        """Whether there is such a segment, and all of its steps are held."""
        return self.cut_at(*segment[:3]) == segment

    def cut_at(self, source: str, episode: int, first: int) -> Segment | None:
        """The segment that begins at a step; None if none does, or not all of it is held."""
        with self.lock:
            known = self._episodes.get((source, episode))
            if known is None or not known.begin <= first < known.end:
                return None
            cut = self._settings.cuts.segments(source, episode, first, known.end, known.ended)
            found = next(cut, None)
            return None if found is None or found[0] != first else (source, episode, *found)

    def curves(self, segment: Segment) -> tuple[Any, Any] | None:
        """Observations (m, O) and actions (m, A) of a segment; None if they are not held."""
        source, episode, first, length = segment
        with self.lock:
            if not self.holds(segment):
                return None
            known = self._episodes[source, episode]
            part = slice(first - known.begin, first - known.begin + length)
            observations = np.concatenate(known.observations)[part]
            return observations, np.concatenate(known.actions)[part]

    def actions_before(self, segment: Segment) -> Any:
        """The actions (n, A) of its episode up to a segment's end; None if they are not all
        held.
        """
        source, episode, first, length = segment
        with self.lock:
            if not self.holds(segment):
                return None
            known = self._episodes[source, episode]
            return None if known.begin else np.concatenate(known.actions)[: first + length]
