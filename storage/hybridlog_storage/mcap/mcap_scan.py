"""Reads an MCAP file forward, also a damaged one.

`scan` yields the records of a file in order, with bounded memory. Behind damage it
continues at the next chunk of the summary, or else where plausible records follow one
another again. It reads foreign files and, for recovery and checks, the store's segments.
"""

from __future__ import annotations

import bisect
import struct
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO, NamedTuple, TypeAlias

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from mcap.summary import Summary

from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import (
    MIN_RECORDS,
    RECORD_HEAD,
    ChunkContent,
    Definition,
    Record,
    ScanDamage,
    TornChunk,
    parse_content,
    parse_parts,
    read_record,
)
from hybridlog_storage.messages import MAX_PAYLOAD
from hybridlog_storage.segments.attachments import MAX_HEAD, Attachment, parse_attachment
from hybridlog_storage.segments.compression import (
    MAX_UNCOMPRESSED,
    FilePart,
    check_size,
    decompress,
    decompress_pieces,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = [
    "MAGIC",
    "ChunkContent",
    "Definition",
    "End",
    "Item",
    "Loose",
    "PrivateRecord",
    "ScanDamage",
    "ScannedChunk",
    "TornChunk",
    "parse_content",
    "read_summary",
    "scan",
]

MAGIC = b"\x89MCAP0\r\n"
"""First and last eight bytes of an MCAP file."""

_HEAD = RECORD_HEAD.size
_FOOTER_SIZE = _HEAD + 20
_DATA_END_SIZE = _HEAD + 4
_CHUNK_FIELDS = struct.Struct("<QQQII")  # start, end, size, checksum, length of codec name
_CODECS = frozenset({"", "zstd", "lz4"})
_LAST_KNOWN = max(Opcode)
_FIRST_PRIVATE = 0x80
_DEFINITIONS = frozenset({Opcode.SCHEMA, Opcode.CHANNEL})
_WINDOW = 1 << 20
_MAX_PLAIN = 1 << 26  # largest record that is neither chunk, message nor attachment
_MAX_SUMMARY = 1 << 28
_ANOTHER = MAGIC + bytes([Opcode.HEADER])  # the beginning of another file
_MAX_WHOLE_BYTES = 64 << 20  # content of a chunk that is decompressed at once

_DATA_OPCODES = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
        Opcode.DATA_END,
    }
)
# Records between chunks. None of them occurs inside an uncompressed chunk, so a search
# for them cannot end inside one.
_CHUNKED_OPCODES = _DATA_OPCODES - {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_SUMMARY_OPCODES = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.STATISTICS,
        Opcode.SUMMARY_OFFSET,
    }
)
_LEAST = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.ATTACHMENT: 36,
    Opcode.METADATA: 8,
    Opcode.DATA_END: 4,
}


@dataclass(slots=True)
class ScannedChunk:
    """A compressed chunk record.

    Attributes:
        offset: Byte of the record in the file.
        length: Bytes of the whole record, its head included.
        compression: MCAP name of the codec.
        uncompressed_size: Bytes of the content, as stated by the chunk.
        uncompressed_crc: CRC-32 of the content, 0 for none.
        part: The compressed content, in the file.
        limit: Most bytes of content.
    """

    offset: int
    length: int
    compression: str
    uncompressed_size: int
    uncompressed_crc: int
    part: FilePart
    limit: int = MAX_UNCOMPRESSED

    def contents(self) -> Iterator[ChunkContent]:
        """The records in parts of bounded size, after comparing the checksum.

        Raises:
            SegmentError: The rest does not decompress, or is not believed.
        """
        if max(self.uncompressed_size, len(self.part)) <= _MAX_WHOLE_BYTES:
            yield parse_content(self.content_bytes(), most=MIN_RECORDS + len(self.part))
            return
        if self.uncompressed_size > self.limit:
            raise SegmentError(
                f"it claims {self.uncompressed_size} bytes uncompressed, more than the limit "
                f"of {self.limit}"
            )
        if self.compression:
            check_size(self.compression, self.uncompressed_size, len(self.part))
        if self.uncompressed_crc:
            crc = 0
            for piece in decompress_pieces(self.compression, self.part):
                crc = crc32(piece, crc)
            if crc != self.uncompressed_crc:
                raise SegmentError("its checksum differs")
        yield from parse_parts(self.compression, self.part, self.uncompressed_size)

    def content_bytes(self, *, check_crc: bool = True) -> bytes | memoryview:
        """The uncompressed content, for `parse_content`.

        Args:
            check_crc: Compare the checksum, if the chunk has one.

        Raises:
            SegmentError: It does not decompress, or its checksum differs.
        """
        data = self.part.again().read()
        content = decompress(self.compression, data, self.uncompressed_size, limit=self.limit)
        if check_crc and self.uncompressed_crc not in {0, crc32(content)}:
            raise SegmentError("its checksum differs")
        return content


