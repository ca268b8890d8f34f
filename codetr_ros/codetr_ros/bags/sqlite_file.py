"""One SQLite file as rosbag2 and rosbags write it, read in the order of its rows.

SQLite keeps no checksums: pages that contradict each other are noticed, a changed number is not.
"""

import sqlite3
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from codetr_ros.bags.errors import Damage, Place
from codetr_ros.bags.mcap_channels import McapChannels
from codetr_ros.bags.mcap_layout import LARGEST_RECORD
from codetr_ros.bags.raw import Channel, OnDamage, RawMessage
from codetr_ros.bags.schemas import Definition
from codetr_ros.records.names import full_type_name

_DAMAGED = (sqlite3.Error, UnicodeDecodeError, OverflowError)
_FARTHEST = 1 << 40  # rows beyond a damaged one at which to look for the next


class SqliteFile:
    """Reads one file; with the attributes of `McapFile`.

    Args:
        path: the file.
        on_damage: receives each fault; by default the first is an error.
        shown: the name in places and errors of a file that has been unpacked.
    """

    def __init__(
        self,
        path: Path,
        on_damage: OnDamage | None = None,
        shown: Path | None = None,
        thorough: bool = False,
        known: McapChannels | None = None,
    ) -> None:
        self.path = path
        self.shown = shown or path
        self.library = ''
        self.counts: Counter[str] = Counter()
        self.chunks = 0
        self.unchecked = 0
        self.finished = False
        self._on_damage = on_damage
        self._channels: dict[int, Channel] = {}
        self.described = known or McapChannels()  # of MCAP files only

    def channels(self) -> list[Channel]:
        """The topics that the file describes; empty before the first message is read."""
        return list(self._channels.values())

    def messages(self, start: Place | None = None) -> Iterator[RawMessage]:
        """Every message, in the order of the rows.

        Args:
            start: begin with the row there.

        Raises:
            BagError: the file cannot be opened, is no such database, or is damaged: `on_damage`,
                if given, receives that instead.
        """
        try:
            with self.path.open('rb') as file:
                size = file.seek(0, 2)
            if not size:
                raise sqlite3.DatabaseError('it is empty')
            connection = self._connect()
            try:
                self._channels = _channels(connection)
                first = start.offset if start else 1
                yield from self._rows(connection, min(size, LARGEST_RECORD), first - 1)
            finally:
                connection.close()
        except OSError as error:
            self._report(0, f'cannot be read: {error.strerror}', 0, unread=True)
        except _DAMAGED as error:
            self._report(0, f'the database is damaged: {error}', 0, _unread(error))

    def _rows(self, connection: sqlite3.Connection, most: int, row: int) -> Iterator[RawMessage]:
        """The messages behind a row; after rows that cannot be read, from the next that can."""
        while True:
            try:
                for message in self._rows_after(connection, row, most):
                    row = message.place.offset
                    yield message
            except _DAMAGED as error:
                following = _next_row(connection, row, most)
                until = f'{following - 1}' if following else 'the last'
                self._report(
                    row + 1,
                    f'rows {row + 1} to {until} cannot be read, if there are any: {error}',
                    0,
                    _unread(error),
                )
                if following is None:
                    return
                row = following - 1
            else:
                self.finished = True
                return

    def _rows_after(
        self, connection: sqlite3.Connection, row: int, most: int
    ) -> Iterator[RawMessage]:
        # data that claims more bytes than the file has is not even fetched
        rows = connection.execute(
            'SELECT id, topic_id, timestamp, length(data), '
            'CASE WHEN length(data) <= ? THEN data END FROM messages WHERE id > ? ORDER BY id',
            (most, row),
        )
        for number, topic, time, length, data in rows:
            if number <= row:
                raise sqlite3.DatabaseError(f'row {number} follows row {row}')
            row = number
            channel = self._channels.get(topic)
            if channel is None or not isinstance(data, bytes) or type(time) is not int:
                self._report(
                    row, f'no message of a topic that the file describes: {topic!r}', length
                )
                continue
            if time < 0:
                self._report(row, f'its time is {time} ns, before there was time', length)
                continue
            self.counts[channel.topic] += 1
            self.unchecked += 1
            yield RawMessage(channel, time, time, 0, data, Place(self.shown, row))

    def _report(self, row: int, text: str, lost: int, unread: bool = False) -> None:
        damage = Damage(Place(self.shown, row), text, lost or 0, unread=unread)
        if self._on_damage is None:
            raise damage.error()
        self._on_damage(damage)

    def _connect(self) -> sqlite3.Connection:
        """Open for reading only. A journal that a killed recorder left beside the file is part of
        it, and SQLite needs to write in its folder to read it.
        """
        journal = self.path.with_name(f'{self.path.name}-wal')
        left = journal.exists() and journal.stat().st_size
        how = 'mode=ro' if left else 'mode=ro&immutable=1'
        return sqlite3.connect(f'file:{quote(str(self.path))}?{how}', uri=True)


def _unread(error: Exception) -> bool:
    """Whether the disk is at fault, not what is on it: SQLite has these words for that."""
    return 'disk I/O error' in str(error)


def _next_row(connection: sqlite3.Connection, row: int, most: int) -> int | None:
    """The first readable row after a damaged one, None if there is none: searched for at doubling
    distances, then by bisection.
    """

    def readable(number: int) -> tuple[bool, int | None]:
        """Whether the first row from this number on can be read, and its number."""
        try:
            first = connection.execute(
                'SELECT id, CASE WHEN length(data) <= ? THEN data END FROM messages '
                'WHERE id >= ? ORDER BY id LIMIT 1',
                (most, number),
            ).fetchone()
        except _DAMAGED:
            return False, None
        return True, first and first[0]

    step = 1
    while not readable(row + 1 + step)[0]:
        step *= 2
        if step > _FARTHEST:
            return None
    low, high = row + 1 + step // 2, row + 1 + step
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if readable(middle)[0] else (middle, high)
    return readable(high)[1]


def _columns(connection: sqlite3.Connection, table: str) -> set[str]:
    return {row[1] for row in connection.execute(f'PRAGMA table_info({table})')}


def _channels(connection: sqlite3.Connection) -> dict[int, Channel]:
    """The topics. Older files have fewer columns, and no definitions."""
    definitions: dict[str, tuple[str, str]] = {}
    if _columns(connection, 'message_definitions'):
        definitions = {
            name: (encoding, text)
            for name, encoding, text in connection.execute(
                'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
            )
            if isinstance(encoding, str) and isinstance(text, str)
        }
    columns = _columns(connection, 'topics')
    optional = [
        name if name in columns else "''"
        for name in ('offered_qos_profiles', 'type_description_hash')
    ]
    channels = {}
    for number, *texts in connection.execute(
        f'SELECT id, name, type, serialization_format, {", ".join(optional)} FROM topics'
    ):
        if type(number) is not int or not all(isinstance(text, str) for text in texts):
            raise sqlite3.DatabaseError(f'the row of topic {texts[0]!r} is damaged')
        topic, kind, encoding, qos, digest = texts
        definition = Definition(*definitions.get(kind, ('', '')), digest)
        channels[number] = Channel(topic, full_type_name(kind), encoding, definition, qos)
    return channels
