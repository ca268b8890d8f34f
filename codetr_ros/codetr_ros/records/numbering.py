"""The numbers of a scorer, whose scores and preferences come on two topics."""

from codetr_ros.records.kinds import CompositeReward, Preference

Judgement = CompositeReward | Preference
"""What a scorer states: both kinds have one sequence of numbers."""


class Numbering:
    """The numbers 0, 1, 2, ... of one publisher, which may arrive in another order."""

    def __init__(self) -> None:
        self.next = 0
        """All numbers below this one have arrived."""
        self.early: set[int] = set()
        """Those that arrived before one below them."""

    def skip(self, last: int) -> None:
        """Go on behind a number: those up to there will not arrive."""
        self.next = max(self.next, last + 1)
        self.early = {number for number in self.early if number >= self.next}
        self._advance()

    def take(self, number: int) -> bool:
        """Note a number that arrived; returns whether it is new."""
        if number < self.next or number in self.early:
            return False
        self.early.add(number)
        self._advance()
        return True

    def _advance(self) -> None:
        while self.next in self.early:
            self.early.remove(self.next)
            self.next += 1