@dataclass(slots=True)
class PrivateRecord:
    """A record of the application range, opcode 0x80 and above.

    Attributes:
        opcode: Its opcode.
        offset: Byte of the record in the file.
        data: Its content, without the head.
    """

    opcode: int
    offset: int
    data: memoryview


@dataclass(slots=True)
class Loose:
    """Consecutive messages outside of chunks, in a file without them with the definitions between.

    Attributes:
        content: The messages; payload offsets are into a buffer of their own.
        offset: Byte of their first record in the file.
    """

    content: ChunkContent
    offset: int


class End(NamedTuple):
    """The end of the scan.

    Attributes:
        offset: Size of the file.
        clean: Whether the file was closed: it has a footer and the closing magic.
    """

    offset: int
    clean: bool


Item: TypeAlias = Record | Attachment | ScannedChunk | PrivateRecord | Loose | ScanDamage | End
"""An item of `scan`."""


def scan(
    file: BinaryIO,
    *,
    size: int,
    start: int = len(MAGIC),
    limit: int = MAX_UNCOMPRESSED,
    summary: Summary | None = None,
) -> Iterator[tuple[int, Item]]:
    """Read a file forward, record by record.

    Memory is bounded by the largest record up to `limit`; a length field never allocates
    more than the file holds. Records of reserved kinds are skipped.

    Args:
        file: Seekable; its position is moved.
        size: Bytes of the file.
        start: Byte of the first record.
        limit: Largest chunk, compressed or not, in bytes; larger ones, and messages above
            `MAX_PAYLOAD`, count as damage and are skipped.
        summary: From `read_summary`, which is called if this is None. It gives the
            position of the next chunk behind damage.

    Yields:
        Byte in the file and the item that starts there, in file order. The last item is an
        `End`.

    Raises:
        OSError: The file cannot be read.
    """
    if summary is None:
        summary = read_summary(file, size)
    return _Scanner(file, size, start, limit, summary).items()


def read_summary(file: BinaryIO, size: int) -> Summary | None:
    """The summary at the end of a closed file.

    Returns:
        None if it is missing or damaged.

    Raises:
        OSError: The file cannot be read.
    """
    footer = _read_footer(file, size)
    end = size - len(MAGIC) - _FOOTER_SIZE
    if footer is None or not len(MAGIC) <= footer.summary_start <= end:
        return None
    if end - footer.summary_start > _MAX_SUMMARY:
        return None
    file.seek(footer.summary_start)
    data = file.read(end - footer.summary_start + _FOOTER_SIZE - 4)
    if footer.summary_crc not in {0, crc32(data)}:
        return None
    view = memoryview(data)[: end - footer.summary_start]
    summary = Summary()
    at = 0
    try:
        while at < len(view):
            opcode, length = RECORD_HEAD.unpack_from(view, at)
            if length > len(view) - at - _HEAD or not _is_in_summary(opcode):
                return None
            record, _ = read_record(opcode, view[at + _HEAD : at + _HEAD + length])
            _add_to_summary(summary, record)
            at += _HEAD + length
    except (SegmentError, struct.error):
        return None
    return summary


