"""When a node asks the recorder for a committed phase again."""

AFTER = 3.0  # [s] for messages that are still under way
AGAIN = 5.0  # [s] until the next try


class Fetching:
    """Decides when to ask for a phase that stays incomplete.

    Attributes:
        since: from when on it is asked for in vain [s]: it was found missing, or somebody has
            answered that it is still to come. None: nothing is missing.
    """

    def __init__(self) -> None:
        self._missing: int | None = None
        self._due = 0.0
        self.since: float | None = None

    def due(self, missing: int | None, now: float, at_once: bool = False) -> bool:
        """Whether to ask for a phase now.

        Args:
            missing: the committed phase that is incomplete; None if there is none.
            now: monotonic time [s].
            at_once: nothing of it is under way any more.
        """
        if missing != self._missing:
            self._missing, self._due = missing, now + (0.0 if at_once else AFTER)
            self.since = None if missing is None else now
        if missing is None or now < self._due:
            return False
        self._due = now + AGAIN
        return True

    def to_come(self, now: float) -> None:
        """Note the answer that what is missing is still to come: it was not asked for in vain.

        Args:
            now: monotonic time [s].
        """
        if self._missing is not None:
            self.since = now


class Offered:
    """Tells labels that were lost from those that are under way. The reward node answers as soon
    as it has them, so that the first answer may overtake them or come right behind them.
    """

    def __init__(self) -> None:
        self._phase: int | None = None
        self._since = 0.0

    def lost(self, phase: int, now: float) -> bool:
        """Whether what was published of a phase should have arrived long ago.

        Args:
            phase: whose labels another node offers.
            now: monotonic time [s].
        """
        if phase != self._phase:
            self._phase, self._since = phase, now
        return now >= self._since + AFTER
