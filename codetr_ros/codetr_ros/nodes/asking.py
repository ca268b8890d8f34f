"""Questions of one node to another: for what it has published, or recorded, of a phase."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

from codetr_ros.bags.errors import BagError

SERVICE = 'fetch_phase'
"""That of the recorder."""
NEWEST = 4294967295
"""Asked for as a phase: the newest that there is. As in `FetchPhase.srv`."""


def service_of(node: str) -> str:
    """The service of a node other than the recorder, by the node's full name."""
    return f'{node}/{SERVICE}'


@dataclass
class Answer:
    """What came of a question.

    Attributes:
        phase: which phase was sent; None if none was.
        reason: why nothing was sent; empty if something was.
        messages: kind and bytes of each.
    """

    phase: int | None
    reason: str = ''
    messages: list[tuple[type, bytes]] = field(default_factory=list)

    @property
    def nothing(self) -> bool:
        """Whether nothing of what was asked for was sent."""
        return bool(self.reason) or not self.messages


Read = Callable[[int, Collection[str]], Iterable[tuple[type, bytes]]]
"""Kind and bytes of each message of a phase that is of a wanted type, of any if none is named.
A phase that is not held is a `KeyError`, whose message names those that are."""


def answer_to(
    phase: int, kinds: Collection[str], read: Read, newest: Callable[[], int | None], log: Any
) -> Answer:
    """What a node answers.

    Args:
        phase: the phase that is asked for, or `NEWEST`.
        kinds: types of the messages that are wanted; empty: all.
        read: reads a phase.
        newest: returns the newest phase that can be read; None if there is none.
        log: the node's logger.
    """
    if phase == NEWEST:
        there = newest()
        if there is None:
            return Answer(None)
        phase = there
    try:
        return Answer(phase, '', list(read(phase, kinds)))
    except KeyError as error:
        return Answer(None, str(error.args[0]))
    except (BagError, OSError) as error:
        reason = f'phase {phase} cannot be read: {error}'
        log.error(reason)
        return Answer(None, reason)


class Asks(Protocol):
    """Asks one node for phases, one after the other."""

    @property
    def service(self) -> str:
        """The full name of the service that is asked."""

    @property
    def ready(self) -> bool:
        """Whether the service is there."""

    @property
    def busy(self) -> bool:
        """Whether an answer is still to be expected: a node that has died sends none."""

    def ask(
        self, phase: int, answered: Callable[[Answer], None], kinds: Collection[str] = ()
    ) -> None:
        """Ask for a phase. An earlier question that has no answer yet is forgotten; if it was the
        same, an answer to it will do: where answers take long, none would ever come otherwise.

        Args:
            phase: which one, or `NEWEST`.
            answered: called by the main loop, once all has come or nothing is sent.
            kinds: types of the messages that are wanted; empty: all.
        """


MakeAsks = Callable[[str], Asks]
"""Makes what asks a service, by the service's name."""