def _read_footer(file: BinaryIO, size: int) -> records.Footer | None:
    tail_size = _FOOTER_SIZE + len(MAGIC)
    if size < tail_size + len(MAGIC):
        return None
    file.seek(size - tail_size)
    tail = file.read(tail_size)
    if len(tail) < tail_size or tail[_FOOTER_SIZE:] != MAGIC:
        return None
    if RECORD_HEAD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER_SIZE - _HEAD):
        return None
    return records.Footer(*struct.unpack_from("<QQI", tail, _HEAD))


def _is_in_summary(opcode: int) -> bool:
    return opcode in _SUMMARY_OPCODES or opcode > _LAST_KNOWN


def _add_to_summary(summary: Summary, record: Record | None) -> None:
    if isinstance(record, records.Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, records.Channel):
        summary.channels[record.id] = record
    elif isinstance(record, records.ChunkIndex):
        summary.chunk_indexes.append(record)
    elif isinstance(record, records.AttachmentIndex):
        summary.attachment_indexes.append(record)
    elif isinstance(record, records.MetadataIndex):
        summary.metadata_indexes.append(record)
    elif isinstance(record, records.Statistics):
        summary.statistics = record


class _Window:
    """A part of the file in memory, moved forward on demand."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self.size = size
        self.file = file
        self._start = 0
        self._data = memoryview(b"")

    def at(self, offset: int, length: int) -> memoryview:
        """Bytes from `offset` on; fewer than `length` at the end of the file."""
        length = min(length, self.size - offset)
        begin = offset - self._start
        if begin < 0 or begin + length > len(self._data):
            self.file.seek(offset)
            wanted = min(max(length, _WINDOW), self.size - offset)
            self._data = memoryview(self.file.read(wanted))
            self._start, begin = offset, 0
            if len(self._data) < wanted:  # the file was truncated meanwhile
                self.size = offset + len(self._data)
        return self._data[begin : begin + length]

    def rest(self, offset: int) -> memoryview:
        """Bytes in memory from `offset` on; at least a record's head, if it exists."""
        self.at(offset, _HEAD)
        return self._data[offset - self._start :]

    def part(self, offset: int, length: int) -> FilePart:
        """A part that is read later, piece by piece; in memory if it is small."""
        if length > _WINDOW:
            return FilePart(self.file, offset, length)
        data = self.at(offset, length)
        return FilePart(BytesIO(data), 0, len(data))

    def peek(self, offset: int, length: int) -> bytes:
        """A few bytes at any position, fewer at the end, without moving the window."""
        if not 0 <= offset < self.size:
            return b""
        begin = offset - self._start
        if begin >= 0 and begin + length <= len(self._data):
            return bytes(self._data[begin : begin + length])
        self.file.seek(offset)
        return self.file.read(min(length, self.size - offset))


class _ChunkHead(NamedTuple):
    """Fields of a chunk record; `data` and `end` are bytes in the file."""

    start: int
    last: int
    size: int
    crc: int
    compression: str
    data: int
    end: int


def _chunk_head(window: _Window, offset: int) -> _ChunkHead | None:
    """The fields before a chunk's data, None if they are implausible."""
    raw = window.peek(offset + _HEAD, _CHUNK_FIELDS.size + 4 + 8)
    if len(raw) < _CHUNK_FIELDS.size + 8:
        return None
    first, last, size, crc, name_length = _CHUNK_FIELDS.unpack_from(raw)
    at = _CHUNK_FIELDS.size + name_length
    if name_length > 4 or at + 8 > len(raw):
        return None
    name = raw[_CHUNK_FIELDS.size : at].decode("ascii", "replace")
    if name not in _CODECS:
        return None
    (length,) = struct.unpack_from("<Q", raw, at)
    data = offset + _HEAD + at + 8
    return _ChunkHead(first, last, size, crc, name, data, data + length)


