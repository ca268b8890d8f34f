"""The recorder asks other nodes for what they have published lately: it was killed, or a network
was cut.
"""

import time
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

from codetr_ros.nodes.asking import NEWEST, Answer, MakeAsks, service_of
from codetr_ros.nodes.fetching import AGAIN

UNNEWS = 3
"""Phases of a node with nothing new in them, after which it is not asked for earlier ones, unless
something is known to be lacking.
"""

Messages = list[tuple[type, bytes]]
"""Kind and bytes of each."""
TakeAgain = Callable[[type, bytes], bool]
"""Takes the bytes of a message that was sent again; returns whether it was new."""


class Sweeper:
    """Asks one node after the other for all that it keeps, from the newest phase back, and hands
    it on in the order in which it was published.

    Args:
        make: makes what asks a node.
        known: returns whether a message came before.
        take: takes each message that comes.
        log: the recorder's logger.
        clock: monotonic time [s].
    """

    def __init__(
        self,
        make: MakeAsks,
        known: Callable[[type, bytes], bool],
        take: TakeAgain,
        log: Any,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._asker = cache(make)  # one for each service
        self._known = known
        self._take = take
        self._log = log
        self._clock = clock
        self._wanted: dict[str, float] = {}  # nodes to be asked, and when at the earliest
        self._asked: dict[str, float] = {}  # when each has answered last
        self._thorough: set[str] = set()  # nodes that are to be asked for all that they keep
        self._present: str | None = None  # the node that is asked
        self._phases: list[Messages] = []  # what it has sent, newest first
        self._phase = NEWEST  # which it is asked for
        self._broken_off: dict[str, tuple[list[Messages], int]] = {}  # of nodes: both of these
        self._goes_on = False  # whether it was broken off right before that
        self._round = 0  # counts questions
        self._news = 0  # phases since one had something new

    def ask(self, nodes: Iterable[str], lacking: bool = False) -> None:
        """Ask these nodes, each as soon as it offers to answer, and not twice in `AGAIN` seconds.

        Args:
            nodes: full names.
            lacking: whether something that they have published is known to be lacking: of any
                phase, so that they are asked for all that they keep.
        """
        for node in nodes:
            if node != self._present:
                if lacking:
                    self._thorough.add(node)
                self._wanted.setdefault(node, self._asked.get(node, -AGAIN) + AGAIN)

    @property
    def busy(self) -> bool:
        """Whether a node is still to be asked, or to answer."""
        return self._present is not None or bool(self._wanted)

    def check(self) -> None:
        """Go on with the next node, where one has answered or does not answer any more."""
        if self._present is not None:
            if self._asker(service_of(self._present)).busy:
                return
            # it was killed meanwhile, or the answer was lost: ask it once more, from there on
            self._wanted[self._present] = 0.0
            self._broken_off[self._present] = self._phases, self._phase
            self._end()
        now = self._clock()
        for node in [node for node, due in self._wanted.items() if due <= now]:
            if self._asker(service_of(node)).ready:
                del self._wanted[node]
                self._present, self._news = node, 0
                self._goes_on = node in self._broken_off
                self._phases, phase = self._broken_off.pop(node, ([], NEWEST))
                self._ask(phase)
                return

    def _ask(self, phase: int) -> None:
        node = self._present
        assert node is not None
        self._phase = phase
        self._round += 1
        asked = self._round
        asker = self._asker(service_of(node))
        asker.ask(phase, lambda answer: self._answered(asked, answer))

    def _answered(self, asked: int, answer: Answer) -> None:
        if asked != self._round or self._present is None:
            return  # too late: it was given up, or another node is asked
        if answer.phase is None:  # it keeps nothing earlier, or was started again since
            if self._goes_on:
                self._goes_on = False
                self._ask(NEWEST)
            else:
                self._end()
            return
        self._goes_on = False
        self._phases.append(answer.messages)
        new = any(not self._known(kind, data) for kind, data in answer.messages)
        self._news = 0 if new else self._news + 1
        goes_on = self._news < UNNEWS or self._present in self._thorough
        if goes_on and answer.phase > 0:
            self._ask(answer.phase - 1)
        else:
            self._end()

    def _end(self) -> None:
        node, phases = self._present, self._phases
        assert node is not None
        self._present, self._phases = None, []
        if node not in self._broken_off:
            self._thorough.discard(node)
        self._asked[node] = self._clock()
        sent = [message for messages in reversed(phases) for message in messages]
        if new := sum(self._take(kind, data) for kind, data in sent):
            self._log.warning(f'{new} messages of {node} had not arrived: it has sent them again')
