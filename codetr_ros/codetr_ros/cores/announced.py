"""The sources of a run that have announced themselves, and what they simulate."""

import logging
from collections import Counter
from collections.abc import Callable

from codetr_ros.config import Settings
from codetr_ros.records import (
    PROTOCOL_VERSION,
    TOPICS,
    RecordError,
    RunSpec,
    TaskSpec,
    Transitions,
    describe,
)
from codetr_ros.records.checks import check_run, check_transitions

EARLY_BYTES = 16 << 20
"""The most bytes that are held of what comes before its source is announced."""

_log = logging.getLogger(__name__)


class Tasks:
    """The sources of a run and what they simulate."""

    def __init__(self, run: RunSpec, settings: Settings) -> None:
        self._run = run
        self._settings = settings
        self._joining = settings.joining_sources
        self.specs: dict[str, TaskSpec] = {}
        self._unannounced: list[Transitions] = []
        self._bytes = 0  # of their arrays
        self.refused: Counter[str] = Counter()  # steps that waited for their announcement

    @property
    def known(self) -> bool:
        """Whether all sources that the run needs have announced what they simulate."""
        needed = self._settings.source_count - len(self._joining)
        return len(self.specs.keys() - self._joining) == needed

    @property
    def first(self) -> TaskSpec:
        """The task, which all sources share."""
        return self.specs[min(self.specs)]

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources, sorted, also of those that may join later."""
        return tuple(sorted(self.specs.keys() | self._joining))

    def receive(self, spec: TaskSpec) -> None:
        """Take the announcement of what a source simulates.

        Raises:
            RecordError: it is of another run, protocol, task or size, or one simulator too many.
        """
        check_run(spec, self._run)
        if spec.protocol_version != PROTOCOL_VERSION:
            raise RecordError(
                f'{spec.source!r} speaks protocol {spec.protocol_version}, this node '
                f'{PROTOCOL_VERSION}: install the same version of codetr_ros on both'
            )
        for known in self.specs.values():
            for name in ('task', 'observation_size', 'action_size', 'horizon', 'r_max'):
                if getattr(known, name) != getattr(spec, name):
                    raise RecordError(
                        f'{spec.source!r} has {name}={getattr(spec, name)!r}, {known.source!r} '
                        f'has {getattr(known, name)!r}: all simulators of a run must simulate '
                        'the same task'
                    )
        if spec.source not in self.specs and spec.source not in self._joining and self.known:
            raise RecordError(
                f'{spec.source!r} is one simulator too many: the run has '
                f'simulators={self._settings.simulators} with envs={self._settings.envs} each '
                f'({", ".join(self.sources)}). Start the run with more, or stop this one'
            )
        self.specs[spec.source] = spec

    def announce(self, spec: TaskSpec, receive: Callable[[Transitions], None]) -> None:
        """Take an announcement, then hand the steps that waited for it to `receive`.

        Raises:
            RecordError: as `receive` of this class; the steps then wait on.
        """
        self.receive(spec)
        waiting, self._unannounced, self._bytes = self._unannounced, [], 0
        for chunk in waiting:
            try:
                receive(chunk)
            except RecordError as error:  # the steps' fault, not that of the announcement
                self.refused[TOPICS[Transitions]] += 1
                _log.error('%s', error)

    def admit(self, chunk: Transitions) -> bool:
        """Whether steps may be taken in now; those that arrive before their announcement wait.

        Raises:
            RecordError: no simulator of this run made them, or they do not fit the task.
        """
        spec = self.specs.get(chunk.source)
        if spec is not None:
            check_transitions(chunk, spec)
            return True
        if self.known and chunk.source not in self._joining:
            raise RecordError(
                f'{describe(chunk)}: {chunk.source!r} is no simulator of this run; these are: '
                f'{", ".join(self.sources)}'
            )
        size = chunk.observations.nbytes + chunk.actions.nbytes
        if self._bytes + size > EARLY_BYTES:
            raise RecordError(
                f'{describe(chunk)} came before {chunk.source!r} was announced, and {self._bytes} '
                f'bytes wait for that already, of at most {EARLY_BYTES}: start {chunk.source!r} '
                'again'
            )
        self._bytes += size
        self._unannounced.append(chunk)  # announcements travel on another topic
        return False
