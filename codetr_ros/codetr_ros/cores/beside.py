"""What a recorder checks beyond its core: records that no commit names, and those that come before
their source is announced.
"""

from collections import Counter, defaultdict
from collections.abc import Callable

from codetr_ros.config import Settings
from codetr_ros.cores.announced import EARLY_BYTES
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Record,
    RecordError,
    RunSpec,
    Transitions,
    TrueRewards,
    describe,
)
from codetr_ros.records.chain import named, void
from codetr_ros.records.checks import check_run

MOST_LACKING = 100_000
"""Numbers of true rewards that are remembered as lacking, of each source."""


class Early:
    """Holds records until their source is announced: topics overtake each other.

    Args:
        settings: the settings of the run.
    """

    def __init__(self, settings: Settings) -> None:
        self._sources = settings.source_count
        self._announced: set[str] = set()
        self._held: list[tuple[Record, bytes]] = []
        self._bytes = 0

    def holds(self, record: Record, data: bytes) -> bool:
        """Hold a record if its source may still be announced; returns whether it is held.

        Raises:
            RecordError: too much is held already.
        """
        if not isinstance(record, (Transitions, CompositeReward, TrueRewards)):
            return False
        if record.source in self._announced or len(self._announced) >= self._sources:
            return False
        if self._bytes + len(data) > EARLY_BYTES:
            raise RecordError(
                f'{describe(record)} came before {record.source!r} was announced, and '
                f'{self._bytes} bytes wait for that already, of at most {EARLY_BYTES}: start '
                f'{record.source!r} again'
            )
        self._held.append((record, data))
        self._bytes += len(data)
        return True

    def announced(self, source: str) -> list[tuple[Record, bytes]]:
        """Note that a source is announced; what waited for that, and no longer needs to."""
        self._announced.add(source)
        waiting, self._held, self._bytes = self._held, [], 0
        return waiting


class Beside:
    """Checks the records that go into a bag and that no commit names.

    Args:
        run: the run.
        settings: its settings.
        committed: returns the next phase to be committed.

    Attributes:
        duplicated: counts of records that arrived again, by topic.
    """

    def __init__(self, run: RunSpec, settings: Settings, committed: Callable[[], int]) -> None:
        self._run = run
        self._settings = settings
        self._committed = committed
        self._due: Counter[str] = Counter()  # next sequence number of true rewards, by source
        self._lacking: defaultdict[str, set[int]] = defaultdict(set)  # those below it
        self.duplicated: Counter[str] = Counter()

    def receive(self, record: Record) -> None:
        """Check a record, or take note of a commit.

        Raises:
            RecordError: it must be refused; nothing has changed then.
        """
        check_run(record, self._run)
        if isinstance(record, TrueRewards):
            self._true_rewards(record)
        elif isinstance(record, EpisodeResult):
            self._within(record, record.version, -1, self._settings.phases - 1, 'version')
            self._within(record, record.step, 0, self._settings.steps, 'step')
        elif isinstance(record, Metrics):
            self._within(record, record.phase, -1, self._settings.phases - 1, 'phase')
            self._within(record, record.step, 0, self._settings.steps, 'step')
        elif isinstance(record, Commit):
            for kind, source in void(record):
                if kind is Transitions:
                    self._pass_over(source, named(record)[kind, source])

    def lacks_true_rewards(self, commit: Commit) -> bool:
        """Whether a source that publishes true rewards has not yet published those of all steps
        that a commit names. They come right behind the steps; a source that has published none so
        far may have none.
        """
        return any(
            kind is Transitions and 0 < self._due[source] <= last
            for (kind, source), last in named(commit).items()
            if (kind, source) not in void(commit)
        )

    def _within(self, record: Record, value: int, least: int, most: int, name: str) -> None:
        if not least <= value <= most:
            raise RecordError(
                f'{describe(record)}: {name} must be from {least} to {most} in this run'
            )

    def _pass_over(self, source: str, last: int) -> None:
        """Go on behind the numbers that a commit voids of a source; some may still come."""
        lacking, due = self._lacking[source], self._due[source]
        lacking.update(range(due, last + 1))
        while len(lacking) > MOST_LACKING:
            lacking.remove(min(lacking))
        self._due[source] = max(due, last + 1)

    def _true_rewards(self, record: TrueRewards) -> None:
        settings, due = self._settings, self._due[record.source]
        first = self._committed()
        # they may be late by any number of phases: no commit waits for them
        self._within(record, record.phase, 0, first + settings.ahead, 'phase')
        self._within(record, len(record.rewards), 1, settings.phase_steps, 'length of rewards')
        lacking = self._lacking[record.source]
        if record.sequence in lacking:  # lost on the way, and sent again
            lacking.remove(record.sequence)
            return
        if record.sequence < due:
            self.duplicated[TOPICS[TrueRewards]] += 1
            return
        most = due + (settings.ahead + 1) * settings.phase_steps
        self._within(record, record.sequence, due, most, 'sequence')
        self._pass_over(record.source, record.sequence - 1)
        self._due[record.source] = record.sequence + 1
