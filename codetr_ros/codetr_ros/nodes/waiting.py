"""For how long a node has waited for the same thing."""


class Waiting:
    """Counts from when a node began to wait for what it waits for now. Where that changes,
    something has come, and nobody has waited in vain.

    Attributes:
        since: monotonic time [s] since which it has waited for that; None while it works.
    """

    def __init__(self) -> None:
        self.since: float | None = None
        self._doing = ''

    def over(self) -> None:
        """Note that the node works, or has read nothing for a while."""
        self.since = None

    def seconds(self, doing: str, now: float) -> float:
        """For how long it has waited.

        Args:
            doing: what it does, in words.
            now: monotonic time [s].
        """
        if self.since is None or doing != self._doing:
            self.since, self._doing = now, doing
        return now - self.since
