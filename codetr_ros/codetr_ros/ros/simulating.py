"""The wiring of a simulator's core: it joins the run again after it was left out."""

from typing import TYPE_CHECKING, cast

from codetr_ros.nodes.behind import Behind
from codetr_ros.nodes.restoring import newest_committed, take_place
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.restoring import ask_recorder, returning
from codetr_ros.ros.wiring import Wiring

if TYPE_CHECKING:  # its imports take seconds, and follow once the run is known
    from codetr_ros.cores.simulator import Simulator


class Simulating(Wiring):
    """The wiring of a simulator's core."""

    def __init__(self, member: Membership, joined: Joined) -> None:
        super().__init__(member, joined)
        self._core = cast('Simulator', joined.core)
        self._behind = Behind(member.traffic, self._core, joined.settings)

    def waits(self) -> str:
        """What the simulator waits for, in words. If it was left out meanwhile, it goes on where
        the run stands.
        """
        member, joined = self.member, self.joined
        if self._behind.asks:
            asked = newest_committed(self._behind.answered)
            ask_recorder(member, joined, asked, self.over)
        if not self._core.finished and self._core.displaced:
            ask_recorder(member, joined, take_place(returning(member, joined)), self.over)
        return super().waits()

    def over(self) -> bool:
        """Whether the run has ended without it: then no robot goes on for nobody."""
        return self._behind.over(self.member.peers)
