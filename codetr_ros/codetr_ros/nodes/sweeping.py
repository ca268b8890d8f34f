"""The recorder asks other nodes for what they have published lately: it was killed, or a network
was cut.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
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


@dataclass
class _Sweep:
    """Of one node.

    Attributes:
        node: its full name.
        phases: what it has sent, newest first.
        phase: which it is asked for.
        again: whether it has not answered the same question before.
        question: counts its questions: an answer to an earlier one comes too late.
        unnews: phases since one had something new.
    """

    node: str
    phases: list[Messages] = field(default_factory=list)
    phase: int = NEWEST
    again: bool = False
    question: int = 0
    unnews: int = 0


class Sweeper:
    """Asks nodes for all that they keep, each from the newest phase back, and hands on what a node
    has sent in the order in which that was published. All are asked at the same time: a node whose
    answers are lost keeps no other waiting.

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
        self._present: dict[str, _Sweep] = {}  # of the nodes that are asked

    def ask(self, nodes: Iterable[str], lacking: bool = False) -> None:
        """Ask these nodes, each as soon as it offers to answer, and not twice in `AGAIN` seconds.

        Args:
            nodes: full names.
            lacking: whether something that they have published is known to be lacking: of any
                phase, so that they are asked for all that they keep.
        """
        for node in nodes:
            if node not in self._present:
                if lacking:
                    self._thorough.add(node)
                self._wanted.setdefault(node, self._asked.get(node, -AGAIN) + AGAIN)

    @property
    def busy(self) -> bool:
        """Whether a node is still to be asked, or to answer."""
        return bool(self._present or self._wanted)

    def check(self) -> None:
        """Ask the nodes that are to be asked, and those that do not answer any more once more."""
        now = self._clock()
        for sweep in list(self._present.values()):
            asker = self._asker(service_of(sweep.node))
            if not asker.busy and asker.ready:  # it was killed meanwhile, or the answer was lost
                sweep.again = sweep.phase != NEWEST
                self._ask(sweep)
        for node in [node for node, due in self._wanted.items() if due <= now]:
            if self._asker(service_of(node)).ready:
                del self._wanted[node]
                sweep = self._present[node] = _Sweep(node)
                self._ask(sweep)

    def _ask(self, sweep: _Sweep) -> None:
        sweep.question += 1
        asked = sweep.question
        asker = self._asker(service_of(sweep.node))
        asker.ask(sweep.phase, lambda answer: self._answered(sweep, asked, answer))

    def _answered(self, sweep: _Sweep, asked: int, answer: Answer) -> None:
        if asked != sweep.question:
            return  # too late: it was asked once more
        if answer.phase is None:  # it keeps nothing earlier, or was started again since
            if sweep.again:
                sweep.again, sweep.phase = False, NEWEST
                self._ask(sweep)
            else:
                self._end(sweep)
            return
        sweep.again = False
        sweep.phases.append(answer.messages)
        new = any(not self._known(kind, data) for kind, data in answer.messages)
        sweep.unnews = 0 if new else sweep.unnews + 1
        goes_on = sweep.unnews < UNNEWS or sweep.node in self._thorough
        if goes_on and answer.phase > 0:
            sweep.phase = answer.phase - 1
            self._ask(sweep)
        else:
            self._end(sweep)

    def _end(self, sweep: _Sweep) -> None:
        node = sweep.node
        del self._present[node]
        self._thorough.discard(node)
        self._asked[node] = self._clock()
        sent = [message for messages in reversed(sweep.phases) for message in messages]
        if new := sum(self._take(kind, data) for kind, data in sent):
            self._log.warning(f'{new} messages of {node} had not arrived: it has sent them again')
