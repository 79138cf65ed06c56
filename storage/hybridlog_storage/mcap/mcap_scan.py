"""Reads an MCAP file forward, also a damaged one.

A record ends where its length says, or where its fields end if nothing goes on there. Behind damage
reading goes on at the next chunk of the summary, or where plausible records follow one another.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final, TypeAlias

from mcap.opcode import Opcode
from mcap.records import McapRecord

from hybridlog_storage.cache import lazy
from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import (
    HEAD,
    LAST_KNOWN,
    MAGIC,
    MAX_CHUNK_HEAD,
    MIN_RECORDS,
    RECORD_HEAD,
    TAIL,
    ChunkContent,
    ChunkHead,
    Damage,
    RecordFile,
    chunk_head_of,
    footer_of,
    is_in_summary,
    parse_content,
    parse_parts,
    parse_summary,
    read_record,
)
from hybridlog_storage.messages import MAX_PAYLOAD
from hybridlog_storage.segments.compression import (
    MAX_UNCOMPRESSED,
    FilePart,
    check_size,
    decompress,
    decompress_pieces,
)
from hybridlog_storage.segments.segment_format import MAX_HEAD, Attachment, parse_attachment

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from mcap.summary import Summary

    from hybridlog_storage.messages import Buffer

_DATA_END: Final = RECORD_HEAD.pack(Opcode.DATA_END, 4)
_CODECS: Final = frozenset({"", "zstd", "lz4"})
_WINDOW: Final = 1 << 20
_MAX_PLAIN: Final = 1 << 26  # largest record that is neither chunk, message nor attachment
_MAX_SUMMARY: Final = 1 << 28
_MAX_MOVED: Final = 1 << 26  # of a summary that is not where the footer says
_MAX_WHOLE: Final = 64 << 20  # content of a chunk that is decompressed at once

_BETWEEN_CHUNKS: Final = {
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.DATA_END,
}
_IN_DATA: Final = _BETWEEN_CHUNKS | {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_MESSAGE_SIZE: Final = 22  # bytes of its fields before the payload

Item: TypeAlias = McapRecord | Attachment | ChunkContent | Damage
"""An item of a scan."""


class Scan:
    """One MCAP file, read forward in bounded memory; `read` takes an offset and a length.

    Chunks of more than `limit` uncompressed bytes count as damage. `summary` is None if it is
    missing, as in a file that was not closed, or damaged.
    """

    def __init__(
        self, read: Callable[[int, int], Buffer], size: int, limit: int = MAX_UNCOMPRESSED
    ) -> None:
        self._read = read
        self._limit = limit
        self._bytes = RecordFile(lambda *place: memoryview(read(*place)), size, _WINDOW)
        self.summary: Summary | None = None
        self._stop = self._read_summary()  # end of the data by the summary
        self._chunked = self.summary is not None and bool(self.summary.chunk_indexes)
        self._at = len(MAGIC)
        self._needs_crc = False  # messages have no checksum of their own
        self._is_damaged = False
        self._is_closed = False  # or damage tells that it is not

    def _read_summary(self) -> int | None:
        end = self._bytes.size - TAIL
        tail = self._read(end, TAIL) if end >= len(MAGIC) else b""
        footer = footer_of(tail) if len(tail) == TAIL else None
        if footer is None or footer[0] < len(MAGIC) + HEAD + 4:
            return None
        start, _, crc = footer
        is_there = self._bytes.at(start - HEAD - 4, HEAD) == _DATA_END
        if self._parse_summary(start, end, crc) or is_there:
            return start
        # Where bytes of the data are missing, the summary begins before that place.
        first = max(len(MAGIC), end - _MAX_MOVED)
        found = bytes(self._read(first, end - first)).rfind(_DATA_END)
        moved = first + found + HEAD + 4
        is_moved = found >= 0 and moved < start and self._parse_summary(moved, end, crc)
        return moved if is_moved else None

    def _parse_summary(self, start: int, end: int, crc: int) -> bool:
        """Read the summary, if it starts there."""
        if not 0 <= end - start <= _MAX_SUMMARY:
            return False
        data = self._read(start, end - start + TAIL - len(MAGIC) - 4)
        with suppress(SegmentError):
            if crc in {0, crc32(data)}:
                self.summary = parse_summary(data[: end - start])[0]
        return self.summary is not None

    @property
    def _end_of_data(self) -> int:
        """End of the data by the summary, or of the file."""
        return self._bytes.size if self._stop is None else self._stop

    def items(self) -> Iterator[tuple[int, Item]]:
        """Each byte of the file where an item starts, and the item, in file order.

        Items are messages with the definitions between them, other records, and damage.
        """
        while self._at < self._bytes.size:
            for at, item in self._step(self._at):
                self._is_damaged |= isinstance(item, Damage)
                yield at, item
        if not self._is_closed:
            why = "the file was not closed: its end is missing; all before it was read"
            yield _damage(self._bytes.size, 0, why, 0)

    def _step(self, at: int) -> Iterator[tuple[int, Item]]:
        """Read one record, one run of messages, or one place of damage."""
        head = self._bytes.at(at, HEAD, move=True)
        if at == self._stop:
            yield _damage(at, 0, "the record that ends the data is damaged", 0)
            yield from self._end()
            return
        if len(head) < HEAD:
            yield self._torn(at, "the file ends in the middle of a record")
            return
        opcode, length = RECORD_HEAD.unpack(head)
        end = at + HEAD + length
        chunk = self._chunk_head(at)
        if opcode == Opcode.CHUNK or (chunk is not None and chunk.end == end):
            yield from self._chunk(at, opcode, end, chunk)
        elif end > self._end_of_data or not (opcode in _IN_DATA or opcode > LAST_KNOWN):
            what = f"a record of kind {opcode} claims {length} bytes"
            yield self._lost(at, what if opcode else "no record starts here")
        elif opcode == Opcode.MESSAGE:
            yield from self._loose(at, end)
        else:
            self._at = end
            if opcode == Opcode.DATA_END:
                yield from self._data_end(at, end)
            else:
                yield from self._plain(at, opcode, end)

    # Chunks

    def _chunk_head(self, at: int) -> ChunkHead | None:
        """A chunk record with its places in the file; None if its fields are implausible."""
        head = chunk_head_of(self._bytes.at(at, MAX_CHUNK_HEAD))
        if head is None or head.codec not in _CODECS:
            return None
        return head._replace(start=at + head.start, end=at + head.end)

    def _chunk(
        self, at: int, opcode: int, end: int, chunk: ChunkHead | None
    ) -> Iterator[tuple[int, Item]]:
        """A chunk, also with a wrong length or kind."""
        is_right = chunk is not None and chunk.end == end
        ends = [end] if chunk is None else [one for one in (chunk.end, end) if one >= chunk.start]
        right = end if is_right else next((one for one in ends if self._goes_on(one)), None)
        if right is None:
            yield self._lost(at, f"a chunk record claims {end - at - HEAD} bytes")
            return
        self._chunked = True
        if chunk is None:
            self._at = right
            yield _damage(at, right - at, "the fields of a chunk are damaged")
            return
        if not (is_right and opcode == Opcode.CHUNK):
            yield _damage(at, HEAD, "the head of a chunk is damaged; it is read all the same", 0)
        yield from self._content(at, chunk._replace(end=right))

    def _content(self, at: int, chunk: ChunkHead) -> Iterator[tuple[int, Item]]:
        """The messages of a chunk, of its beginning if the file ends in it."""
        self._needs_crc |= not chunk.crc
        self._at = end = min(chunk.end, self._bytes.size)
        found = 0
        reason = "the file ends in the middle of a chunk" if end < chunk.end else ""
        self._is_closed |= end < chunk.end
        try:
            for content in self._contents(chunk, end):
                found += len(content.batch)
                yield from self._given(at, content)
        except SegmentError as error:
            reason = reason or f"a chunk is damaged: {error}"
        if reason or not self._goes_on(end):
            another = self._chunk_before(end, chunk.start)
            if another is not None:
                self._at = end = another
                reason, self._is_closed = "bytes of a chunk are missing", False
        if reason:
            before = f"; {found} messages of its beginning were read" if found else ""
            yield _damage(at, end - at, reason + before)

    def _chunk_before(self, end: int, start: int) -> int | None:
        """The next chunk, if it begins before the end that a record claims, which lacks bytes then.

        Only a chunk of the summary counts: one in the payload of a message is none of this file.
        """
        return self._bytes.search(start, end + HEAD - 1, {Opcode.CHUNK}, self._is_listed)

    @lazy
    def _listed(self) -> set[tuple[int, int, int, int, str]]:
        """Times, sizes and codec of each chunk of the summary; it may be elsewhere in the file."""
        return {
            (
                one.message_start_time,
                one.message_end_time,
                one.chunk_length,
                one.uncompressed_size,
                one.compression,
            )
            for one in (self.summary.chunk_indexes if self.summary else ())
        }

    def _is_listed(self, at: int) -> bool:
        head = self._chunk_head(at)
        return head is not None and (
            (head.first, head.last, head.length, head.size, head.codec) in self._listed
        )

    def _contents(self, chunk: ChunkHead, end: int) -> Iterator[ChunkContent]:
        """The records of a chunk, after comparing its checksum; no checksum covers a torn one."""
        length, is_torn = end - chunk.start, end < chunk.end
        if not is_torn and max(chunk.size, length) <= _MAX_WHOLE:
            data = self._bytes.at(chunk.start, length, move=length <= _WINDOW)
            content = decompress(chunk.codec, data, chunk.size, limit=self._limit)
            if chunk.crc not in {0, crc32(content)}:
                raise SegmentError("its checksum differs")
            yield parse_content(content, most=MIN_RECORDS + length)
            return
        if chunk.size > self._limit:
            raise SegmentError(
                f"it claims {chunk.size} bytes uncompressed, more than the limit of {self._limit}"
            )
        part = FilePart(self._read, chunk.start, length)
        if not is_torn:
            if chunk.codec:
                check_size(chunk.codec, chunk.size, length)
            crc = 0
            for piece in decompress_pieces(chunk.codec, part) if chunk.crc else ():
                crc = crc32(piece, crc)
            if crc != chunk.crc:
                raise SegmentError("its checksum differs")
        pieces = decompress_pieces(chunk.codec, part)
        yield from parse_parts(pieces, chunk.size, length, torn=is_torn)

    def _given(self, at: int, content: ChunkContent) -> Iterator[tuple[int, Item]]:
        for reason in content.unreadable:
            yield _damage(at, 0, reason, 0)
        if len(content.invalid):
            lost, first = len(content.invalid), int(content.invalid[0])
            reason = (
                f"{lost} messages have a log time beyond 2^63 - 1 ns or no head "
                f"(the first at byte {first} of the content)"
            )
            yield _damage(at, 0, reason, lost)
        yield at, content

    # Other records

    def _loose(self, at: int, end: int) -> Iterator[tuple[int, Item]]:
        """A run of messages outside of chunks."""
        size = end - at - HEAD
        if not _MESSAGE_SIZE <= size <= MAX_PAYLOAD:
            yield self._lost(at, f"a message record claims {size} bytes")
            return
        self._bytes.at(at, size + HEAD, move=True)
        if self._chunked and self._is_other_record(at, end):
            self._at = end
            yield _damage(at, end - at, "a record is marked as a message but is none", 0)
            return
        self._needs_crc = True
        run = self._bytes.rest(at)[: self._end_of_data - at]
        found = parse_content(run, loose=True)
        self._at = at + found.end
        yield from self._given(at, found)

    def _is_other_record(self, at: int, end: int) -> bool:
        """True if the content of a message record is exactly that of another kind.

        In files with chunks, messages outside of them are rare. But one wrong byte can turn
        any record between two chunks into a message, and no checksum covers those.
        """
        for opcode in (Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA):
            with suppress(SegmentError):
                if self._parsed(at, opcode, end)[1] == end:
                    return True
        return False

    def _parsed(self, at: int, opcode: int, end: int) -> tuple[Item | None, int]:
        """A record that is neither chunk nor message, and where its known fields end."""
        start, size = at + HEAD, end - at - HEAD
        if opcode > LAST_KNOWN:
            return None, start
        if opcode == Opcode.MESSAGE_INDEX:
            entries = int.from_bytes(self._bytes.at(start + 2, min(size, 4)), "little")
            return None, start + 6 + entries
        if opcode == Opcode.ATTACHMENT:
            head = self._bytes.at(start, min(size, MAX_HEAD))
            item, used = parse_attachment(head, FilePart(self._read, start, size))
            return item, start + used
        if size > _MAX_PLAIN:
            raise SegmentError(f"a record of {size} bytes is above the limit of {_MAX_PLAIN}")
        record, used = read_record(opcode, self._bytes.at(start, size))
        return record, start + used

    def _plain(self, at: int, opcode: int, end: int) -> Iterator[tuple[int, Item]]:
        """A record that is neither chunk nor message."""
        is_placed = self._goes_on(end)
        try:
            item, fields_end = self._parsed(at, opcode, end)
        except SegmentError as error:
            reason = str(error)
            yield _damage(at, end - at, reason, 0) if is_placed else self._lost(at, reason)
            return
        if not is_placed:
            self._at = self._chunk_before(end, at + 1) or min(fields_end, end)
        if self._at != end:
            yield _damage(at, HEAD, "the length of a record is wrong", 0)
        if item is not None:
            yield at, item

    # The end of the data

    def _data_end(self, at: int, end: int) -> Iterator[tuple[int, Item]]:
        if not (end == self._stop if self._stop is not None else self._ends_data(end)):
            yield _damage(at, end - at, "an end of data stands in the middle of the data")
            return
        crc = int.from_bytes(self._bytes.at(at + HEAD, 4), "little")
        # Where damage is known already, the checksum tells nothing new.
        if crc and self._needs_crc and not self._is_damaged:
            found = 0
            for start in range(0, at, _WINDOW):
                found = crc32(self._bytes.at(start, min(_WINDOW, at - start)), found)
            if found != crc:
                why = "the checksum of all data differs: some bytes before this one have changed"
                yield _damage(0, at, why)
        yield from self._end()

    def _ends_data(self, end: int) -> bool:
        """True if the summary, or the end of the file, follows."""
        raw = self._bytes.at(end, HEAD)
        if len(raw) < HEAD:
            return True
        opcode, length = RECORD_HEAD.unpack(raw)
        is_known = opcode == Opcode.FOOTER or is_in_summary(opcode)
        return is_known and length <= self._bytes.size - end - HEAD

    def _end(self) -> Iterator[tuple[int, Item]]:
        """Go behind the end of a log, and on with the next chunk if there is one."""
        at, size = self._at, self._bytes.size
        rest = self._bytes.at(at, TAIL + 1)
        is_footer = len(rest) == TAIL and footer_of(rest) is not None
        found: int | None = None
        if self.summary is None and not is_footer and at < size:
            found = self._bytes.search(at, size, {Opcode.CHUNK}, self._is_start)
            why = "the summary is damaged, or bytes follow it"
            why = why if found is None else "bytes follow the end of the log"
            yield _damage(at, (found or size) - at, why, 0)
        self._is_closed |= self.summary is not None or is_footer or at < size
        self._at, self._stop = found or size, None

    # Behind damage

    def _torn(self, at: int, reason: str) -> tuple[int, Item]:
        self._at, self._is_closed = self._bytes.size, True
        return _damage(at, self._bytes.size - at, reason)

    def _lost(self, at: int, reason: str) -> tuple[int, Item]:
        """Skip to the next records that are whole."""
        kinds = _BETWEEN_CHUNKS if self._chunked else _IN_DATA
        found = self._bytes.search(at + 1, self._end_of_data, kinds, self._is_start) or self._stop
        if found is None:
            return self._torn(at, f"the file ends in the middle of a record: {reason}")
        self._at = found
        return _damage(at, found - at, f"{reason}; reading goes on at byte {found}")

    def _is_start(self, at: int) -> bool:
        """True for a record that nothing else looks like, or for three in a row."""
        for _ in range(3):
            end, chunk = self._end_of(at), self._chunk_head(at)
            if end is None or end == self._bytes.size:
                return end is not None
            is_chunk = chunk is not None and chunk.end == end
            if is_chunk or self._bytes.at(at, HEAD) == _DATA_END:
                return True
            at = end
        return True

    def _end_of(self, at: int) -> int | None:
        """The end of a plausible record."""
        raw = self._bytes.at(at, HEAD + 6)
        if len(raw) < HEAD:
            return None
        opcode, length = RECORD_HEAD.unpack_from(raw)
        end: int = at + HEAD + length
        if opcode == Opcode.CHUNK:  # it alone may run over the end: nothing else looks like it
            chunk = self._chunk_head(at)
            return None if chunk is None or chunk.end > end else end
        if end > self._bytes.size or not (opcode in _IN_DATA or opcode > LAST_KNOWN):
            return None
        if opcode == Opcode.MESSAGE_INDEX:
            entries = int.from_bytes(raw[HEAD + 2 :], "little")
            return end if entries + 6 == length and entries % 16 == 0 else None
        return end

    def _goes_on(self, at: int) -> bool:
        """True if `at` is the start of a record or the end of the data."""
        return at in {self._end_of_data, self._bytes.size} or self._end_of(at) is not None


def _damage(at: int, length: int, reason: str, messages: int | None = None) -> tuple[int, Item]:
    return at, Damage(at, length, reason, messages)
