"""How an MCAP file is laid out: its records, and where the next sound one begins."""

import re
import struct
import zlib
from io import BytesIO
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAGIC = b'\x89MCAP0\r\n'
LARGEST_RECORD = 256 << 20
"""The most bytes of a record, compressed or not: one that claims more is taken for damage. A
reader holds one record and what it decompresses to."""

HEAD = struct.Struct('<BQ')  # opcode, length of what follows
CHUNK = struct.Struct('<QQQII')  # start, end, size, crc, length of the compression's name
MESSAGE = struct.Struct('<BQHIQQ')  # head, channel, sequence, log time, publish time
MESSAGE_BODY = MESSAGE.size - HEAD.size
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # the same without the head
_PIECE = 1 << 20
_SECTOR = 4096
_LONGEST_START = HEAD.size + CHUNK.size + len('zstd') + 8  # of what `_CHUNK_START` matches
_CHUNK_START = re.compile(
    rb'\x06.{8}.{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd).{8}', re.DOTALL
)
SUMMARY = {
    Opcode.SCHEMA: mcap_records.Schema,
    Opcode.CHANNEL: mcap_records.Channel,
    Opcode.STATISTICS: mcap_records.Statistics,
    Opcode.CHUNK_INDEX: mcap_records.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: mcap_records.AttachmentIndex,
    Opcode.METADATA_INDEX: mcap_records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: mcap_records.SummaryOffset,
}
SMALL = {
    Opcode.HEADER: mcap_records.Header,
    Opcode.SCHEMA: mcap_records.Schema,
    Opcode.CHANNEL: mcap_records.Channel,
    Opcode.MESSAGE_INDEX: mcap_records.MessageIndex,
    Opcode.METADATA: mcap_records.Metadata,
    Opcode.DATA_END: mcap_records.DataEnd,
}


class FaultError(Exception):
    """Something in the file is not as it must be."""


def parse_record(kind: Any, content: bytes | memoryview) -> Any:
    """A record of the file's structure from its bytes.

    Raises:
        FaultError: they are no such record.
    """
    stream = ReadDataStream(BytesIO(content))
    try:
        record = kind.read(stream)
    except (McapError, struct.error, UnicodeDecodeError) as error:
        raise FaultError(f'a {kind.__name__} record cannot be read: {error}') from error
    if stream.count != len(content):
        raise FaultError(f'a {kind.__name__} record has {len(content)} bytes, not {stream.count}')
    return record


def decompressed(data: memoryview, compression: str, size: int) -> bytes | memoryview:
    """A chunk's records.

    Raises:
        FaultError: the data is damaged, or does not have that size.
    """
    if compression == '':
        raw: bytes | memoryview = data
    elif compression == 'zstd':
        try:
            raw = unzstd(data, size)
        except zstandard.ZstdError as error:
            raise FaultError(f'its zstd data is damaged ({error})') from error
    elif compression == 'lz4':
        try:
            raw = _unlz4(data, size)
        except (RuntimeError, EOFError) as error:
            raise FaultError(f'its lz4 data is damaged ({error})') from error
    else:
        raise FaultError(f'its compression {compression!r} is not known')
    if len(raw) != size:
        raise FaultError(f'it has {len(raw)} bytes where {size} are announced')
    return raw


def unzstd(data: bytes | memoryview, most: int) -> bytes:
    """Unpack data piece by piece, so that it takes the memory it fills, not what it announces.

    Args:
        data: compressed.
        most: bytes after which unpacking stops; whatever has more gives at least one more.

    Raises:
        zstandard.ZstdError: it is damaged.
    """
    unpacked = BytesIO()
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        while unpacked.tell() <= most and (piece := stream.read(min(_PIECE, most + 1))):
            unpacked.write(piece)
    return unpacked.getvalue()


def _unlz4(data: memoryview, most: int) -> bytes:
    unpacked = BytesIO()
    stream = lz4.frame.LZ4FrameDecompressor()
    piece: bytes = stream.decompress(data, max_length=_PIECE)
    while piece:
        unpacked.write(piece)
        if stream.eof or unpacked.tell() > most:
            break
        piece = stream.decompress(b'', max_length=_PIECE)
    return unpacked.getvalue()


def chunk_head(content: bytes) -> tuple[int, int, int, int, int]:
    """The numbers at a chunk's beginning, if its lengths agree.

    Raises:
        FaultError: they do not.
    """
    if len(content) < CHUNK.size + 8:
        raise FaultError(f'a chunk of {len(content)} bytes')
    start, end, size, crc, named = CHUNK.unpack_from(content)
    begin = CHUNK.size + named + 8
    if begin > len(content):
        raise FaultError(f'a chunk whose compression has a name of {named} bytes')
    (length,) = struct.unpack_from('<Q', content, begin - 8)
    if begin + length != len(content):
        raise FaultError(f'a chunk of {len(content) - begin} bytes that states {length}')
    return start, end, size, crc, named


