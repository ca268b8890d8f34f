"""Notes joints that two nodes publish on one topic: their values jump there and back.

Nothing in a bag shows which node a message is from. But where one node publishes the measured
positions and another one zeros, say, a message is far from the one before it and close to the one
before that. The limits are choices of this project: independent noise of one joint jumps in 5 % of
its messages.
"""

import numpy as np

from codetr_ros.records import F64

_FAR = 10.0  # times as far from the message before as from the one before that
_FEWEST = 5  # messages that must jump
_SHARE = 0.12  # of all messages that must jump
_BATCH = 256  # messages that are looked at together


class DoubledJoints:
    """Follows the values of the joints on one topic."""

    def __init__(self) -> None:
        self._waiting: list[F64] = []
        self._messages = self._jumps = 0

    def take(self, values: F64) -> None:
        """Include the values of a message."""
        if self._waiting and len(self._waiting[-1]) != len(values):
            self._waiting.clear()
        self._waiting.append(values)
        self._messages += 1
        if len(self._waiting) == _BATCH:
            self._look()

    def _look(self) -> None:
        """Count the jumps among the messages that wait, and keep the last two."""
        rows = np.array(self._waiting)
        with np.errstate(invalid='ignore', over='ignore'):  # NaN: no jump
            step = np.abs(rows[1:] - rows[:-1]).max(axis=1)
            back = np.abs(rows[2:] - rows[:-2]).max(axis=1)
            self._jumps += int((np.minimum(step[1:], step[:-1]) > _FAR * back).sum())
        self._waiting = self._waiting[-2:]

    @property
    def count(self) -> int:
        """Messages that jumped; 0 where these are too few to show anything."""
        if len(self._waiting) > 2:
            self._look()
        enough = self._jumps >= max(_FEWEST, _SHARE * self._messages)
        return self._jumps if enough else 0
