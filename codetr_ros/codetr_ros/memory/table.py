"""The table of a source's segments, numbered in the order in which their scores came."""

import numpy as np
from numpy.typing import NDArray

from codetr_ros.records import F64, I64

COLUMNS = ('rows', 'lengths', 'offsets', 'episodes', 'values', 'alive')


class SegmentTable:
    """The places of a source's segments, and their composite rewards: NaN where there is none.

    Segment number n stands at n - `first` of every column, of which `count` entries are in use.
    The columns grow by a quarter. They move up when half of them belongs to evicted segments.

    Args:
        capacity: slots of the source's ring: row r lies in slot r % capacity.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.first = 0
        self.count = 0
        self.rows = np.empty(64, np.int64)  # of the first step
        self.lengths = np.empty(64, np.int32)
        self.offsets = np.empty(64, np.uint32)  # the first step's number within the episode
        self.episodes = np.empty(64, np.uint32)
        self.values = np.empty(64, np.float64)
        self.alive = np.empty(64, np.bool_)  # not evicted
        # of each slot: 1 + the number of the segment that begins there, or 0; takes memory only
        # where there are scores
        self._beginning = np.zeros(capacity, np.uint32)

    def nbytes(self, rows: int) -> int:
        """Bytes in use if the ring has so many rows in use."""
        each: int = sum(getattr(self, name).itemsize for name in COLUMNS)
        return self.count * each + (rows * self._beginning.itemsize if self.count else 0)

    def numbers(self) -> I64:
        """The numbers of the segments that are held, ascending."""
        return np.flatnonzero(self.alive[: self.count]) + self.first

    def scored(self) -> I64:
        """The numbers of those that have a score, ascending."""
        known = self.alive[: self.count] & ~np.isnan(self.values[: self.count])
        return np.flatnonzero(known) + self.first

    def per_step(self) -> F64:
        """The composite reward per step of each segment that is held and has one."""
        at = self.scored() - self.first
        values: F64 = self.values[at] / self.lengths[at]
        return values

    def beginning_at(self, row: int) -> int | None:
        """The number of the segment whose first step lies in a row that is held."""
        number = int(self._beginning[row % self.capacity])
        return number - 1 if number else None

    def over(self, rows: I64) -> I64:
        """The place in the table of the segment that contains each of these rows (B,)."""
        table = np.flatnonzero(self.alive[: self.count])
        table = table[np.argsort(self.rows[table], kind='stable')]
        return table[np.searchsorted(self.rows[table], rows, side='right') - 1]

    def meets(self, row: int, length: int, before: int) -> bool:
        """Whether a segment has some of `length` steps from a row on.

        Args:
            row: of the first step.
            length: number of steps.
            before: steps of the episode before them in which such a segment may begin.
        """
        number = self._last_beginning(row + length, length + before)
        if number is None:
            return False
        at = number - self.first
        return int(self.rows[at] + self.lengths[at]) > row

    def right_before(self, at: int, steps: int, most: int) -> list[int]:
        """Numbers of the segments with a score that lie right before one in its episode, each
        ending where the next begins, in order.

        Args:
            at: the place of that one in the table.
            steps: of the longest segment.
            most: the most to return.
        """
        row, first = int(self.rows[at]), int(self.offsets[at])
        numbers: list[int] = []
        while len(numbers) < most:
            number = self._last_beginning(row, min(steps, first))
            if number is None:
                break
            place = number - self.first
            length = int(self.lengths[place])
            if int(self.rows[place]) + length != row or np.isnan(self.values[place]):
                break
            numbers.append(number)
            row, first = row - length, first - length
        return numbers[::-1]

    def _last_beginning(self, row: int, back: int) -> int | None:
        """The number of the last segment that begins in the `back` rows before this one."""
        if not self.count:
            return None
        rows = np.arange(row - 1, row - 1 - back, -1)
        begins = self._beginning[rows % self.capacity]
        places = np.flatnonzero(begins)
        return int(begins[places[0]]) - 1 if len(places) else None

    def add(self, row: int, length: int, offset: int, episode: int, value: float) -> None:
        """Add a segment."""
        at = self.count
        if at >= len(self.rows):
            self._grow()
        self.rows[at], self.lengths[at], self.offsets[at] = row, length, offset
        self.episodes[at], self.values[at], self.alive[at] = episode, value, True
        self.count += 1
        self._beginning[row % self.capacity] = self.first + at + 1

    def _grow(self) -> None:
        for name in COLUMNS:
            column = getattr(self, name)
            more = np.empty(max(64, len(column) // 4), column.dtype)
            setattr(self, name, np.concatenate([column, more]))

    def drop(self, slots: NDArray[np.int64]) -> None:
        """Drop the segments that begin in some slots."""
        numbers = self._beginning[slots].astype(np.int64)
        self.alive[numbers[numbers > 0] - 1 - self.first] = False
        self._beginning[slots] = 0
        alive = self.alive[: self.count]
        dead = int(np.argmax(alive)) if alive.any() else self.count
        if dead > self.count // 2 and dead >= 64:
            for name in COLUMNS:
                column = getattr(self, name)
                column[: self.count - dead] = column[dead : self.count].copy()
            self.first += dead
            self.count -= dead
