"""One MCAP file, read from front to back: every message in file order, every chunk's CRC checked,
every length compared with what is there before memory is taken.

Other libraries read a whole, indexed file in order of time, or stop at the first fault. No index
is needed here, so the file of a killed recorder reads like any other, and after a fault reading
goes on at the next chunk. `mcap` parses the records themselves.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap import records as mcap_records
from mcap.opcode import Opcode

from codetr_ros.bags.errors import Damage, Place
from codetr_ros.bags.mcap_channels import McapChannels
from codetr_ros.bags.mcap_index import IndexChecks
from codetr_ros.bags.mcap_layout import (
    HEAD,
    LARGEST_RECORD,
    MAGIC,
    MESSAGE,
    MESSAGE_BODY,
    SMALL,
    SUMMARY,
    FaultError,
    chunk_data,
    chunk_head,
    message_head,
    next_record,
    parse_record,
    resume_at,
    summary_records,
)
from codetr_ros.bags.raw import Channel, OnDamage, RawMessage


class McapFile:
    """Reads one file.

    Args:
        path: the file.
        on_damage: receives each fault, and reading goes on at the next chunk. By default the first
            fault is an error.
        shown: the name in places and errors of a file that has been unpacked.
        thorough: compare indexes, summary and the checksums over both too.
        known: the topics that the file describes, from an earlier reading.

    Attributes:
        counts: messages read so far, by topic.
        chunks: chunks read so far.
        unchecked: those of them without a CRC: a changed bit in them goes unnoticed. Messages
            outside chunks count here too.
        finished: whether the file has its end: false if its writer was killed.
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
        self.counts: Counter[str] = Counter()
        self.chunks = 0
        self.unchecked = 0
        self.finished = False
        self._on_damage = on_damage
        self._checks = IndexChecks(MAGIC) if thorough else None
        self._described = known or McapChannels()
        self._ids: Counter[int] = Counter()
        self._indexed: Counter[int] | None = None  # messages of the last chunk, by channel
        self._faulty = self._borrowed = False
        self._from_begin = True

    @property
    def library(self) -> str:
        """The program that wrote it, as its header names it."""
        return self._described.library

    @property
    def described(self) -> McapChannels:
        """What it has described so far, for another reading of it."""
        return self._described

    def channels(self) -> list[Channel]:
        """The topics met so far."""
        return self._described.all()

    def messages(self, start: Place | None = None) -> Iterator[RawMessage]:
        """Every message, in file order.

        Args:
            start: begin with the record or chunk there, in a file whose topics are known.

        Raises:
            BagError: the file cannot be opened, is no MCAP file, or is damaged: `on_damage`, if
                given, receives that instead.
        """
        try:
            with self.path.open('rb') as file:
                yield from self._records(file, start.offset if start else 0)
        except OSError as error:
            self._report(0, f'cannot be read: {error.strerror}', _size(self.path), unread=True)

    def _compare(self, at: int, texts: Iterator[str]) -> None:
        """Report what is wrong with an index: no message is lost by that."""
        for text in texts:
            self._report(at, text, 0, harmless=True)

    def _report(
        self, offset: int, text: str, lost: int, harmless: bool = False, unread: bool = False
    ) -> None:
        damage = Damage(Place(self.shown, offset), text, lost, harmless, unread)
        self._faulty |= not harmless
        if self._on_damage is not None:
            self._on_damage(damage)
        elif not harmless:
            raise damage.error()

    def _records(self, file: BinaryIO, start: int) -> Iterator[RawMessage]:
        size = file.seek(0, 2)
        file.seek(0)
        self._from_begin = not start
        at = start or self._begin(file, size)
        if at == size > len(MAGIC):
            return  # the disk cannot read any of it
        ended = False
        while at < size:
            if self._faulty and not self._borrowed:
                self._borrowed = True
                self._described.borrow(summary_records(file, size))
            file.seek(at)
            try:
                opcode, content = self._next(file, size - at, ended)
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
                self._report(at, str(fault), after - at, harmless=ended)
                self._indexed = None
                at = after
            except OSError as error:
                at = self._unread(file, at, size, error, harmless=ended)
                if at == size:
                    return
        self._report(size, 'the file ends here, without its index: its writer was killed', 0)

    def _begin(self, file: BinaryIO, size: int) -> int:
        """Check how the file begins and return where its records do."""
        try:
            magic = file.read(len(MAGIC))
        except OSError as error:
            return self._unread(file, 0, size, error)
        if magic != MAGIC:
            text = 'is empty' if not size else f'begins with {magic!r}: it is no MCAP file'
            self._report(0, text, size if size < len(MAGIC) else 0)
        return len(magic)

    def _unread(
        self, file: BinaryIO, at: int, size: int, error: OSError, harmless: bool = False
    ) -> int:
        """Report that the disk cannot be read there and return where to go on."""
        after = resume_at(file, at, size)
        text = f'cannot be read: {error.strerror}'
        self._report(at, text, after - at, harmless, unread=not harmless)
        self._indexed = None
        return after

    def _next(self, file: BinaryIO, left: int, ended: bool) -> tuple[int, bytes]:
        head, opcode, content = next_record(file, left)
        if self._checks is not None and opcode not in (Opcode.DATA_END, Opcode.FOOTER):
            (self._checks.summary if ended else self._checks.data)(head, content)
        return opcode, content

    def _chunk(self, at: int, content: bytes) -> Iterator[RawMessage]:
        start, end, size, crc, named = chunk_head(content)
        if size > LARGEST_RECORD:
            raise FaultError(f'a chunk of {size} bytes: at most {LARGEST_RECORD} are read')
        try:
            raw = chunk_data(content, named, size, crc)
        except FaultError as fault:
            lost = HEAD.size + len(content)
            self._indexed = None
            self._report(at, f'a chunk of {size} bytes is damaged: {fault}', lost)
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
        path, described = self.shown, self._described
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
                channel = described.of(number)
                if channel is None:
                    raise FaultError(
                        f'a message at byte {place} of it is of channel {number}, '
                        'which the file does not describe'
                    )
            except FaultError as fault:
                self._report(at, f'a chunk is damaged inside: {fault}', size - place)
                return
            counts[number] += 1
            if self._checks is not None:
                self._checks.message(number, log_time, place)
            self._count(number, channel)
            where = Place(path, at, place)
            yield RawMessage(channel, log_time, published, sequence, raw[begin:end], where)
            place = end

    def _count(self, number: int, channel: Channel) -> None:
        self._ids[number] += 1
        self.counts[channel.topic] += 1

    def _lone_message(self, at: int, content: bytes) -> RawMessage:
        number, sequence, log_time, published = message_head(content)
        channel = self._described.of(number)
        if channel is None:
            raise FaultError(f'a message of channel {number}, which the file does not describe')
        self.unchecked += 1
        self._count(number, channel)
        data = memoryview(content)[MESSAGE_BODY:]
        return RawMessage(channel, log_time, published, sequence, data, Place(self.shown, at))

    def _small(self, at: int, opcode: int, content: bytes) -> bool:
        """Note a record that is neither message nor chunk; true if the data ends with it."""
        kind = SMALL.get(Opcode(opcode)) if opcode in Opcode.__members__.values() else None
        if kind is None:
            if opcode not in (Opcode.ATTACHMENT, *range(0x80, 0x100)):
                raise FaultError(f'a record of kind {opcode:#04x}, which does not belong here')
            return False
        record = parse_record(kind, content)
        self._described.take(record)
        if isinstance(record, mcap_records.Header):
            self._described.library = record.library
        elif isinstance(record, mcap_records.MessageIndex):
            count = self._indexed.pop(record.channel_id, 0) if self._indexed is not None else None
            if count is not None and len(record.records) != count:
                raise FaultError(
                    f'the index names {len(record.records)} messages of channel '
                    f'{record.channel_id}, its chunk has {count}'
                )
            if self._checks is not None and count is not None:
                self._compare(at, self._checks.message_index(record))
        elif self._checks is not None and isinstance(record, mcap_records.DataEnd):
            self._compare(at, self._checks.data_end(record))
        return isinstance(record, mcap_records.DataEnd)

    def _end(self, file: BinaryIO, at: int, opcode: int, content: bytes, size: int) -> bool:
        """Check a record of the summary; true if it is the file's last."""
        if opcode == Opcode.FOOTER:
            footer = parse_record(mcap_records.Footer, content)
            self.finished = True
            if self._checks is not None:
                self._compare(at, self._checks.footer(footer))
            rest = file.read(len(MAGIC) + 1)
            if rest != MAGIC:
                self._report(at, f'the file goes on with {rest!r} after its end', 0, harmless=True)
            return True
        if opcode not in SUMMARY:
            raise FaultError(f'a record of kind {opcode:#04x}, which does not belong here')
        record = parse_record(SUMMARY[Opcode(opcode)], content)
        if isinstance(record, mcap_records.Statistics):
            stated, read = record.message_count, self._ids.total()
            if self._from_begin and stated != read:
                self._report(at, f'the file counts {stated} messages, {read} were read', 0)
        elif self._checks is not None and isinstance(record, mcap_records.ChunkIndex):
            self._compare(at, self._checks.chunk_index(record))
        return False


def _size(path: Path) -> int:
    """Bytes of a file; 0 if they cannot be known."""
    try:
        return path.stat().st_size
    except OSError:
        return 0
