"""Roles of a recorded run that are there because live nodes wait for them."""

from collections.abc import Callable, Collection, Iterator

from rclpy.logging import LoggingSeverity

from codetr_ros.bags.playback import Recorded
from codetr_ros.config import Settings
from codetr_ros.records import TOPICS, Record
from codetr_ros.records.roles import WRITERS, readers
from codetr_ros.ros.joining import Joining
from codetr_ros.ros.link import RECORDS_OF_TOPIC
from codetr_ros.ros.signals import Stop
from codetr_ros.runs.reports import CoreReport


class _Silent:
    """The core of a role that is only played: nothing of its own to say."""

    subscribes: tuple[type, ...] = ()
    finished = True

    def receive(self, record: Record) -> None:
        """Nothing is subscribed to."""

    def work(self) -> Iterator[list[Record] | None]:
        """Nothing to do."""
        while True:
            yield None

    def close(self) -> None:
        """Nothing to save."""

    def report(self) -> CoreReport:
        """Nothing to report."""
        return CoreReport()


def _must_read(role: str, settings: Settings, live: Collection[str]) -> list[type]:
    """Kinds of records that live nodes insist on this role reading."""
    return [
        RECORDS_OF_TOPIC[topic]
        for topic, roles in readers(settings.labels_steps).items()
        if role in roles and set(WRITERS[topic]) & set(live)
    ]


class Played(Joining):
    """A node whose peers matter only where they are live."""

    _live: Collection[str]

    def _names(self, table: dict[str, tuple[str, ...]]) -> Callable[[str], set[str]]:
        live = {
            topic: tuple(r for r in roles if r in self._live) for topic, roles in table.items()
        }
        return super()._names(live)

    def open_topics(self, settings: Settings) -> None:
        """Subscribe to what the core wants; read the rest that live nodes want to be read without
        looking at it.
        """
        super().open_topics(settings)
        assert self.core is not None
        for kind in _must_read(self.role, settings, self._live):
            if kind not in self.core.subscribes:
                self.link.subscribe(kind, self._pass, settings, raw=True)

    def _pass(self, kind: type, raw: bytes) -> None:
        self.received[TOPICS[kind]] += 1


class PlayedRole(Played):
    """A role that is there because nodes wait for it. What it publishes, the player sends."""

    def __init__(
        self, role: str, name: str, recorded: Recorded, live: Collection[str], stop: Stop
    ) -> None:
        super().__init__(role, name, lambda: lambda *_, **__: _Silent(), stop)
        self.log.set_level(LoggingSeverity.WARN)  # the player says the rest once
        self._recorded = recorded
        self._live = live

    def _make_run(self) -> None:
        self.run_spec, self.settings = self._recorded.run, self._recorded.settings

    def join(self) -> bool:
        """Become part of the run; false if asked to stop meanwhile."""
        return self._join()

    def turn(self) -> None:
        """Let ROS have its turn."""
        self._turn()

    def lacking(self) -> list[str]:
        """Who is not there yet."""
        return self._lacking()

    def leave(self) -> None:
        """Say the last word."""
        self._tell(finished=True)
