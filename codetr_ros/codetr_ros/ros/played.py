"""The played roles of a recorded run: live nodes wait for them."""

from collections.abc import Collection, Sequence
from typing import Any

from rclpy.logging import LoggingSeverity

from codetr_ros.bags.playback import RecordedRun
from codetr_ros.config import Settings
from codetr_ros.cores.core import Silent
from codetr_ros.records import TOPICS
from codetr_ros.records.roles import WRITERS, readers
from codetr_ros.ros.gathering import absent_or_unmatched
from codetr_ros.ros.joining import Joined, join
from codetr_ros.ros.link import RECORDS_OF_TOPIC, Link
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.wiring import Wiring


def _must_read(role: str, settings: Settings, live: Collection[str]) -> list[type]:
    """Kinds of records for which live nodes wait until this role reads them."""
    return [
        RECORDS_OF_TOPIC[topic]
        for topic, roles in readers(settings.labels_steps).items()
        if role in roles and set(WRITERS[topic]) & set(live)
    ]


class PlayedWiring(Wiring):
    """The wiring of a played role: only its live peers matter.

    Args:
        member: the played node's membership.
        joined: the run that it has joined.
        live: roles whose real nodes take part.
    """

    def __init__(self, member: Membership, joined: Joined, live: Collection[str]) -> None:
        super().__init__(member, joined)
        self._live = live

    def open(self) -> None:
        """Subscribe to what the core wants. What else live nodes need read is read and ignored."""
        for kind in self.joined.core.subscribes:
            self.member.link.subscribe(kind, self.take, self.joined.settings)
        settings = self.joined.settings
        for kind in _must_read(self.member.role, settings, self._live):
            if kind not in self.joined.core.subscribes:
                self.member.link.subscribe(kind, self._pass, settings)

    def _pass(self, kind: type, raw: bytes) -> None:
        self.member.traffic.received[TOPICS[kind]] += 1

    def show(self, given: Sequence[Any], doing: str) -> None:
        """Log nothing: the player logs what it has played."""

    def go_on(self) -> bool:
        """Nothing is to be restored: the player begins with the first phase."""
        return True

    def lacking(self) -> list[str]:
        """The live peers that are absent or not matched yet, in words."""
        run, settings = self.joined.run, self.joined.settings
        return absent_or_unmatched(self.member, settings, run.settings_hash, self._live)


class Cast:
    """All roles that are played beside the recorder. The player sends what they publish.

    Args:
        recorder: the played recorder; the others keep it company.
        recorded: the run.
        live: roles whose real nodes take part, and which are not played.
    """

    def __init__(self, recorder: Membership, recorded: RecordedRun, live: Collection[str]) -> None:
        self._recorder = recorder
        self._recorded = recorded
        self._live = live
        self._wirings: list[PlayedWiring] = []
        self._links: dict[tuple[str, str], Link] = {('record', ''): recorder.link}

    def play(self, role: str, name: str) -> bool:
        """Let a node of this role and name join the run, unless the role is live; false if asked
        to stop meanwhile.
        """
        if role in self._live:
            return True
        member = Membership(role, name, self._recorder.stop)
        member.log.set_level(LoggingSeverity.WARN)  # the player logs the rest once
        member.deadline_is, member.again = self._recorder.deadline_is, self._recorder.again
        self._links[role, name if role == 'sim' else ''] = member.link
        self._recorder.company.append(member)
        recorded = self._recorded
        announce = (lambda _: (recorded.run, recorded.settings)) if role == 'learner' else None
        joined = join(member, lambda: _silent, announce)
        if joined is None:
            return False
        wiring = PlayedWiring(member, joined, self._live)
        wiring.enter()
        self._wirings.append(wiring)
        return True

    def link(self, role: str, name: str) -> Link | None:
        """The connection that publishes for a played node; None if the node is live.

        Args:
            role: its role.
            name: its name if it is a simulator, else empty.
        """
        return self._links.get((role, name))

    def lacking(self) -> list[str]:
        """The nodes that are absent or not matched with a played node yet, in words."""
        return [text for wiring in self._wirings for text in wiring.lacking()]


def _silent(*_: Any, **__: Any) -> Silent:
    return Silent()
