"""Whether this process was held for a while: stopped by a signal, or on a machine that slept."""

AWAY = 2.0
"""Seconds between two looks after which who looks was away."""


class Attention:
    """Notices that nobody has looked for a while.

    What came meanwhile has not been read. So nobody else was silent, and nothing was waited for in
    vain: both count from now on.
    """

    def __init__(self) -> None:
        self._looked: float | None = None

    def was_away(self, now: float) -> float:
        """For how long [s] nobody had looked, if that is too long; else 0.

        Args:
            now: monotonic time [s].
        """
        before, self._looked = self._looked, now
        away = 0.0 if before is None else now - before
        return away if away > AWAY else 0.0
