"""A table that is made row by row: what is in its file already is not made again."""

import csv
from collections.abc import Sequence
from pathlib import Path


class Rows:
    """The rows of a CSV file, which is made if there is none.

    Args:
        path: of the file.
        columns: their names.
        keys: how many of them, from the first on, tell a row from others.
    """

    def __init__(self, path: Path, columns: Sequence[str], keys: int) -> None:
        self._path = path
        self._done: set[tuple[str, ...]] = set()
        if path.is_file():
            with path.open() as file:
                rows = csv.DictReader(file)
                self._done = {tuple(row[name] for name in columns[:keys]) for row in rows}
        else:
            path.write_text(','.join(columns) + '\n')

    def read(self) -> list[dict[str, str]]:
        """All rows of the file, by column."""
        with self._path.open() as file:
            return list(csv.DictReader(file))

    def __contains__(self, key: Sequence[object]) -> bool:
        return tuple(map(str, key)) in self._done

    def append(self, row: Sequence[object]) -> None:
        """Write a row, and show it."""
        with self._path.open('a') as file:
            csv.writer(file, lineterminator='\n').writerow(row)
        print(*row, flush=True)