def resume_at(file: BinaryIO, at: int, size: int) -> int:
    """Where to go on behind a record that cannot be read: at the next chunk, or at the record that
    follows by its length, whichever comes first.
    """
    chunk = next_chunk(file, at + 1, size)
    try:
        file.seek(at)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            return size
        follows: int = at + HEAD.size + HEAD.unpack(head)[1]
        if follows >= min(chunk, size - HEAD.size):
            return chunk
        file.seek(follows)
        opcode, length = HEAD.unpack(file.read(HEAD.size))
    except OSError:  # of the disk: the caller reports it
        return chunk
    known = opcode in Opcode.__members__.values()
    return follows if known and follows + HEAD.size + length <= size else chunk


def next_chunk(file: BinaryIO, at: int, size: int) -> int:
    """Where the next chunk begins whose lengths agree; the file's size if there is none.

    Where the disk cannot be read, it skips ahead by doubling distances: each try may take seconds.
    """
    length, skip = _PIECE, _SECTOR
    while at < size:
        try:
            file.seek(at)
            view = file.read(length + _LONGEST_START - 1)
        except OSError:
            if length > _SECTOR:
                length = _SECTOR  # perhaps only the end of the piece is unreadable
            else:
                at, skip = at + skip, 2 * skip
            continue
        offset = _chunk_in(view, length, size - at)
        if offset is not None:
            return at + offset
        at += length
        length, skip = min(2 * length, _PIECE), _SECTOR
    return size


def _chunk_in(view: bytes, length: int, left: int) -> int | None:
    """Where in the first `length` bytes a chunk begins that ends within those that are left."""
    at = 0
    while (match := _CHUNK_START.search(view, at)) and (start := match.start()) < length:
        _, size = HEAD.unpack_from(view, start)
        (named,) = struct.unpack_from('<I', view, start + HEAD.size + CHUNK.size - 4)
        (data,) = struct.unpack_from('<Q', view, start + HEAD.size + CHUNK.size + named)
        if size == CHUNK.size + named + 8 + data and start + HEAD.size + size <= left:
            return start
        at = start + 1
    return None


def chunk_data(content: bytes, named: int, size: int, crc: int) -> bytes | memoryview:
    """The records of a chunk, decompressed.

    Args:
        content: of the chunk record.
        named: length of the compression's name.
        size: bytes when decompressed.
        crc: of these bytes; 0 where the writer made none.

    Raises:
        FaultError: they cannot be decompressed, or their CRC differs.
    """
    name = bytes(content[CHUNK.size : CHUNK.size + named])
    data = memoryview(content)[CHUNK.size + named + 8 :]
    raw = decompressed(data, name.decode('ascii', 'replace'), size)
    if crc and (actual := zlib.crc32(raw)) != crc:
        raise FaultError(f'its CRC is {actual:#010x}, not {crc:#010x}')
    return raw


def next_record(file: BinaryIO, left: int) -> tuple[bytes, int, bytes]:
    """The record that begins where the file stands, `left` bytes before the file's end.

    Returns:
        Its head, its opcode and its content.

    Raises:
        FaultError: it is cut off, of no kind, or longer than what is left or may be read.
    """
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        raise FaultError(f'cut off within a record: {len(head)} bytes are left')
    opcode, length = HEAD.unpack(head)
    left -= HEAD.size
    if not opcode:
        raise FaultError('a record of kind 0, which does not exist')
    if length > left:
        raise FaultError(f'a record of {length} bytes where {left} are left')
    if length > LARGEST_RECORD:
        raise FaultError(f'a record of {length} bytes: at most {LARGEST_RECORD} are read')
    return head, opcode, file.read(length)


def message_head(content: bytes) -> tuple[int, int, int, int]:
    """Channel, sequence number, log time and publish time [ns] of a message record.

    Raises:
        FaultError: it is too short to have them.
    """
    if len(content) < MESSAGE_BODY:
        raise FaultError(f'a message of {len(content)} bytes')
    return _MESSAGE_HEAD.unpack_from(content)


def summary_records(file: BinaryIO, size: int) -> list[Any]:
    """The summary's schemas and channels; none unless its checksum is there and right."""
    try:
        return _summary_records(file, size)
    except OSError:  # of the disk: reported where the file is read that far
        return []


def _summary_records(file: BinaryIO, size: int) -> list[Any]:
    tail = HEAD.size + 20 + len(MAGIC)  # footer and magic
    if size < tail:
        return []
    file.seek(size - tail)
    footer = file.read(tail)
    opcode, length, start, _, crc = struct.unpack_from('<BQQQI', footer)
    end = size - tail
    if (opcode, length) != (Opcode.FOOTER, 20) or not 0 < start < end:
        return []
    if end - start > LARGEST_RECORD:
        return []
    file.seek(start)
    summary = file.read(end - start)
    if not crc or zlib.crc32(footer[: HEAD.size + 16], zlib.crc32(summary)) != crc:
        return []
    records, at = [], 0
    while at + HEAD.size <= len(summary):
        opcode, length = HEAD.unpack_from(summary, at)
        content = summary[at + HEAD.size : at + HEAD.size + length]
        at += HEAD.size + length
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            records.append(parse_record(SUMMARY[Opcode(opcode)], content))
    return records
