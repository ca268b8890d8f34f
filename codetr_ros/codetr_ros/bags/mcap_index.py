"""What an MCAP file says of itself beside its messages: compared with what is there.

Nothing is read by an index here; others do, and what it hides is lost to them.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from mcap.opcode import Opcode


class IndexChecks:
    """Compares the indexes, times and checksums of one file; some bytes for each chunk."""

    def __init__(self, magic: bytes) -> None:
        self._crc = zlib.crc32(magic)
        self._summary_crc = 0
        self._entries: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._chunks: dict[int, tuple[int, int, int]] = {}  # offset -> length, start, end
        self._indexed = 0

    def data(self, head: bytes, content: bytes) -> None:
        """A record of the data section passes by."""
        self._crc = zlib.crc32(content, zlib.crc32(head, self._crc))

    def summary(self, head: bytes, content: bytes) -> None:
        """A record of the summary passes by."""
        self._summary_crc = zlib.crc32(content, zlib.crc32(head, self._summary_crc))

    def message(self, channel: int, log_time: int, offset: int) -> None:
        """A message of the chunk at hand."""
        self._entries[channel].append((log_time, offset))

    def chunk(self, at: int, length: int, start: int, end: int) -> Iterator[str]:
        """All messages of a chunk have passed by."""
        self._chunks[at] = length, start, end
        times = [time for entries in self._entries.values() for time, _ in entries]
        if times and (start, end) != (min(times), max(times)):
            yield (
                f'the chunk says that its messages are from {start} to {end}, they are from '
                f'{min(times)} to {max(times)}'
            )

    def forget(self) -> None:
        """A new chunk begins."""
        self._entries.clear()

    def message_index(self, record: Any) -> Iterator[str]:
        """The messages of one channel in the chunk before."""
        if sorted(record.records) != sorted(self._entries.get(record.channel_id, [])):
            yield f'the index of channel {record.channel_id} does not agree with its chunk'

    def chunk_index(self, record: Any) -> Iterator[str]:
        """One chunk, in the summary."""
        self._indexed += 1
        there = self._chunks.get(record.chunk_start_offset)
        said = record.chunk_length, record.message_start_time, record.message_end_time
        if there != said:
            yield f'the index has a chunk at byte {record.chunk_start_offset} that is not there so'

    def data_end(self, record: Any) -> Iterator[str]:
        """The end of the data section."""
        if record.data_section_crc not in (0, self._crc):
            yield (
                f'the CRC of everything before is {self._crc:#010x}, not '
                f'{record.data_section_crc:#010x}'
            )

    def footer(self, record: Any) -> Iterator[str]:
        """The end of the file."""
        if self._indexed not in (0, len(self._chunks)):
            yield f'the index has {self._indexed} chunks, the file {len(self._chunks)}'
        start = struct.pack(
            '<BQQQ', Opcode.FOOTER, 20, record.summary_start, record.summary_offset_start
        )
        crc = zlib.crc32(start, self._summary_crc)
        if record.summary_crc not in (0, crc):
            yield f'the CRC of the summary is {crc:#010x}, not {record.summary_crc:#010x}'
