"""One MCAP file, read from front to back: every message in file order, every chunk's CRC checked,
every length compared with what is there before anything is taken.

The libraries at hand read a whole, indexed file in order of time, or stop at the first fault. Here
the index is not needed, so that the file of a killed recorder reads like any other, and after a
fault reading goes on at the next chunk. The records themselves are taken apart by `mcap`.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from mcap import records as mcap_records
from mcap.opcode import Opcode

from codetr_ros.bags.definitions import Definition
from codetr_ros.bags.errors import Damage, Place
from codetr_ros.bags.mcap_index import IndexChecks
from codetr_ros.bags.mcap_layout import (
    CHUNK,
    HEAD,
    LARGEST_RECORD,
    MAGIC,
    MESSAGE,
    MESSAGE_BODY,
    SMALL,
    SUMMARY,
    FaultError,
    chunk_head,
    decompressed,
    full_type_name,
    parse_record,
    resume_at,
    summary_records,
)
from codetr_ros.bags.raw import LIBRARY, Channel, OnDamage, RawMessage


class McapFile:
    """Reads one file.

    Args:
        path: the file.
        on_damage: is told what is wrong, and reading goes on at the next chunk. By default the
            first fault is an error.
        shown: what it is called in places and errors, where it has been unpacked.
        thorough: compare indexes, summary and the checksums over both too.

    Attributes:
        library: who wrote it, as the file says.
        counts: messages read so far, by topic.
        chunks: chunks read so far.
        unchecked: of these, such as carry no CRC: a changed bit in them goes unnoticed. Messages
            outside chunks count here too.
        finished: whether the file has its end: false if its writer was killed.
    """

    def __init__(
        self,
        path: Path,
        on_damage: OnDamage | None = None,
        shown: Path | None = None,
        thorough: bool = False,
    ) -> None:
        self.path = path
        self.shown = shown or path
        self.library = ''
        self.counts: Counter[str] = Counter()
        self.chunks = 0
        self.unchecked = 0
        self.finished = False
        self._on_damage = on_damage
        self._checks = IndexChecks(MAGIC) if thorough else None
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Channel] = {}
        self._said: dict[int, Any] = {}
        self._ids: Counter[int] = Counter()
        self._indexed: Counter[int] | None = None  # messages of the last chunk, by channel
        self._faulty = self._borrowed = False

    def channels(self) -> list[Channel]:
        """The topics that have been met so far."""
        return list(self._channels.values())

    def messages(self) -> Iterator[RawMessage]:
        """Every message, in file order.

        Raises:
            BagError: the file cannot be opened, is no MCAP file, or is damaged (unless that is
                told to `on_damage`).
        """
        try:
            with self.path.open('rb') as file:
                yield from self._records(file)
        except OSError as error:
            lost = 0
            with suppress(OSError):
                lost = self.path.stat().st_size
            self._say(0, f'cannot be read: {error.strerror}', lost, unread=True)

    def _compare(self, at: int, texts: Iterator[str]) -> None:
        """Say what an index has wrong: no message is by that."""
        for text in texts:
            self._say(at, text, 0, harmless=True)

    def _say(
        self, offset: int, text: str, lost: int, harmless: bool = False, unread: bool = False
    ) -> None:
        damage = Damage(Place(self.shown, offset), text, lost, harmless, unread)
        self._faulty |= not harmless
        if self._on_damage is not None:
            self._on_damage(damage)
        elif not harmless:
            raise damage.error()

    def _records(self, file: BinaryIO) -> Iterator[RawMessage]:
        size = file.seek(0, 2)
        file.seek(0)
        at = self._begin(file, size)
        if at == size > len(MAGIC):
            return  # the disk gives nothing of it
        ended = False
        while at < size:
            if self._faulty and not self._borrowed:
                self._borrow(file, size)
            file.seek(at)
            try:
                opcode, content = self._next(file, at, size, ended)
                if ended:
                    if self._end(file, at, opcode, content, size):
                        return
                elif opcode == Opcode.CHUNK:
                    yield from self._chunk(at, content)
                elif opcode == Opcode.MESSAGE:
                    yield self._lone_message(at, content)
                else:
                    ended = self._small(at, opcode, content)
                at += HEAD.size + len(content)
            except FaultError as fault:
                after = resume_at(file, at, size)
                self._say(at, str(fault), after - at, harmless=ended)
                self._indexed = None
                at = after
            except OSError as error:
                at = self._unread(file, at, size, error, harmless=ended)
                if at == size:
                    return
        self._say(size, 'the file ends here, without its index: its writer was killed', 0)

    def _begin(self, file: BinaryIO, size: int) -> int:
        """Check how the file begins; where its records do."""
        try:
            magic = file.read(len(MAGIC))
        except OSError as error:
            return self._unread(file, 0, size, error)
        if magic != MAGIC:
            text = 'is empty' if not size else f'begins with {magic!r}: it is no MCAP file'
            self._say(0, text, size if size < len(MAGIC) else 0)
        return len(magic)

    def _unread(
        self, file: BinaryIO, at: int, size: int, error: OSError, harmless: bool = False
    ) -> int:
        """Say that the disk does not give what lies there; where to go on."""
        after = resume_at(file, at, size)
        text = f'cannot be read: {error.strerror}'
        self._say(at, text, after - at, harmless, unread=not harmless)
        self._indexed = None
        return after

    def _borrow(self, file: BinaryIO, size: int) -> None:
        """Take topics from the summary, which repeats them: the chunk that described them may be
        the one that is damaged.
        """
        self._borrowed = True
        for record in summary_records(file, size):
            if isinstance(record, mcap_records.Schema):
                self._schemas.setdefault(record.id, record)
            elif isinstance(record, mcap_records.Channel) and record.id not in self._said:
                with suppress(FaultError):  # a writer need not repeat the definitions there
                    self._channels[record.id] = self._channel(record)
                    self._said[record.id] = record

    def _next(self, file: BinaryIO, at: int, size: int, ended: bool) -> tuple[int, bytes]:
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            raise FaultError(f'cut off within a record: {len(head)} bytes are left')
        opcode, length = HEAD.unpack(head)
        left = size - at - HEAD.size
        if not opcode:
            raise FaultError('a record of kind 0, which there is not')
        if length > left:
            raise FaultError(f'a record of {length} bytes where {left} are left')
        if length > LARGEST_RECORD:
            raise FaultError(f'a record of {length} bytes: at most {LARGEST_RECORD} are read')
        content = file.read(length)
        if self._checks is not None and opcode not in (Opcode.DATA_END, Opcode.FOOTER):
            (self._checks.summary if ended else self._checks.data)(head, content)
        return opcode, content

    def _chunk(self, at: int, content: bytes) -> Iterator[RawMessage]:
        start, end, size, crc, named = chunk_head(content)
        name = bytes(content[CHUNK.size : CHUNK.size + named])
        data = memoryview(content)[CHUNK.size + named + 8 :]
        if size > LARGEST_RECORD:
            raise FaultError(f'a chunk of {size} bytes: at most {LARGEST_RECORD} are read')
        try:
            raw = decompressed(data, name.decode('ascii', 'replace'), size)
            if crc and (found := zlib.crc32(raw)) != crc:
                raise FaultError(f'its CRC is {found:#010x}, not {crc:#010x}')
        except FaultError as fault:
            lost = HEAD.size + len(content)
            self._indexed = None
            self._say(at, f'a chunk of {size} bytes is damaged: {fault}', lost)
            return
        self.chunks += 1
        self.unchecked += not crc
        self._indexed = Counter()
        if self._checks is not None:
            self._checks.forget()
        yield from self._in(at, memoryview(raw), self._indexed)
        if self._checks is not None:
            self._compare(at, self._checks.chunk(at, HEAD.size + len(content), start, end))

    def _in(self, at: int, raw: memoryview, counts: Counter[int]) -> Iterator[RawMessage]:
        place, size = 0, len(raw)
        path, channels = self.shown, self._channels
        while place < size:
            try:
                if size - place < HEAD.size:
                    raise FaultError(f'{size - place} bytes after the last record')
                opcode, length = HEAD.unpack_from(raw, place)
                begin, end = place + MESSAGE.size, place + HEAD.size + length
                if end > size:
                    raise FaultError(f'a record of {length} bytes at byte {place} of it')
                if opcode != Opcode.MESSAGE:
                    self._small(at, opcode, bytes(raw[place + HEAD.size : end]))
                    place = end
                    continue
                if length < MESSAGE_BODY:
                    raise FaultError(f'a message of {length} bytes at byte {place} of it')
                _, _, number, sequence, log_time, published = MESSAGE.unpack_from(raw, place)
                channel = channels.get(number)
                if channel is None:
                    raise FaultError(
                        f'a message at byte {place} of it is of channel {number}, '
                        'which the file does not describe'
                    )
            except FaultError as fault:
                self._say(at, f'a chunk is damaged inside: {fault}', size - place)
                return
            counts[number] += 1
            if self._checks is not None:
                self._checks.message(number, log_time, place)
            self._count(number, channel)
            yield RawMessage(
                channel, log_time, published, sequence, raw[begin:end], Place(path, at, place)
            )
            place = end

    def _count(self, number: int, channel: Channel) -> None:
        self._ids[number] += 1
        self.counts[channel.topic] += 1

    def _lone_message(self, at: int, content: bytes) -> RawMessage:
        if len(content) < MESSAGE_BODY:
            raise FaultError(f'a message of {len(content)} bytes')
        number, sequence, log_time, published = struct.unpack_from('<HIQQ', content)
        channel = self._channels.get(number)
        if channel is None:
            raise FaultError(f'a message of channel {number}, which the file does not describe')
        self.unchecked += 1
        self._count(number, channel)
        place = Place(self.shown, at)
        return RawMessage(
            channel, log_time, published, sequence, memoryview(content)[MESSAGE_BODY:], place
        )

    def _small(self, at: int, opcode: int, content: bytes) -> bool:
        """Take note of a record that is neither message nor chunk; whether the data ends here."""
        kind = SMALL.get(Opcode(opcode)) if opcode in Opcode.__members__.values() else None
        if kind is None:
            if opcode not in (Opcode.ATTACHMENT, *range(0x80, 0x100)):
                raise FaultError(f'a record of kind {opcode:#04x}, which does not belong here')
            return False
        record = parse_record(kind, content)
        if isinstance(record, mcap_records.Schema):
            self._describe(self._schemas, record)
        elif isinstance(record, mcap_records.Channel):
            self._describe(self._said, record)
            self._channels[record.id] = self._channel(record)
        elif isinstance(record, mcap_records.Header):
            self.library = record.library
        elif isinstance(record, mcap_records.MessageIndex):
            found = self._indexed.pop(record.channel_id, 0) if self._indexed is not None else None
            if found is not None and len(record.records) != found:
                raise FaultError(
                    f'the index names {len(record.records)} messages of channel '
                    f'{record.channel_id}, its chunk has {found}'
                )
            if self._checks is not None and found is not None:
                self._compare(at, self._checks.message_index(record))
        elif self._checks is not None and isinstance(record, mcap_records.DataEnd):
            self._compare(at, self._checks.data_end(record))
        return isinstance(record, mcap_records.DataEnd)

    def _describe(self, known: dict[int, Any], record: Any) -> None:
        if known.setdefault(record.id, record) != record:
            raise FaultError(
                f'{type(record).__name__} {record.id} is described twice, differently'
            )

    def _channel(self, record: Any) -> Channel:
        schema = self._schemas.get(record.schema_id)
        if schema is None and record.schema_id:
            raise FaultError(f'topic {record.topic} has a definition that the file does not have')
        digest = record.metadata.get('topic_type_hash', '')
        qos = record.metadata.get('offered_qos_profiles', '')
        if schema is None:
            return Channel(
                record.topic, '', record.message_encoding, Definition('', '', digest), qos
            )
        text = schema.data.decode('utf-8', 'replace')
        definition = Definition(schema.encoding, text, digest)
        name = full_type_name(schema.name)
        ours = self.library.startswith(LIBRARY)
        return Channel(record.topic, name, record.message_encoding, definition, qos, ours)

    def _end(self, file: BinaryIO, at: int, opcode: int, content: bytes, size: int) -> bool:
        """Check a record of the summary; whether it is the file's last."""
        if opcode == Opcode.FOOTER:
            footer = parse_record(mcap_records.Footer, content)
            self.finished = True
            if self._checks is not None:
                self._compare(at, self._checks.footer(footer))
            rest = file.read(len(MAGIC) + 1)
            if rest != MAGIC:
                self._say(at, f'the file goes on with {rest!r} after its end', 0, harmless=True)
            return True
        if opcode not in SUMMARY:
            raise FaultError(f'a record of kind {opcode:#04x}, which does not belong here')
        record = parse_record(SUMMARY[Opcode(opcode)], content)
        if isinstance(record, mcap_records.Statistics):
            said, found = record.message_count, self._ids.total()
            if said != found:
                self._say(at, f'the file counts {said} messages, {found} were read', 0)
        elif self._checks is not None and isinstance(record, mcap_records.ChunkIndex):
            self._compare(at, self._checks.chunk_index(record))
        return False
