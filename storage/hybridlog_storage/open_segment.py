"""Reads a segment while another process writes it.

Its chunks follow one another, each with its message indexes and arrival numbers behind it.
What a writer has not finished yet is left out: a chunk counts once its arrival numbers are
in the file.
"""

from __future__ import annotations

import struct
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema as SchemaRecord

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap_content import RECORD_HEAD, read_record
from hybridlog_storage.messages import Channel
from hybridlog_storage.segment_format import (
    ARRIVAL_OPCODE,
    MAGIC,
    PADDING_OPCODE,
    channel_of,
    message_times,
)
from hybridlog_storage.segment_reader import ChunkPlace, SegmentReader

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_SPAN: Final = struct.Struct("<QQ")  # first and last log time, at the beginning of a chunk
_INDEX: Final = struct.Struct("<HI")  # channel and size, at the beginning of a message index
_ENTRY: Final = 16  # bytes of a message in an index
_AROUND: Final = frozenset(
    {
        Opcode.HEADER,
        Opcode.METADATA,
        Opcode.METADATA_INDEX,
        Opcode.ATTACHMENT,
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        PADDING_OPCODE,
    }
)


class OpenSegment:
    """The chunks that a segment has at this moment.

    Args:
        path: The file; it may be sealed meanwhile.
        number: Its number in the recording.

    Attributes:
        number: Its number in the recording.
        reader: Reads its chunks.
        channels: Channels by id, as far as they are defined.
        messages: Number of messages in its chunks, by channel id.
        chunks: Its chunks, in file order. Their checksums are unknown, so `read_chunk`
            compares everything with the checked content.

    Raises:
        SegmentError: It cannot be opened, or is no segment.
    """

    def __init__(self, path: Path, number: int) -> None:
        self.number = number
        self.reader = SegmentReader(path, number)
        self.channels: dict[int, Channel] = {}
        self.messages: Counter[int] = Counter()
        self.chunks: list[ChunkPlace] = []
        self._schemas: dict[int, SchemaRecord] = {}
        self._chunk: tuple[int, int, int, int] | None = None  # start, length, first, last
        self._indexed: dict[int, int] = {}  # messages of the last chunk, by channel
        self._at = len(MAGIC)
        self.advance()

    def advance(self) -> None:
        """Find the chunks that were written since, also if the segment was sealed meanwhile.

        Raises:
            SegmentError: The file cannot be read.
        """
        self.reader.grow()
        size = self.reader.size
        while self._at + RECORD_HEAD.size <= size:
            opcode, length = RECORD_HEAD.unpack(self.reader.read(self._at, RECORD_HEAD.size))
            end = self._at + RECORD_HEAD.size + length
            if end > size or not self._take(opcode, self._at, length):
                return
            self._at = end

    def read_times(self, place: ChunkPlace) -> dict[int, NDArray[np.int64]]:
        """Log times of the messages of one of `chunks` by channel, without its messages.

        Message indexes have no checksum before the segment is sealed. They are compared with
        the head of the chunk; if they contradict it, the checked content is read instead.

        Returns:
            int64[n], ns, ascending, by channel id.

        Raises:
            SegmentError: The chunk is damaged.
        """
        with suppress(SegmentError):
            times = message_times(self.reader.read(place.offset + place.length, place.trailer))
            if _is_plausible(times, place):
                return times
        return self.reader.read_times(place)

    def _take(self, opcode: int, at: int, length: int) -> bool:
        """Take a record; False for one that no open segment has."""
        content = at + RECORD_HEAD.size
        if opcode == Opcode.CHUNK and length >= _SPAN.size:
            first, last = _SPAN.unpack(self.reader.read(content, _SPAN.size))
            self._chunk = at, RECORD_HEAD.size + length, first, last
            self._indexed = {}
        elif opcode == Opcode.MESSAGE_INDEX and length >= _INDEX.size:
            channel, size = _INDEX.unpack(self.reader.read(content, _INDEX.size))
            self._indexed[channel] = size // _ENTRY
        elif opcode == ARRIVAL_OPCODE and self._chunk is not None:
            start, size, first, last = self._chunk
            self._chunk = None
            self.messages.update(self._indexed)
            self.chunks.append(
                ChunkPlace(
                    number=len(self.chunks),
                    offset=start,
                    length=size,
                    trailer=content + length - start - size,
                    first=first,
                    last=last,
                    channels=tuple(self._indexed),
                )
            )
        elif opcode not in _AROUND:
            return False
        if opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
            self._define(opcode, self.reader.read(content, length))
        return True

    def _define(self, opcode: int, content: memoryview) -> None:
        record, _ = read_record(opcode, content)
        if isinstance(record, SchemaRecord):
            self._schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            self.channels[record.id] = channel_of(record, self._schemas)


def _is_plausible(times: dict[int, NDArray[np.int64]], place: ChunkPlace) -> bool:
    """True if log times are in order and have the span that the head of the chunk says."""
    columns = list(times.values())
    if not columns or not all(len(t) and bool((t[1:] >= t[:-1]).all()) for t in columns):
        return False
    first, last = min(int(t[0]) for t in columns), max(int(t[-1]) for t in columns)
    return (first, last) == (place.first, place.last)


def open_segment(path: Path, number: int) -> OpenSegment | None:
    """The chunks of an open segment; None if it was sealed or removed meanwhile.

    Args:
        path: The file.
        number: Its number in the recording.

    Raises:
        SegmentError: It cannot be read.
    """
    try:
        return OpenSegment(path, number)
    except SegmentError:
        if path.exists():
            raise
        return None