class _Places:
    """Positions of chunks by the summary, and whether they are reliable.

    A wrong summary must not spoil an intact file. So at the first contradiction its entries
    are checked: the summary counts if at least half of them point at chunk records of the
    stated length.
    """

    def __init__(self, window: _Window, summary: Summary | None) -> None:
        indexes = summary.chunk_indexes if summary is not None else []
        self._lengths = {index.chunk_start_offset: index.chunk_length for index in indexes}
        self._starts = sorted(self._lengths)
        self._window = window
        self._believed: bool | None = None

    def length(self, offset: int) -> int | None:
        """Length of the chunk record at `offset`, None without one."""
        return self._lengths.get(offset)

    def next(self, offset: int) -> int | None:
        """Start of the first chunk behind `offset`."""
        i = bisect.bisect_right(self._starts, offset)
        return self._starts[i] if i < len(self._starts) else None

    def denies(self, offset: int) -> bool:
        """True if the summary rules out a chunk at `offset`."""
        return bool(self._starts) and offset not in self._lengths and self.believed()

    def believed(self) -> bool:
        """True if enough entries are correct."""
        if self._believed is None:
            right = sum(self._is_right(offset) for offset in self._starts)
            self._believed = self._single() if right == 0 else right * 2 >= len(self._starts)
        return self._believed

    def _is_right(self, offset: int) -> bool:
        head = self._window.peek(offset, _HEAD)
        if len(head) < _HEAD:
            return False
        return RECORD_HEAD.unpack(head) == (Opcode.CHUNK, self._lengths[offset] - _HEAD)

    def _single(self) -> bool:
        """Check the only chunk of a file by its own fields: it has no others to agree with."""
        if len(self._starts) != 1:
            return False
        (offset,) = self._starts
        fields = _chunk_head(self._window, offset)
        return fields is not None and fields.end == offset + self._lengths[offset]


def _is_other_record(content: memoryview) -> bool:
    """True if the content of a message record is exactly that of another kind.

    In files with chunks, messages outside of them are rare. But one wrong byte can turn
    any record between two chunks into a message, and no checksum covers those.
    """
    for opcode in (Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.ATTACHMENT):
        try:
            record, used = read_record(opcode, content)
        except SegmentError:
            continue
        if used == len(content):
            entries = record.records if isinstance(record, records.MessageIndex) else []
            return all(offset < MAX_UNCOMPRESSED for _, offset in entries)
    return False


