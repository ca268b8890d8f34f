"""Compares what an MCAP file states about its messages with the messages themselves.

This library reads nothing by an index. Other readers do, and miss what a wrong index hides.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from mcap.opcode import Opcode


class IndexChecks:
    """Compares the indexes, times and checksums of one file. Memory: some bytes for each chunk."""

    def __init__(self, magic: bytes) -> None:
        self._crc = zlib.crc32(magic)
        self._summary_crc = 0
        self._entries: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._chunks: dict[int, tuple[int, int, int]] = {}  # offset -> length, start, end
        self._indexed = 0

    def data(self, head: bytes, content: bytes) -> None:
        """Add a record of the data section to its checksum."""
        self._crc = zlib.crc32(content, zlib.crc32(head, self._crc))

    def summary(self, head: bytes, content: bytes) -> None:
        """Add a record of the summary to its checksum."""
        self._summary_crc = zlib.crc32(content, zlib.crc32(head, self._summary_crc))

    def message(self, channel: int, log_time: int, offset: int) -> None:
        """Note a message of the present chunk."""
        self._entries[channel].append((log_time, offset))

    def chunk(self, at: int, length: int, start: int, end: int) -> Iterator[str]:
        """Compare the times of a chunk with those of its messages, once all are noted."""
        self._chunks[at] = length, start, end
        times = [time for entries in self._entries.values() for time, _ in entries]
        if times and (start, end) != (min(times), max(times)):
            yield (
                f'the chunk states that its messages are from {start} to {end}, they are from '
                f'{min(times)} to {max(times)}'
            )

    def forget(self) -> None:
        """Forget the messages of the last chunk: a new one begins."""
        self._entries.clear()

    def message_index(self, record: Any) -> Iterator[str]:
        """Compare the index of one channel with the chunk before it."""
        if sorted(record.records) != sorted(self._entries.get(record.channel_id, [])):
            yield f'the index of channel {record.channel_id} does not agree with its chunk'

    def chunk_index(self, record: Any) -> Iterator[str]:
        """Compare the summary's entry for one chunk with the chunk."""
        self._indexed += 1
        actual = self._chunks.get(record.chunk_start_offset)
        stated = record.chunk_length, record.message_start_time, record.message_end_time
        if actual != stated:
            yield f'the index has a chunk at byte {record.chunk_start_offset} unlike the file'

    def data_end(self, record: Any) -> Iterator[str]:
        """Compare the checksum over the data section, at its end."""
        if record.data_section_crc not in (0, self._crc):
            yield (
                f'the CRC of everything before is {self._crc:#010x}, not '
                f'{record.data_section_crc:#010x}'
            )

    def footer(self, record: Any) -> Iterator[str]:
        """Compare the number of chunks and the checksum over the summary, at the file's end."""
        if self._indexed not in (0, len(self._chunks)):
            yield f'the index has {self._indexed} chunks, the file {len(self._chunks)}'
        start = struct.pack(
            '<BQQQ', Opcode.FOOTER, 20, record.summary_start, record.summary_offset_start
        )
        crc = zlib.crc32(start, self._summary_crc)
        if record.summary_crc not in (0, crc):
            yield f'the CRC of the summary is {crc:#010x}, not {record.summary_crc:#010x}'
