"""Reads an MCAP file forward, also a damaged one.

Damage in a chunk costs the whole chunk, damage elsewhere one record. Reading goes on where a record
ends, or else at the next chunk of the summary, or where plausible records follow one another.
"""

from __future__ import annotations

from bisect import bisect_right
from contextlib import suppress
from typing import TYPE_CHECKING, Final, TypeAlias

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, McapRecord

from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import (
    HEAD,
    LAST_KNOWN,
    MAGIC,
    MAX_CHUNK_HEAD,
    MAX_UNCOMPRESSED,
    MIN_RECORDS,
    RECORD_HEAD,
    TAIL,
    ChunkContent,
    ChunkHead,
    Damage,
    RecordFile,
    beginning,
    chunk_head_of,
    decompress,
    footer_of,
    parse_content,
    parse_summary,
    read_record,
)
from hybridlog_storage.messages import MAX_PAYLOAD, Buffer
from hybridlog_storage.segments.segment_format import (
    MAX_HEAD,
    Attachment,
    FilePart,
    parse_attachment,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from mcap.summary import Summary


_CODECS: Final = frozenset({"", "zstd", "lz4"})
_DATA_END: Final = RECORD_HEAD.pack(Opcode.DATA_END, 4)
_WINDOW: Final = 1 << 20
_MAX_PLAIN: Final = 1 << 26  # largest record that is neither chunk, message nor attachment
_MAX_SUMMARY: Final = 1 << 28

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
_Found: TypeAlias = tuple[int, list[Item]]
"""Where a record ends, and what it is."""


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
        self._has_end = self._read_summary()
        listed = self.summary.chunk_indexes if self.summary is not None else list[ChunkIndex]()
        self._listed = sorted(one.chunk_start_offset for one in listed)
        self._chunked = bool(self._listed)
        self._is_closed = False  # or damage tells that it is not

    def _read_summary(self) -> bool:
        """Read the summary; returns whether the footer says where the data end."""
        self._end = self._bytes.size  # of the data, with the record that ends them
        end = self._bytes.size - TAIL
        footer = footer_of(self._read(end, TAIL)) if end >= len(MAGIC) else None
        if footer is None:
            return False
        start, _, crc = footer
        last = start - HEAD - 4
        is_there = last >= len(MAGIC) and self._bytes.at(last, HEAD) == _DATA_END
        if not is_there or end - start > _MAX_SUMMARY:
            return False
        self._end = start
        data = self._read(start, end - start + TAIL - len(MAGIC) - 4)
        with suppress(SegmentError):
            if crc in {0, crc32(data)}:
                self.summary = parse_summary(data[: end - start])[0]
        return True

    def items(self) -> Iterator[tuple[int, Item]]:
        """Each byte of the file where an item starts, and the item, in file order.

        Items are messages with the definitions between them, other records, and damage.
        """
        at, size = len(MAGIC), self._bytes.size
        while at < size:
            try:
                end, found = self._record(at)
            except SegmentError as error:
                end = self._behind(at)
                found = [Damage(at, end - at, str(error))]
                self._is_closed |= end == size
            for item in found:
                yield at, item
            at = end
        if not self._is_closed:
            why = "the file was not closed: its end is missing; all before it was read"
            yield size, Damage(size, 0, why, 0)

    def _record(self, at: int) -> _Found:
        head = self._bytes.at(at, HEAD, move=True)
        if len(head) < HEAD:
            raise SegmentError("the file ends in the middle of a record")
        opcode, length = RECORD_HEAD.unpack(head)
        end = at + HEAD + length
        if opcode == Opcode.CHUNK:
            return self._chunk(at, end)
        if end > self._end or not (opcode in _IN_DATA or opcode > LAST_KNOWN):
            what = f"a record of kind {opcode} claims {length} bytes"
            raise SegmentError(what if opcode else "no record starts here")
        if opcode == Opcode.MESSAGE:
            return self._loose(at, end)
        return self._data_end(end) if opcode == Opcode.DATA_END else self._plain(at, end)

    # Chunks

    def _head_of(self, at: int) -> ChunkHead | None:
        head = chunk_head_of(self._bytes.at(at, MAX_CHUNK_HEAD))
        return head if head is not None and head.codec in _CODECS else None

    def _chunk(self, at: int, said: int) -> _Found:
        """A chunk, whose own fields say where it ends, whatever the length of its record."""
        head, size = self._head_of(at), self._bytes.size
        if head is None:
            raise SegmentError("the fields of a chunk are wrong")
        self._chunked, end = True, at + head.end
        if min(end, said) > size:
            return size, self._cut(at, head)
        try:
            return end, self._told(at, self._content(at + head.start, head, end))
        except SegmentError as error:
            why = f"a chunk is damaged: {error}"
            if not self._goes_on(end):
                raise SegmentError(why) from error
            return end, [Damage(at, end - at, why)]

    def _content(self, start: int, head: ChunkHead, end: int) -> ChunkContent:
        most = max(head.size, end - start)
        if most > self._limit or end > self._bytes.size:
            raise SegmentError(f"it claims {most} bytes, more than the limit of {self._limit}")
        data = self._bytes.at(start, end - start, move=end - start <= _WINDOW)
        content = decompress(head.codec, data, head.size)
        if head.crc not in {0, crc32(content)}:
            raise SegmentError("its checksum differs")
        return parse_content(content, most=MIN_RECORDS + end - start)

    def _cut(self, at: int, head: ChunkHead) -> list[Item]:
        """The first messages of a chunk in which the file ends; no checksum proves them."""
        self._is_closed, start = True, at + head.start
        rest = self._bytes.at(start, min(self._bytes.size - start, self._limit))
        found = beginning(head.codec, rest, min(head.size, self._limit))
        why = "the file ends in a chunk: its last messages are lost"
        told = self._told(at, parse_content(found, loose=True))
        return [Damage(at, self._bytes.size - at, why), *told]

    def _told(self, at: int, content: ChunkContent) -> list[Item]:
        """Messages and the definitions between them, behind what is wrong with them."""
        found: list[Item] = [Damage(at, 0, reason, 0) for reason in content.unreadable]
        if len(content.invalid):
            lost, first = len(content.invalid), int(content.invalid[0])
            reason = (
                f"{lost} messages have a log time beyond 2^63 - 1 ns or no head "
                f"(the first at byte {first} of the content)"
            )
            found.append(Damage(at, 0, reason, lost))
        return [*found, content]

    # Other records

    def _loose(self, at: int, end: int) -> _Found:
        """A run of messages outside of chunks."""
        size = end - at - HEAD
        if self._chunked or not _MESSAGE_SIZE <= size <= MAX_PAYLOAD:
            where = "between chunks" if self._chunked else f"of {size} bytes"
            raise SegmentError(f"a message record {where} is none")
        self._bytes.at(at, size + HEAD, move=True)
        found = parse_content(self._bytes.rest(at)[: self._end - at], loose=True)
        return at + found.end, self._told(at, found)

    def _plain(self, at: int, end: int) -> _Found:
        """A record that is neither chunk nor message."""
        try:
            item, used = self._parsed(self._bytes.at(at, 1)[0], at + HEAD, end - at - HEAD)
        except SegmentError as error:
            item, used = Damage(at, end - at, str(error), 0), 0
        if used < end - at - HEAD and not self._goes_on(end):
            raise SegmentError("the length of a record is wrong")
        return end, [] if item is None else [item]

    def _parsed(self, opcode: int, start: int, size: int) -> tuple[Item | None, int]:
        """A record, and the bytes of its known fields."""
        if opcode > LAST_KNOWN:
            return None, 0
        if opcode == Opcode.MESSAGE_INDEX:
            return None, 6 + int.from_bytes(self._bytes.at(start + 2, min(size, 4)), "little")
        if opcode == Opcode.ATTACHMENT:
            head = self._bytes.at(start, min(size, MAX_HEAD))
            return parse_attachment(head, FilePart(self._read, start, size))
        if size > _MAX_PLAIN:
            raise SegmentError(f"a record of {size} bytes is above the limit of {_MAX_PLAIN}")
        return read_record(opcode, self._bytes.at(start, size))

    def _data_end(self, end: int) -> _Found:
        if self._has_end and end != self._end:
            raise SegmentError("an end of data stands in the middle of the data")
        found: list[Item] = []
        size = self._bytes.size
        rest = self._bytes.at(end, TAIL + 1)
        is_whole = self.summary is not None or (len(rest) == TAIL and footer_of(rest) is not None)
        behind: int | None = None
        if not is_whole and rest:
            behind = self._bytes.search(end, size, {Opcode.CHUNK}, self._is_start)
            why = "the summary is damaged, or bytes follow it"
            why = why if behind is None else "bytes follow the end of the log"
            found.append(Damage(end, (behind or size) - end, why, 0))
        self._is_closed |= is_whole or bool(rest)
        self._has_end, self._end = False, size
        return behind or size, found

    # Behind damage

    def _behind(self, at: int) -> int:
        """Where reading goes on: at a chunk of the summary, or at records that are whole."""
        place = bisect_right(self._listed, at)
        if place < len(self._listed) and self._is_chunk(self._listed[place]):
            return self._listed[place]
        kinds = _BETWEEN_CHUNKS if self._chunked else _IN_DATA
        found = self._bytes.search(at + 1, self._end, kinds, self._is_start)
        last = self._end - len(_DATA_END) - 4 if self._has_end else self._bytes.size
        return found or max(last, at + 1)

    def _is_chunk(self, at: int) -> bool:
        head = self._head_of(at)
        return head is not None and head.opcode == Opcode.CHUNK and head.length == head.end

    def _is_start(self, at: int) -> bool:
        """True for a record that nothing else looks like, or for three in a row."""
        for _ in range(3):
            end = self._end_of(at)
            if end is None or end == self._bytes.size:
                return end is not None
            if self._is_chunk(at) or self._bytes.at(at, HEAD) == _DATA_END:
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
            return end if self._head_of(at) is not None else None
        if end > self._bytes.size or not (opcode in _IN_DATA or opcode > LAST_KNOWN):
            return None
        if opcode == Opcode.MESSAGE_INDEX:
            entries = int.from_bytes(raw[HEAD + 2 :], "little")
            return end if entries + 6 <= length and entries % 16 == 0 else None
        return end

    def _goes_on(self, at: int) -> bool:
        """True if `at` is the start of a record or the end of the data."""
        return at in {self._end, self._bytes.size} or self._end_of(at) is not None
