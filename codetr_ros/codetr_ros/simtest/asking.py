"""Questions of simulated nodes to each other, and their answers."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from codetr_ros.nodes.asking import SERVICE, Answer
from codetr_ros.nodes.fetching import AGAIN

if TYPE_CHECKING:
    from codetr_ros.simtest.process import Process


@dataclass(frozen=True)
class FetchRequest:
    """Asks a node for a phase."""

    number: int
    phase: int
    kinds: tuple[str, ...]
    requester: str


@dataclass(frozen=True)
class FetchAnswer:
    """What came of the question of that number."""

    number: int
    answer: Answer


class Asker:
    """Asks one node for phases, one after the other.

    Args:
        by: the node that asks.
        service: the service that is asked.
    """

    def __init__(self, by: 'Process', service: str) -> None:
        self.service = service
        self._by = by
        self._reader = 'record' if service == SERVICE else service.split('/')[1]
        self._wanted: tuple[int, tuple[str, ...]] | None = None
        self._questions: set[int] = set()  # the numbers of those for it
        self._answered: Callable[[Answer], None] = lambda answer: None
        self._asked_at: float | None = None

    @property
    def ready(self) -> bool:
        """Whether the service is there; one that is not does not answer."""
        return True

    @property
    def busy(self) -> bool:
        """Whether an answer is still to be expected."""
        return self._asked_at is not None and self._by.world.now < self._asked_at + AGAIN

    def ask(
        self, phase: int, answered: Callable[[Answer], None], kinds: Collection[str] = ()
    ) -> None:
        """Ask for a phase. An earlier question that has no answer yet is forgotten; if it was the
        same, an answer to it will do.
        """
        wanted = phase, tuple(kinds)
        if self._asked_at is None or self._wanted != wanted:
            self._questions.clear()
        number = self._by.world.number()
        self._questions.add(number)
        self._wanted, self._answered, self._asked_at = wanted, answered, self._by.world.now
        request = FetchRequest(number, *wanted, self._by.name)
        self._by.world.note(self._by.name, f'asks {self._reader} for phase {phase}')
        self._by.ask(self, self._reader, request)

    def arrived(self, given: FetchAnswer) -> None:
        """Take an answer."""
        if given.number in self._questions and self._asked_at is not None:
            self._asked_at = None
            self._answered(given.answer)
