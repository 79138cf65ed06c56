"""Reads an MCAP file forward, also a damaged one.

`scan` yields the records of a file in order, with bounded memory. Behind damage it
continues at the next chunk of the summary, or else where plausible records follow one
another again.
"""

from __future__ import annotations

import bisect
import struct
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO, NamedTuple, TypeAlias

import numpy as np
from mcap import records
from mcap.opcode import Opcode

from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import (
    MIN_RECORDS,
    RECORD_HEAD,
    ChunkContent,
    Record,
    ScanDamage,
    TornChunk,
    is_in_summary,
    parse_content,
    parse_parts,
    parse_summary,
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

    from mcap.summary import Summary

MAGIC = b"\x89MCAP0\r\n"
"""First and last eight bytes of an MCAP file."""

_HEAD = RECORD_HEAD.size
_FOOTER_SIZE = _HEAD + 20
_DATA_END = RECORD_HEAD.pack(Opcode.DATA_END, 4)
_DATA_END_SIZE = _HEAD + 4
_CHUNK_FIELDS = struct.Struct("<QQQII")  # start, end, size, checksum, length of codec name
_CODECS = frozenset({"", "zstd", "lz4"})
_LAST_KNOWN = max(Opcode)
_FIRST_PRIVATE = 0x80
_WINDOW = 1 << 20
_MAX_PLAIN = 1 << 26  # largest record that is neither chunk, message nor attachment
_MAX_SUMMARY = 1 << 28
_ANOTHER = MAGIC + bytes([Opcode.HEADER])  # the beginning of another file
_MAX_WHOLE_BYTES = 64 << 20  # content of a chunk that is decompressed at once

# Records of the data, but for chunks.
_PLAIN = frozenset(
    {
        Opcode.HEADER,
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
        Opcode.DATA_END,
    }
)
_BETWEEN_CHUNKS = frozenset(
    {Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END}
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

    def content_bytes(self) -> bytes | memoryview:
        """The uncompressed content, for `parse_content`.

        Raises:
            SegmentError: It does not decompress, or its checksum differs.
        """
        data = self.part.again().read()
        content = decompress(self.compression, data, self.uncompressed_size, limit=self.limit)
        if self.uncompressed_crc not in {0, crc32(content)}:
            raise SegmentError("its checksum differs")
        return content


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


Item: TypeAlias = Record | Attachment | ScannedChunk | Loose | ScanDamage | End
"""An item of `scan`."""


def scan(
    file: BinaryIO,
    *,
    size: int,
    limit: int = MAX_UNCOMPRESSED,
    summary: Summary | None = None,
) -> Iterator[tuple[int, Item]]:
    """Read a file forward, record by record.

    Memory is bounded by the largest record up to `limit`; a length field never allocates
    more than the file holds. Records of reserved kinds are skipped.

    Args:
        file: Seekable; its position is moved.
        size: Bytes of the file.
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
    return _Scanner(file, size, limit, summary).items()


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
    try:
        return parse_summary(memoryview(data)[: end - footer.summary_start])[0]
    except SegmentError:
        return None


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
    """Chunks by the summary.

    A wrong summary must not spoil an intact file. So at the first contradiction its entries are
    looked at: they count if at least half of them point at chunk records of the stated length.
    """

    def __init__(self, window: _Window, summary: Summary | None) -> None:
        indexes = summary.chunk_indexes if summary is not None else []
        self._ends = {
            one.chunk_start_offset: one.chunk_start_offset + one.chunk_length for one in indexes
        }
        self._starts = sorted(self._ends)
        self._window = window
        self._is_checked = False

    def end(self, offset: int) -> int | None:
        """End of the chunk record at `offset`, None without one."""
        return self._ends.get(offset)

    def next(self, offset: int) -> int | None:
        """Start of the first chunk behind `offset`."""
        i = bisect.bisect_right(self._starts, offset)
        return self._starts[i] if i < len(self._starts) else None

    def count(self) -> bool:
        """True if there are any to go by; those that are wrong are forgotten."""
        if not self._is_checked:
            self._is_checked = True
            if 2 * sum(map(self._is_right, self._starts)) < len(self._starts):
                self._ends, self._starts = {}, []
        return bool(self._starts)

    def _is_right(self, offset: int) -> bool:
        end = self._ends[offset]
        head = self._window.peek(offset, _HEAD)
        if head == RECORD_HEAD.pack(Opcode.CHUNK, max(end - offset - _HEAD, 0)):
            return True
        fields = _chunk_head(self._window, offset)
        return fields is not None and fields.end == end


def _is_other_record(content: memoryview) -> bool:
    """True if the content of a message record is exactly that of another kind.

    In files with chunks, messages outside of them are rare. But one wrong byte can turn
    any record between two chunks into a message, and no checksum covers those.
    """
    with suppress(SegmentError):
        if parse_attachment(content, FilePart(BytesIO(content), 0, len(content)))[1] == len(
            content
        ):
            return True
    for opcode in (Opcode.MESSAGE_INDEX, Opcode.METADATA):
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

    def __init__(self, file: BinaryIO, size: int, limit: int, summary: Summary | None) -> None:
        self._window = _Window(file, size)
        self._limit = limit
        self._at = len(MAGIC)
        self._is_first = True  # of logs whose bytes follow one another
        # End of the fields of the last record. If the length of that record was wrong, the
        # search for the next one starts here, not where the length points.
        self._behind = self._at
        self._places = _Places(self._window, summary)
        self._chunked = bool(summary and summary.chunk_indexes)
        self._stop = self._end_by_footer(summary)
        self._is_ended = False
        self._needs_crc = False  # messages have no checksum of their own

    def _end_by_footer(self, summary: Summary | None) -> int | None:
        """Byte where the data ends, if the file says so."""
        footer = _read_footer(self._window.file, self._window.size)
        if footer is None:
            return None
        end = footer.summary_start or self._window.size - len(MAGIC) - _FOOTER_SIZE
        at = max(end - _DATA_END_SIZE, 0)
        if self._window.peek(at, _HEAD) == _DATA_END:
            return at
        return end if summary is not None else None

    @property
    def _end(self) -> int:
        """End of the data, or of the file."""
        return self._window.size if self._stop is None else self._stop

    def items(self) -> Iterator[tuple[int, Item]]:
        """All items from the start to the end of the file."""
        size, is_clean = self._window.size, False
        while self._at < size:
            yield from self._step()
            size = self._window.size  # the file may be cut meanwhile
            if not self._is_ended:
                continue
            is_clean = self._pass_summary()
            if is_clean and self._window.peek(self._at, len(_ANOTHER)) == _ANOTHER:
                self._begin_another()
            elif self._at < size:
                reason = "bytes follow the end of the log" if is_clean else "the summary is damaged"
                yield self._at, ScanDamage(self._at, size - self._at, reason, 0)
                is_clean = False
                break
        yield size, End(size, is_clean)

    def _pass_summary(self) -> bool:
        """Go behind the footer; False if the summary is damaged, or the end is missing."""
        while True:
            head = self._window.at(self._at, _HEAD)
            if len(head) < _HEAD:
                return False
            opcode, length = RECORD_HEAD.unpack(head)
            end = self._at + _HEAD + length
            if opcode == Opcode.FOOTER and self._window.peek(end, len(MAGIC)) == MAGIC:
                self._at = end + len(MAGIC)
                return True
            if not is_in_summary(opcode) or end > self._window.size:
                return False
            self._at = end

    def _begin_another(self) -> None:
        """Go on with another log whose bytes follow those of this one.

        Its summary counts from its own beginning, so positions are not known from it.
        """
        self._at = self._behind = self._at + len(MAGIC)
        self._places = _Places(self._window, None)
        self._stop, self._is_first = None, False
        self._chunked = self._is_ended = False

    def _step(self) -> Iterator[tuple[int, Item]]:
        """Read one record, one run of messages, or one place of damage."""
        at = self._at
        head = self._window.peek(at, _HEAD)
        if at == self._stop:
            yield from self._finish(at, head)
        elif len(head) < _HEAD:
            yield self._torn(at, "the file ends in the middle of a record")
        elif head == _ANOTHER:
            yield at, ScanDamage(at, 0, "another log begins before the end of this one", 0)
            self._begin_another()
        else:
            opcode, length = RECORD_HEAD.unpack(head)
            yield from self._record(at, opcode, at + _HEAD + length)

    def _record(self, at: int, opcode: int, end: int) -> Iterator[tuple[int, Item]]:
        listed = self._places.end(at)
        fields = _chunk_head(self._window, at)
        is_chunk = (opcode, end) == (Opcode.CHUNK, listed)
        if listed is not None and not is_chunk and listed <= self._end and self._places.count():
            reason = "the head of a chunk is damaged; the chunk is read by the summary"
            yield at, ScanDamage(at, _HEAD, reason, 0)
            yield self._chunk(at, listed)
        elif opcode == Opcode.CHUNK:
            yield from self._chunk_or_damage(at, end, fields)
        elif fields is not None and fields.end == end <= self._end and opcode in _PLAIN:
            yield at, ScanDamage(at, _HEAD, f"a chunk record is marked as of kind {opcode}", 0)
            yield self._chunk(at, end)
        elif not self._fits(at, end) or not (opcode in _PLAIN or opcode > _LAST_KNOWN):
            size = end - at - _HEAD
            reason = f"a record of kind {opcode} claims {size} bytes"
            yield self._lost(at, reason if opcode else "no record starts here")
        elif opcode == Opcode.MESSAGE:
            yield self._loose(at, end)
        elif opcode in _PLAIN or opcode >= _FIRST_PRIVATE:
            yield from self._plain(at, opcode, end)
        elif self._goes_on(end):
            self._at = end  # a reserved kind
        else:
            yield self._lost(at, f"a record of kind {opcode}")

    def _fits(self, at: int, end: int) -> bool:
        """True if a record reaches neither into a chunk of the summary nor over the end."""
        known = self._places.next(at)
        is_free = known is None or known >= end or not self._places.count()
        return is_free and end <= self._end

    # Chunks

    def _chunk_or_damage(
        self, at: int, end: int, fields: _ChunkHead | None
    ) -> Iterator[tuple[int, Item]]:
        """The chunk at a byte, with the length in its head, or by its own fields."""
        if fields is not None and fields.end == end > self._window.size:
            data = self._window.part(fields.data, self._window.size - fields.data)
            torn = TornChunk(fields.compression, fields.size, data)
            yield self._torn(at, "the file ends in the middle of a chunk", torn)
            return
        is_sure = fields is not None and fields.end == end
        if self._fits(at, end) and (is_sure or self._goes_on(end)):
            yield self._chunk(at, end)
        elif fields is not None and self._fits(at, fields.end) and self._goes_on(fields.end):
            yield at, ScanDamage(at, _HEAD, "the length of a chunk record is wrong", 0)
            yield self._chunk(at, fields.end)
        else:
            yield self._lost(at, f"a chunk record claims {end - at - _HEAD} bytes", Opcode.CHUNK)

    def _chunk(self, at: int, end: int) -> tuple[int, Item]:
        """The chunk in `[at, end)`; its own fields may still be wrong."""
        self._chunked = True
        self._at = self._behind = end
        fields = _chunk_head(self._window, at)
        if fields is None or fields.data > end:
            is_other = self._places.count() and self._places.end(at) is None
            kind = None if is_other else Opcode.CHUNK
            reason = "the fields of a chunk are damaged"
            return at, ScanDamage(at, end - at, reason, opcode=kind)
        if end - at > self._limit:
            return at, self._too_large(at, end, Opcode.CHUNK)
        self._behind = min(fields.end, end)
        self._needs_crc |= not fields.crc
        data = self._window.part(fields.data, self._behind - fields.data)
        return at, ScannedChunk(
            at, end - at, fields.compression, fields.size, fields.crc, data, self._limit
        )

    # Other records

    def _loose(self, at: int, end: int) -> tuple[int, Item]:
        """A run of messages outside of chunks."""
        size = end - at - _HEAD
        if size > MAX_PAYLOAD:
            self._at = self._behind = end
            return at, self._too_large(at, end, Opcode.MESSAGE)
        if size < _LEAST[Opcode.MESSAGE]:
            return self._lost(at, f"a message record claims {size} bytes")
        if self._chunked and _is_other_record(self._window.at(at, end - at)[_HEAD:]):
            self._at = self._behind = end
            reason = "a record is marked as a message but is none"
            return at, ScanDamage(at, end - at, reason, 0)
        self._needs_crc = True
        self._window.at(at, end - at)
        until = min(self._end, self._places.next(at) or self._end)
        run = self._window.rest(at)[: until - at]
        found = parse_content(run, loose=not self._chunked, messages_only=self._chunked)
        if found.damage:
            found = parse_content(run, messages_only=True)
        self._at = self._behind = at + found.end
        return at, Loose(found, at)

    def _plain(self, at: int, opcode: int, end: int) -> Iterator[tuple[int, Item]]:
        start = at + _HEAD
        self._at, self._behind = end, start
        if opcode == Opcode.DATA_END:
            if self._stop is None and self._ends_data(end):
                yield from self._finish(at, _DATA_END)
            else:
                reason = "an end of data stands in the middle of the data"
                yield at, ScanDamage(at, end - at, reason)
        elif opcode != Opcode.ATTACHMENT and end - start > _MAX_PLAIN:
            if opcode <= _LAST_KNOWN:
                yield at, self._too_large(at, end, opcode)
        elif opcode < _FIRST_PRIVATE:
            try:
                item, used = self._parsed(opcode, start, end - start)
            except SegmentError as error:
                yield at, ScanDamage(at, end - at, str(error), 0)
                return
            self._behind = start + used
            if item is not None:
                yield at, item

    def _parsed(self, opcode: int, start: int, size: int) -> tuple[Record | Attachment | None, int]:
        if opcode != Opcode.ATTACHMENT:
            return read_record(opcode, self._window.at(start, size))
        part = FilePart(self._window.file, start, size)
        return parse_attachment(self._window.at(start, min(size, MAX_HEAD)), part)

    # The end of the data

    def _finish(self, at: int, head: bytes) -> Iterator[tuple[int, Item]]:
        self._is_ended = True
        if head != _DATA_END:
            yield at, ScanDamage(at, 0, "the record that ends the data is damaged", 0)
            return
        self._at = at + _DATA_END_SIZE
        crc = int.from_bytes(self._window.at(at + _HEAD, 4), "little")
        if crc and self._needs_crc and self._is_first and self._crc_up_to(at) != crc:
            reason = "the checksum of all data differs: some bytes before this one have changed"
            yield at, ScanDamage(0, at, reason, opcode=Opcode.DATA_END)
        yield at, records.DataEnd(crc)

    def _crc_up_to(self, end: int) -> int:
        crc = 0
        for at in range(0, end, _WINDOW):
            crc = crc32(self._window.peek(at, min(_WINDOW, end - at)), crc)
        return crc

    def _ends_data(self, end: int) -> bool:
        """True if the summary, or the end of the file, follows."""
        raw = self._window.peek(end, _HEAD)
        if len(raw) < _HEAD:
            return True
        opcode, length = RECORD_HEAD.unpack(raw)
        is_known = opcode == Opcode.FOOTER or is_in_summary(opcode)
        return is_known and length <= self._window.size - end - _HEAD

    # Damage

    def _too_large(self, at: int, end: int, opcode: int) -> ScanDamage:
        messages = None if opcode == Opcode.CHUNK else int(opcode == Opcode.MESSAGE)
        limits: dict[int, int] = {Opcode.CHUNK: self._limit, Opcode.MESSAGE: MAX_PAYLOAD}
        limit = limits.get(opcode, _MAX_PLAIN)
        reason = f"a record of {end - at} bytes is above the limit of {limit}"
        return ScanDamage(at, end - at, reason, messages, opcode=opcode)

    def _torn(self, at: int, reason: str, torn: TornChunk | None = None) -> tuple[int, Item]:
        self._at = self._window.size
        return at, ScanDamage(at, self._window.size - at, reason, None, torn)

    def _lost(self, at: int, reason: str, opcode: int | None = None) -> tuple[int, Item]:
        """Skip to the next chunk of the summary, or to the next records that are whole."""
        found = self._places.next(at) if self._places.count() else None
        start = self._behind if self._behind < at else at + 1
        found = found or self._search(start) or self._stop
        if found is None:
            return self._torn(at, f"the file ends in the middle of a record: {reason}")
        where = min(at, self._behind, found)
        self._at = self._behind = found
        reason += f"; reading goes on at byte {found}"
        return where, ScanDamage(where, found - where, reason, opcode=opcode)

    def _search(self, start: int) -> int | None:
        """The first byte, from one on, where records that are whole follow one another.

        Between chunks, no message and no definition counts: a chunk that is not compressed is
        full of them.
        """
        wanted = np.zeros(256, np.bool_)
        wanted[list(_BETWEEN_CHUNKS if self._chunked else _PLAIN | {Opcode.CHUNK})] = True
        for block in range(start, self._end, _WINDOW):
            raw = self._window.peek(block, min(_WINDOW, self._end - block) + _HEAD - 1)
            if len(raw) < _HEAD:
                return None
            data = np.frombuffer(raw, np.uint8)
            # No length reaches 2^40, which excludes nearly all positions.
            sieve = wanted[data[: 1 - _HEAD]]
            sieve &= (data[6:-2] == 0) & (data[7:-1] == 0) & (data[8:] == 0)
            for place in np.flatnonzero(sieve).tolist():
                if self._is_start(block + place):
                    return block + int(place)
        return None

    def _is_start(self, at: int) -> bool:
        """True for a record that nothing else looks like, or for three in a row."""
        for _ in range(3):
            fields = _chunk_head(self._window, at)
            end = self._end_of(at)
            if end is None or end == self._window.size:
                return end is not None
            if (fields is not None and fields.end == end) or self._window.peek(
                at, _HEAD
            ) == _DATA_END:
                return True
            at = end
        return True

    def _end_of(self, at: int) -> int | None:
        """The end of a plausible record."""
        raw = self._window.peek(at, _HEAD + 6)
        if len(raw) < _HEAD:
            return None
        opcode, length = RECORD_HEAD.unpack_from(raw)
        end = at + _HEAD + length
        if opcode == Opcode.CHUNK:  # it alone may run over the end: nothing else looks like it
            fields = _chunk_head(self._window, at)
            return None if fields is None or fields.end > end else end
        is_known = opcode in _PLAIN and length >= _LEAST.get(opcode, 0)
        if end > self._window.size or not (is_known or opcode >= _FIRST_PRIVATE):
            return None
        if opcode == Opcode.MESSAGE_INDEX:
            (entries,) = struct.unpack_from("<I", raw, _HEAD + 2)
            return None if entries + 6 > length or entries % 16 else end
        return None if opcode == Opcode.DATA_END and length != 4 else end

    def _goes_on(self, at: int) -> bool:
        """True if `at` is the start of a record or the end of the data."""
        return at in {self._end, self._window.size} or self._end_of(at) is not None