class _Scanner:
    """The state of one scan."""

    def __init__(
        self, file: BinaryIO, size: int, start: int, limit: int, summary: Summary | None
    ) -> None:
        self._window = _Window(file, size)
        self._limit = limit
        self._at = start
        self._places = _Places(self._window, summary)
        self._footer = _read_footer(file, size)
        # End of the fields of the last record. If the length of that record was wrong, the
        # search for the next one starts here, not where the length points.
        self._behind = start
        self._summary_start = self._footer.summary_start if self._footer and summary else None
        self._chunked = bool(summary and summary.chunk_indexes)
        self._in_data = True
        self._crc: int | None = None
        if start == len(MAGIC) and self._data_crc() not in {None, 0}:
            self._crc = crc32(MAGIC)

    def _data_crc(self) -> int | None:
        """The checksum of the data section, if the file has one."""
        footer = self._footer
        if footer is None:
            return None
        end = footer.summary_start or self._window.size - len(MAGIC) - _FOOTER_SIZE
        raw = self._window.peek(max(end - _DATA_END_SIZE, 0), _DATA_END_SIZE)
        if len(raw) < _DATA_END_SIZE or RECORD_HEAD.unpack_from(raw) != (Opcode.DATA_END, 4):
            return None
        return int.from_bytes(raw[_HEAD:], "little")

    def items(self) -> Iterator[tuple[int, Item]]:
        """All items from the start to the end of the file."""
        footer = False
        while self._at < self._window.size:
            if footer and self._window.at(self._at, len(MAGIC)) == MAGIC:
                if self._window.peek(self._at + len(MAGIC), len(_ANOTHER)) != _ANOTHER:
                    break
                self._begin_another(self._at + len(MAGIC))
            before = self._at
            for offset, item in self._step():
                footer = isinstance(item, records.Footer)
                yield offset, item
            self._add_crc(before)
        clean = footer and self._at + len(MAGIC) == self._window.size
        if not clean and self._at < self._window.size:
            rest = self._window.size - self._at
            yield self._at, ScanDamage(self._at, rest, "bytes follow the end of the log", 0)
        yield self._window.size, End(self._window.size, clean)

    def _begin_another(self, at: int) -> None:
        """Go on with another file whose bytes follow those of this one.

        Its summary counts from its own beginning, so positions are not known from it.
        """
        self._at = self._behind = at + len(MAGIC)
        self._places = _Places(self._window, None)
        self._summary_start = self._crc = None
        self._chunked = False
        self._in_data = True

    def _step(self) -> Iterator[tuple[int, Item]]:
        """Read one record, one run of messages, or one place of damage."""
        at = self._at
        head = self._window.peek(at, _HEAD)
        if len(head) < _HEAD:
            yield from self._torn(at, "the file ends in the middle of a record")
            return
        if head == _ANOTHER:
            reason = "another log begins before the end of this one"
            yield at, ScanDamage(at, 0, reason, 0)
            self._begin_another(at)
            return
        opcode, length = RECORD_HEAD.unpack(head)
        if opcode in _DEFINITIONS and self._in_data:
            yield from self._definitions(at)
            if self._at > at:
                return
        if self._in_data and self._summary_start is not None and at >= self._summary_start:
            self._in_data = False
            yield at, ScanDamage(at, 0, "the record that ends the data is damaged", 0)
        if self._contradicts_index(at, opcode, length):
            indexed = self._places.length(at)
            reason = "the head of a chunk is damaged; the chunk is read by the summary"
            yield at, ScanDamage(at, _HEAD, reason, 0)
            self._crc = None
            yield from self._chunk(at, at + (indexed or 0))
        elif self._hides_chunk(at, opcode, length):
            yield at, ScanDamage(at, _HEAD, f"a chunk record is marked as of kind {opcode}", 0)
            self._crc = None
            yield from self._chunk(at, at + _HEAD + length)
        elif not self._in_data:
            yield from self._summary_record(at, opcode, length)
        elif opcode == Opcode.CHUNK:
            yield from self._chunk_or_damage(at, length)
        elif opcode == Opcode.MESSAGE:
            yield from self._loose(at, length)
        else:
            yield from self._plain(at, opcode, length)

    def _contradicts_index(self, at: int, opcode: int, length: int) -> bool:
        """True if the summary lists a chunk here, but the record's head is not that of a chunk."""
        indexed = self._places.length(at) if self._in_data else None
        if indexed is None or (opcode, length + _HEAD) == (Opcode.CHUNK, indexed):
            return False
        return _HEAD < indexed <= self._window.size - at and self._places.believed()

    def _hides_chunk(self, at: int, opcode: int, length: int) -> bool:
        """True if only a wrong opcode keeps a record from being a chunk.

        Message indexes are not checked, since they are too many; private records have any
        content.
        """
        if not self._in_data or opcode in {Opcode.CHUNK, Opcode.MESSAGE_INDEX}:
            return False
        if opcode >= _FIRST_PRIVATE or length < _LEAST[Opcode.CHUNK]:
            return False
        fields = _chunk_head(self._window, at)
        return fields is not None and fields.end == at + _HEAD + length <= self._window.size

    # Chunks

    def _chunk_or_damage(self, at: int, length: int) -> Iterator[tuple[int, Item]]:
        end = at + _HEAD + length
        fields = _chunk_head(self._window, at)
        fits = end <= self._window.size and not self._swallows(at, end)
        if (
            fields is not None
            and fits
            and fields.end <= end
            and (fields.end == end or self._goes_on(end) or not self._goes_on(fields.end))
        ):
            yield from self._chunk(at, end)
        elif fields is not None and fields.end <= self._window.size and self._goes_on(fields.end):
            yield at, ScanDamage(at, _HEAD, "the length of a chunk record is wrong", 0)
            self._crc = None
            yield from self._chunk(at, fields.end)
        elif fields is not None and fields.end == end > self._window.size:
            data = self._window.part(fields.data, self._window.size - fields.data)
            torn = TornChunk(fields.compression, fields.size, data)
            yield from self._torn(at, "the file ends in the middle of a chunk", torn)
        elif fits and self._goes_on(end):
            yield from self._chunk(at, end)
        else:
            yield from self._lost(at, f"a chunk record claims {length} bytes", Opcode.CHUNK)

    def _chunk(self, at: int, end: int) -> Iterator[tuple[int, Item]]:
        """The chunk in `[at, end)`; its own fields may still be wrong."""
        self._chunked = True
        self._at = self._behind = end
        fields = _chunk_head(self._window, at)
        if fields is None or fields.data > end:
            reason = "the fields of a chunk are damaged"
            # Too short, or unknown to the summary: the opcode is wrong.
            real = end - at >= _HEAD + _LEAST[Opcode.CHUNK] and not self._places.denies(at)
            yield at, ScanDamage(at, end - at, reason, opcode=Opcode.CHUNK if real else None)
        elif end - at > self._limit:
            yield at, self._too_large(at, end, Opcode.CHUNK)
        else:
            data_end = min(fields.end, end)
            data = self._window.part(fields.data, data_end - fields.data)
            self._behind = data_end
            yield (
                at,
                ScannedChunk(
                    at,
                    end - at,
                    fields.compression,
                    fields.size,
                    fields.crc,
                    data,
                    self._limit,
                ),
            )

    # Messages outside chunks

    def _loose(self, at: int, length: int) -> Iterator[tuple[int, Item]]:
        end = at + _HEAD + length
        if end > self._window.size or length < _LEAST[Opcode.MESSAGE] or self._swallows(at, end):
            yield from self._lost(at, f"a message record claims {length} bytes")
            return
        if length > MAX_PAYLOAD:
            self._at = self._behind = end
            yield at, self._too_large(at, end, Opcode.MESSAGE)
            return
        content = self._window.at(at, end - at)[_HEAD:]
        if self._chunked and _is_other_record(content):
            self._at = self._behind = end
            self._crc = None
            yield at, ScanDamage(at, end - at, "a record is marked as a message but is none", 0)
            return
        until = self._places.next(at) if self._places.believed() else None
        run = self._window.rest(at)[: None if until is None else until - at]
        found = parse_content(run, loose=not self._chunked, messages_only=self._chunked)
        if found.damage:
            found = parse_content(run, messages_only=True)
        self._at = self._behind = at + found.end
        yield at, Loose(found, at)

    # Everything else

    def _definitions(self, at: int) -> Iterator[tuple[int, Item]]:
        """Schemas and channels that fill their records exactly, up to the next chunk."""
        run = self._window.rest(at)
        stops = (len(run), (self._summary_start or self._window.size) - at)
        known = self._places.next(at - 1)
        stop = min(*stops, len(run) if known is None else known - at)
        start = 0
        while start + _HEAD <= stop:
            opcode, length = RECORD_HEAD.unpack_from(run, start)
            end = start + _HEAD + length
            if opcode not in _DEFINITIONS or end > stop:
                return
            try:
                record, used = read_record(opcode, run[start + _HEAD : end])
            except SegmentError:
                return
            if used != length or record is None:
                return
            self._at = self._behind = at + end
            yield at + start, record
            start = end

    def _plain(self, at: int, opcode: int, length: int) -> Iterator[tuple[int, Item]]:
        end = at + _HEAD + length
        if not self._is_plausible(opcode, end) or self._swallows(at, end):
            reason = f"a record of kind {opcode} claims {length} bytes"
            yield from self._lost(at, "no record starts here" if opcode == 0 else reason)
            return
        self._at = end
        known = opcode <= _LAST_KNOWN
        if opcode == Opcode.ATTACHMENT:
            yield from self._attachment(at, end)
            return
        if length > _MAX_PLAIN:
            if known:
                yield at, self._too_large(at, end, opcode)
            return
        if opcode >= _FIRST_PRIVATE:
            content = self._window.at(at + _HEAD, length)
            yield at, PrivateRecord(opcode, at, content)
        elif known:
            yield from self._known(at, opcode, end)

    def _attachment(self, at: int, end: int) -> Iterator[tuple[int, Item]]:
        start = at + _HEAD
        part = FilePart(self._window.file, start, end - start)
        try:
            found, used = parse_attachment(self._window.at(start, min(end - start, MAX_HEAD)), part)
        except SegmentError as error:
            yield at, ScanDamage(at, end - at, str(error), 0)
            return
        self._behind = start + used
        yield at, found

    def _known(self, at: int, opcode: int, end: int) -> Iterator[tuple[int, Item]]:
        try:
            record, used = read_record(opcode, self._window.at(at + _HEAD, end - at - _HEAD))
        except SegmentError as error:
            yield at, ScanDamage(at, end - at, str(error), 0)
            return
        self._behind = at + _HEAD + used
        if isinstance(record, records.DataEnd):
            yield from self._data_end(at, end, record)
        elif record is not None:
            self._in_data = self._in_data and not isinstance(record, records.Footer)
            yield at, record

    def _data_end(self, at: int, end: int, record: records.DataEnd) -> Iterator[tuple[int, Item]]:
        if not self._ends_data(end):
            yield at, ScanDamage(at, end - at, "an end of data stands in the middle of the data")
            self._crc = None
            return
        self._in_data = False
        if self._crc is not None and record.data_section_crc not in {0, self._crc}:
            reason = "the checksum of all data differs: some bytes before this one have changed"
            yield at, ScanDamage(0, at, reason, opcode=Opcode.DATA_END)
        self._crc = None
        yield at, record

    def _ends_data(self, end: int) -> bool:
        """True if the summary, or the end of the file, follows."""
        if self._summary_start is not None:
            return end == self._summary_start
        raw = self._window.peek(end, _HEAD)
        if len(raw) < _HEAD:
            return True
        opcode, length = RECORD_HEAD.unpack(raw)
        known = opcode == Opcode.FOOTER or _is_in_summary(opcode)
        return known and length <= self._window.size - end - _HEAD

    def _summary_record(self, at: int, opcode: int, length: int) -> Iterator[tuple[int, Item]]:
        end = at + _HEAD + length
        wrong = opcode != Opcode.FOOTER and not _is_in_summary(opcode)
        if wrong or end > self._window.size or length > _MAX_PLAIN:
            # The data has already given everything that the summary holds.
            yield at, ScanDamage(at, self._window.size - at, "the summary is damaged", 0)
            self._at = self._window.size
            return
        self._at = end
        yield from self._known(at, opcode, end)

    # Damage

    def _too_large(self, at: int, end: int, opcode: int) -> ScanDamage:
        messages = None if opcode == Opcode.CHUNK else int(opcode == Opcode.MESSAGE)
        limits: dict[int, int] = {Opcode.CHUNK: self._limit, Opcode.MESSAGE: MAX_PAYLOAD}
        limit = limits.get(opcode, _MAX_PLAIN)
        reason = f"a record of {end - at} bytes is above the limit of {limit}"
        return ScanDamage(at, end - at, reason, messages, opcode=opcode)

    def _torn(
        self, at: int, reason: str, torn: TornChunk | None = None
    ) -> Iterator[tuple[int, Item]]:
        self._at = self._window.size
        messages = None if self._in_data else 0
        yield at, ScanDamage(at, self._window.size - at, reason, messages, torn)

    def _lost(self, at: int, reason: str, opcode: int | None = None) -> Iterator[tuple[int, Item]]:
        """Skip to the next plausible records."""
        self._crc = None
        found = self._resume(at)
        if found is None:
            end = self._end_of_data()
            if end is None:
                yield from self._torn(at, f"the file ends in the middle of a record: {reason}")
                return
            found = end
        where = min(at, self._behind, found)
        self._at = self._behind = found
        reason += f"; reading goes on at byte {found}"
        yield where, ScanDamage(where, found - where, reason, opcode=opcode)

    def _resume(self, at: int) -> int | None:
        known = self._places.next(at)
        if known is not None and self._places.believed():
            return known
        end = self._end_of_data()
        stop = self._window.size if end is None else end
        return self._search(self._behind if self._behind < at else at + 1, stop)

    def _end_of_data(self) -> int | None:
        """Position of the DataEnd record, if the file has a footer."""
        if self._footer is None:
            return None
        size = self._window.size
        end = self._footer.summary_start or size - len(MAGIC) - _FOOTER_SIZE
        at = end - _DATA_END_SIZE
        raw = self._window.peek(max(at, 0), _HEAD)
        if len(raw) < _HEAD or RECORD_HEAD.unpack(raw) != (Opcode.DATA_END, 4) or at <= self._at:
            return None
        return at

    def _search(self, start: int, stop: int) -> int | None:
        """The first byte in `[start, stop)` at which a chain of records starts."""
        wanted = np.zeros(256, np.bool_)
        wanted[list(_CHUNKED_OPCODES if self._chunked else _DATA_OPCODES)] = True
        least = np.zeros(256, np.int64)
        least[list(_LEAST)] = list(_LEAST.values())
        for block in range(start, stop, _WINDOW):
            raw = self._window.peek(block, min(_WINDOW, stop - block) + _HEAD - 1)
            if len(raw) < _HEAD:
                return None
            data = np.frombuffer(raw, np.uint8)
            opcodes = data[: 1 - _HEAD]
            # No length reaches 2^40, so a test for three zero bytes excludes nearly all positions.
            sieve = wanted[opcodes] & (data[6:-2] == 0) & (data[7:-1] == 0) & (data[8:] == 0)
            places = np.flatnonzero(sieve)
            lengths = np.ndarray((len(opcodes),), "<u8", raw, 1, (1,))[places].astype(np.int64)
            fit = (lengths >= least[opcodes[places]]) & (
                places + lengths <= self._window.size - block - _HEAD
            )
            for place in places[fit].tolist():
                if self._is_chain(block + place):
                    return block + int(place)
        return None

    def _is_chain(self, at: int) -> bool:
        """True if a chain of records starts here, up to an end or long enough."""
        weight = 0
        while weight < 3:
            if at == self._window.size:
                return weight > 0
            found = self._weight(at)
            if found is None:
                return False
            weight += found[0]
            at = found[1]
        return True

    def _weight(self, at: int) -> tuple[int, int] | None:
        """A plausibility score of a record at `at`, and its end."""
        raw = self._window.peek(at, _HEAD + 6)
        if len(raw) < _HEAD:
            return None
        opcode, length = RECORD_HEAD.unpack_from(raw)
        end = at + _HEAD + length
        weight = 1 if opcode >= _FIRST_PRIVATE or length >= _LEAST.get(opcode, 1 << 64) else 0
        if opcode == Opcode.CHUNK and weight:
            # The only record that may run over the end of the file, since it is recognizable.
            fields = _chunk_head(self._window, at)
            if fields is None or fields.end > end:
                return None
            return (3 if fields.end == end else 1), end
        if end > self._window.size:
            return None
        if opcode == Opcode.MESSAGE_INDEX and weight:
            (entries,) = struct.unpack_from("<I", raw, _HEAD + 2)
            weight = 0 if entries + 6 > length or entries % 16 else 2
        elif opcode == Opcode.DATA_END and length == 4:
            weight = 3
        return (weight, end) if weight else None

    def _is_plausible(self, opcode: int, end: int) -> bool:
        if opcode == 0 or end > self._window.size:
            return False
        if opcode == Opcode.FOOTER:
            return end + len(MAGIC) >= self._window.size
        if opcode <= _LAST_KNOWN:
            return opcode in _DATA_OPCODES or opcode == Opcode.HEADER
        return opcode >= _FIRST_PRIVATE or self._goes_on(end)

    def _goes_on(self, at: int) -> bool:
        """True if `at` is the start of a record or the end of the file."""
        return at == self._window.size or self._weight(at) is not None

    def _swallows(self, at: int, end: int) -> bool:
        """True if a record would overlap the start of a chunk or of the summary."""
        if self._summary_start is not None and at < self._summary_start < end:
            return True
        known = self._places.next(at)
        return known is not None and known < end and self._places.believed()

    def _add_crc(self, before: int) -> None:
        if self._crc is None:
            return
        at = before
        while at < self._at:
            piece = self._window.at(at, min(self._at - at, _WINDOW))
            if not len(piece):
                break
            self._crc = crc32(piece, self._crc)
            at += len(piece)
