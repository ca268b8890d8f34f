"""Logs how far a node has come, for whoever has started it by hand or by a launch file."""

import time
from collections.abc import Callable
from typing import Any

from codetr_ros.config import Settings
from codetr_ros.records import EpisodeResult, Metrics, Record

AT_LEAST = 1.0  # [s] between two lines: phases of a small task take milliseconds
AT_MOST = 10.0  # [s] between two lines: whoever looks at a log wants to know that the node lives
VALUES = 4  # of a phase's metrics, the most that are logged; the bag has all


class Course:
    """Logs a line for each phase and evaluation, and one when ten seconds have passed without any.

    Args:
        settings: the settings of the run.
        log: the node's logger.
        clock: seconds, never going back.
        counts: whether the node publishes metrics, by which phases are counted. Of another one it
            is not known how far the run has come.
    """

    def __init__(
        self,
        settings: Settings,
        log: Any,
        clock: Callable[[], float] = time.monotonic,
        counts: bool = True,
    ) -> None:
        self._settings = settings
        self._log = log
        self._clock = clock
        self._logged = float('-inf')  # when a line was logged
        self._quiet_since: float | None = None  # or since the node began to work
        self._where = f'no phase of {settings.phases} is done' if counts else ''
        self._results: list[EpisodeResult] = []

    def note(self, record: Record) -> None:
        """Note what the node publishes: the metrics of a phase end it."""
        if isinstance(record, Metrics):
            values = zip(record.names, record.values.tolist(), strict=True)
            shown = [f'{name} {value:.4g}' for name, value in values][:VALUES]
            self._where = (
                f'phase {record.phase + 1} of {self._settings.phases} is done, {record.step} of '
                f'{self._settings.steps} steps'
            )
            last = record.phase + 1 == self._settings.phases
            self._line(': '.join(filter(None, (self._where, ', '.join(shown)))), always=last)
        elif isinstance(record, EpisodeResult) and record.purpose == 'evaluation':
            self._evaluated(record)

    def _evaluated(self, result: EpisodeResult) -> None:
        self._results.append(result)
        if len(self._results) < self._settings.evaluate_episodes:
            return
        results, self._results = self._results, []
        mean = sum(each.true_return for each in results) / len(results)
        self._where = f'evaluated after {result.step} of {self._settings.steps} steps'
        self._line(f'{self._where}: true return {mean:.1f}, {len(results)} episodes')

    def tick(self, doing: str) -> None:
        """Log what the node does if nothing was logged for a while.

        Args:
            doing: what it does, in words.
        """
        now = self._clock()
        if self._quiet_since is None:
            self._quiet_since = now
        elif now - self._quiet_since >= AT_MOST:
            self._line('; '.join(filter(None, (doing, self._where))))

    def _line(self, text: str, always: bool = False) -> None:
        now = self._clock()
        if now - self._logged >= AT_LEAST or always:
            self._logged = self._quiet_since = now
            self._log.info(text)
