"""Wires the core of a node to the topics of its run."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from codetr_ros.nodes.restoring import go_on
from codetr_ros.nodes.signing import VARIABLE
from codetr_ros.records import TOPICS, Metrics
from codetr_ros.records.roles import published_by
from codetr_ros.ros.course import Course
from codetr_ros.ros.gathering import IDLE, absent_or_unmatched
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.restoring import ask_recorder, returning
from codetr_ros.runs.reports import BagReport


class Wiring:
    """The wiring of most nodes: records that the core subscribes to go in, those it yields go out.

    Args:
        member: the node's membership.
        joined: the run that it has joined.
    """

    def __init__(self, member: Membership, joined: Joined) -> None:
        self.member = member
        self.joined = joined
        self.log = member.log
        counts = TOPICS[Metrics] in published_by(member.role)
        self._course = Course(joined.settings, member.log, counts=counts)

    def enter(self) -> None:
        """Open the topics, and publish that the node has joined."""
        run, settings = self.joined.run, self.joined.settings
        self.member.link.advertise(published_by(self.member.role), settings)
        self.open()
        self.log.info(f'run {run.run_id}: task {settings.task}, method {settings.method}')
        if self.member.link.key is None:
            self.log.warning(
                f'there is no key of the run (environment variable {VARIABLE}): nobody is refused '
                'for who he is'
            )
        self.member.publish_presence()

    def open(self) -> None:
        """Subscribe to what the core wants, and offer what is published once more."""
        self.member.keep_published(self.joined.settings)
        self.member.traffic.hold()
        for kind in self.joined.core.subscribes:
            self.member.link.subscribe(kind, self.take, self.joined.settings)

    def take(self, kind: type, message: Any) -> None:
        """Take a message that arrived on one of these topics."""
        self.member.take(kind, message)

    def complete(self) -> bool:
        """Do what must precede the arrival of all peers; false if asked to stop meanwhile."""
        return True

    def lacking(self) -> list[str]:
        """The peers that are absent or not matched yet, in words."""
        run, settings = self.joined.run, self.joined.settings
        return absent_or_unmatched(self.member, settings, run.settings_hash, settings.roles)

    def go_on(self) -> bool:
        """Let the core be as it was, if the run has begun without it or it was killed; false if
        asked to stop meanwhile.
        """
        member, joined = self.member, self.joined
        if not ask_recorder(member, joined, go_on(returning(member, joined))):
            return False
        self.member.release()
        return True

    def deliver(self, given: Any) -> None:
        """Publish what the core yielded: a record."""
        self.member.publish(given)

    def show(self, given: Sequence[Any], doing: str) -> None:
        """Log how far the node has come, if it is time for a line.

        Args:
            given: what the core has yielded.
            doing: what the node does, in words.
        """
        for each in given:
            self._course.note(each)
        self._course.tick(doing)

    def over(self) -> bool:
        """Whether the run has ended without this node, which has then finished wherever it is."""
        return False

    def held(self) -> None:
        """Note that the process was held, and has read nothing for a while."""

    def pause(self) -> float:
        """Seconds to wait for a message when there is nothing to do."""
        return IDLE

    def waits(self) -> str:
        """What the node waits for, in words."""
        if self.member.runs_away:
            return 'waits for the learner to take in the labels of the phases before'
        return f'waits for {self.joined.core.waiting_for()}'

    def asked_for(self) -> Mapping[str, float]:
        """Topics of what the node lacks and asks for, and since when that is in vain [s,
        monotonic].
        """
        return self.member.asked_for

    def settled(self, seconds: float) -> bool:
        """Whether the node may end, `seconds` after its core has finished."""
        return True

    def close(self) -> None:
        """Close what the wiring itself holds open, once nothing more will arrive."""

    def report(self) -> BagReport | None:
        """What the wiring adds to the core's report."""
        return None


Wire = Callable[[Membership, Joined], Wiring]
"""Makes the wiring of a node that has joined, without opening anything."""
