"""Parses records of MCAP chunks, and rare records anywhere, from untrusted bytes.

A Python loop only finds the start of each message; numpy gathers the heads. Records of
other kinds are rare and become objects.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.summary import Summary

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.lazy import RowType
from hybridlog_storage.messages import MAX_PAYLOAD, Batch
from hybridlog_storage.segments.compression import decompress_pieces, is_implausible

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from hybridlog_storage.messages import Buffer
    from hybridlog_storage.segments.compression import FilePart

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the content, at the start of every record."""
_SIZE = struct.Struct("<I")
_NUMBER = struct.Struct("<H")
_NUMBERS = struct.Struct("<HH")

MESSAGE_HEAD = RowType(
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
)
"""A message record up to its payload: 31 bytes."""

_MESSAGE = int(Opcode.MESSAGE)
_DEFINITIONS = frozenset({int(Opcode.SCHEMA), int(Opcode.CHANNEL)})
_PAYLOAD = MESSAGE_HEAD.itemsize
_FIELDS = _PAYLOAD - RECORD_HEAD.size
_TIME_LIMIT = 1 << 63
_PART = 4 << 20  # bytes of content that are read together

MIN_RECORDS = 1 << 16
"""Records that a chunk may hold in addition to one a compressed byte."""

Record: TypeAlias = (
    records.AttachmentIndex
    | records.Channel
    | records.ChunkIndex
    | records.DataEnd
    | records.Footer
    | records.Header
    | records.MessageIndex
    | records.Metadata
    | records.MetadataIndex
    | records.Schema
    | records.Statistics
    | records.SummaryOffset
)
"""An MCAP record that is parsed into an object."""


class Definition(NamedTuple):
    """A schema or channel, and the first message that it applies to.

    Attributes:
        row: First row of the batch that it applies to, 0 to n.
        record: The definition.
    """

    row: int
    record: records.Schema | records.Channel


@dataclass(slots=True)
class ScanDamage:
    """A place that could not be read.

    Attributes:
        offset: Byte where it starts, in the file, or in the buffer for damage inside a
            chunk.
        length: Bytes that could not be read, None if unknown.
        reason: Description of the damage.
        messages: Number of messages in it, None if unknown.
        torn: The beginning of a chunk whose end is missing.
        opcode: Kind of the damaged record, None if unknown.
    """

    offset: int
    length: int | None
    reason: str
    messages: int | None = None
    torn: TornChunk | None = None
    opcode: int | None = None


@dataclass(slots=True)
class TornChunk:
    """The compressed beginning of a chunk whose end is missing.

    Attributes:
        compression: MCAP name of the codec.
        uncompressed_size: Bytes of the whole chunk, uncompressed.
        data: The available compressed bytes.
    """

    compression: str
    uncompressed_size: int
    data: FilePart

    def contents(self) -> Iterator[ChunkContent]:
        """The whole records, in parts. No checksum covers them."""
        with suppress(SegmentError):
            yield from parse_parts(self.compression, self.data, self.uncompressed_size)


class ChunkContent(NamedTuple):
    """The records of one uncompressed chunk.

    Attributes:
        batch: Its messages, in order; `channel` is the MCAP channel id, payload offsets
            are into the buffer that was parsed.
        schemas: Schemas defined inside, the last of each id.
        channels: Channels defined inside, the last of each id.
        definitions: All of them in order, each with the first row that it applies to.
        invalid: int64, offset in the buffer of each omitted message record: too short, or
            with a log time beyond 2^63 - 1 ns.
        unpublished: Number of messages whose publish time is beyond 2^63 - 1 ns; their log
            time replaces it.
        damage: Definitions that could not be read; offsets are into the buffer.
        end: Byte of the buffer behind the last record.
        records: Number of all records.
    """

    batch: Batch
    schemas: dict[int, records.Schema]
    channels: dict[int, records.Channel]
    definitions: list[Definition]
    invalid: NDArray[np.int64]
    unpublished: int
    damage: list[ScanDamage]
    end: int
    records: int


def parse_content(
    buffer: Buffer,
    base: int = 0,
    *,
    torn: bool = False,
    messages_only: bool = False,
    loose: bool = False,
    most: int = 1 << 62,
) -> ChunkContent:
    """Read the records of an uncompressed chunk.

    Args:
        buffer: The bytes with the records.
        base: Byte of `buffer` where the first record starts.
        torn: The end of the records is missing: omit an incomplete record.
        messages_only: Stop, without error, at the first record that is not a whole
            message.
        loose: Likewise, but include definitions that fill their records exactly; others
            count as damage.
        most: Most records.

    Returns:
        Messages and definitions. Records of other kinds are skipped, as MCAP requires.

    Raises:
        SegmentError: A record runs over the end, or has the invalid kind 0; the message
            names its offset. Or there are more than `most`.
    """
    walk = _Walk(buffer, base, most, messages_only=messages_only, loose=loose)
    starts = np.fromiter(walk.messages(), np.int64)
    if walk.records > most:
        raise SegmentError("it holds too many records for its size")
    if not (torn or messages_only or loose) and walk.end != len(buffer):
        problem = f"runs over the end at {len(buffer)}" if buffer[walk.end] else "has no kind"
        raise SegmentError(f"the record at byte {walk.end} of its content {problem}")
    batch, good, unpublished = _batch(buffer, starts)
    # Rows count valid messages only.
    good_before = None if good is None else np.concatenate(([0], np.cumsum(good)))
    definitions: list[Definition] = []
    damage: list[ScanDamage] = []
    for row, opcode, start, end in walk.others:
        content = memoryview(buffer)[start + RECORD_HEAD.size : end]
        try:
            record, used = read_record(opcode, content)
            if loose and used != len(content):
                raise SegmentError("a definition does not fill its record")
        except SegmentError as error:
            damage.append(ScanDamage(start, end - start, str(error), 0))
            continue
        if isinstance(record, records.Schema | records.Channel):
            definitions.append(
                Definition(row if good_before is None else int(good_before[row]), record)
            )
    return ChunkContent(
        batch,
        {d.record.id: d.record for d in definitions if isinstance(d.record, records.Schema)},
        {d.record.id: d.record for d in definitions if isinstance(d.record, records.Channel)},
        definitions,
        starts[:0] if good is None else starts[~good],
        unpublished,
        damage,
        walk.end,
        walk.records,
    )


def parse_parts(compression: str, data: FilePart, size: int) -> Iterator[ChunkContent]:
    """Decompress and read a chunk from a foreign file in parts, in bounded memory.

    Yields:
        The records, in order, in parts of at least `_PART` bytes.

    Raises:
        SegmentError: The rest cannot be read.
    """
    parts = _Parts(size, len(data))
    damage: SegmentError | None = None
    pieces = decompress_pieces(compression, data)
    while damage is None:
        try:
            piece = next(pieces, None)
        except SegmentError as error:
            damage = error
            break
        if piece is None:
            break
        yield from parts.add(piece)
    yield from parts.rest()
    if damage is not None:
        raise damage
    parts.check()


class _Parts:
    """Collects content until its records can be read together."""

    def __init__(self, size: int, compressed: int) -> None:
        self._size = size
        self._compressed = compressed
        self._most = MIN_RECORDS + compressed
        self._held = bytearray()
        self._base = 0  # content before `_held`
        self._skipped = 0  # bytes to skip
        self._wanted = _PART

    def add(self, piece: Buffer) -> Iterator[ChunkContent]:
        """Take the next piece; yields the records if there are enough.

        Raises:
            SegmentError: The next record is not believed, or there are too many.
        """
        skipped = min(self._skipped, len(piece))
        self._skipped -= skipped
        self._base += skipped
        self._held += memoryview(piece)[skipped:]
        if self._base + len(self._held) > self._size:
            raise SegmentError(f"it decompresses to more bytes, not {self._size} as it claims")
        if len(self._held) >= min(self._wanted, max(self._size - self._base, 1)):
            yield from self.rest()
            self._look_ahead()

    def rest(self) -> Iterator[ChunkContent]:
        """Yield the whole records so far."""
        if self._held:
            part = parse_content(self._held, torn=True, most=self._most)
            self._most -= part.records
            self._base += part.end
            self._held = self._held[part.end :]  # the batch keeps the old one
            yield part

    def check(self) -> None:
        """Raise if records are missing at the end.

        Raises:
            SegmentError: The content ends too early.
        """
        found = self._base + len(self._held)
        if found < self._size:
            raise SegmentError(f"it decompresses to only {found} bytes, not {self._size}")
        if self._held:
            raise SegmentError(f"the record at byte {self._base} of its content runs over the end")

    def _look_ahead(self) -> None:
        """Decide how much the next, incomplete record needs."""
        self._wanted = _PART
        if len(self._held) < RECORD_HEAD.size:
            return
        opcode, length = RECORD_HEAD.unpack_from(self._held)
        length += RECORD_HEAD.size
        where = f"the record at byte {self._base} of its content"
        if not opcode:
            raise SegmentError(f"{where} has no kind")
        if self._base + length > self._size:
            raise SegmentError(f"{where} runs over the end at {self._size}")
        if opcode not in {Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL}:
            self._skipped = length - len(self._held)
            self._base += len(self._held)
            self._held = bytearray()
        elif length > MAX_PAYLOAD or is_implausible(length, self._compressed):
            raise SegmentError(f"{where} claims {length} bytes, too many to be believed")
        else:
            self._wanted = max(_PART, length)


class _Walk:
    """Walks from record to record; collects the other records and the end position."""

    def __init__(
        self, buffer: Buffer, start: int, most: int, *, messages_only: bool, loose: bool
    ) -> None:
        self.end = start
        self.records = 0
        self.others: list[tuple[int, int, int, int]] = []
        self._buffer = buffer
        self._most = most
        self._messages_only = messages_only
        self._loose = loose

    def messages(self) -> Iterator[int]:
        """Yield the start of each message record. The only loop over single messages."""
        buffer, at, others = self._buffer, self.end, self.others
        head, head_size = RECORD_HEAD.unpack_from, RECORD_HEAD.size
        size = len(buffer)
        last = size - head_size
        row = skipped = 0
        while at <= last and row + skipped <= self._most:
            opcode, length = head(buffer, at)
            end = at + head_size + length
            if end > size:
                break
            if opcode == _MESSAGE:
                yield at
                row += 1
            elif self._messages_only or not opcode:
                break
            else:
                skipped += 1
                if opcode in _DEFINITIONS:
                    others.append((row, opcode, at, end))
                elif self._loose:
                    break
            at = end
        self.end, self.records = at, row + skipped


def _batch(
    buffer: Buffer, starts: NDArray[np.int64]
) -> tuple[Batch, NDArray[np.bool_] | None, int]:
    """The messages at `starts`, a mask of the valid ones (None: all), and `unpublished`."""
    size = len(buffer)
    good: NDArray[np.bool_] | None = None
    # With a last record shorter than a head, the gather below would read over the end.
    short = starts + _PAYLOAD > size
    if len(starts) and short[-3:].any():
        good = ~short
    chosen = starts if good is None else starts[good]
    if len(chosen):
        # A view of a head at every byte of the buffer; only the needed ones are copied.
        every = np.ndarray((size - _PAYLOAD + 1,), MESSAGE_HEAD, buffer=buffer, strides=(1,))
        heads = every[chosen]
    else:
        heads = np.empty(0, MESSAGE_HEAD)
    wrong = (heads["length"] < _FIELDS) | (heads["log_time"] >= _TIME_LIMIT)
    if wrong.any():
        heads, chosen = heads[~wrong], chosen[~wrong]
        if good is None:
            good = ~wrong
        else:
            good[np.flatnonzero(good)[wrong]] = False
    late = heads["publish_time"] >= _TIME_LIMIT
    publish_time = np.where(late, heads["log_time"], heads["publish_time"]).astype(np.int64)
    batch = Batch(
        buffer,
        chosen + _PAYLOAD,
        heads["length"].astype(np.int64) - _FIELDS,
        heads["channel"].astype(np.int32),
        heads["log_time"].astype(np.int64),
        publish_time,
        heads["sequence"].astype(np.uint32),
    )
    return batch, good, int(late.sum())


class _Fields(ReadDataStream):
    """Reads the fields of one record, within its bounds."""

    def __init__(self, content: Buffer) -> None:
        super().__init__(BytesIO(content))
        self._size = len(content)

    def read(self, length: int) -> bytes:
        if length > self._size - self.count:
            raise SegmentError("a field runs over the end of the record")
        data: bytes = super().read(length)
        return data


def _read_message_index(content: Buffer) -> tuple[records.MessageIndex, int]:
    channel, length = struct.unpack_from("<HI", content)
    if length > len(content) - 6 or length % 16:
        raise SegmentError("its list of messages has the wrong length")
    entries = list(struct.iter_unpack("<QQ", content[6 : 6 + length]))
    return records.MessageIndex(channel, entries), 6 + length


def _read_schema(content: Buffer) -> tuple[records.Schema, int]:
    (number,) = _NUMBER.unpack_from(content)
    name, at = _sized(content, 2)
    encoding, at = _sized(content, at)
    data, at = _sized(content, at)
    text = str(encoding, "utf-8")
    return records.Schema(id=number, data=bytes(data), encoding=text, name=str(name, "utf-8")), at


def _read_channel(content: Buffer) -> tuple[records.Channel, int]:
    number, schema = _NUMBERS.unpack_from(content)
    topic, at = _sized(content, 4)
    encoding, at = _sized(content, at)
    values, at = _sized(content, at)
    metadata: dict[str, str] = {}
    place = 0
    while place < len(values):
        key, place = _sized(values, place)
        value, place = _sized(values, place)
        metadata[str(key, "utf-8")] = str(value, "utf-8")
    record = records.Channel(
        id=number,
        topic=str(topic, "utf-8"),
        message_encoding=str(encoding, "utf-8"),
        metadata=metadata,
        schema_id=schema,
    )
    return record, at


def _sized(content: Buffer, at: int) -> tuple[Buffer, int]:
    """The bytes behind their length, and where they end."""
    (size,) = _SIZE.unpack_from(content, at)
    end = at + 4 + size
    if end > len(content):
        raise SegmentError("a field runs over the end of the record")
    return content[at + 4 : end], end


# Parsed several times as fast as by the mcap package; a file may have many of them.
_FREQUENT: dict[int, Callable[[Buffer], tuple[Record, int]]] = {
    Opcode.SCHEMA: _read_schema,
    Opcode.CHANNEL: _read_channel,
    Opcode.MESSAGE_INDEX: _read_message_index,
}
_READERS: dict[int, Callable[[ReadDataStream], Record]] = {
    Opcode.HEADER: records.Header.read,
    Opcode.FOOTER: records.Footer.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read,
    Opcode.STATISTICS: records.Statistics.read,
    Opcode.METADATA: records.Metadata.read,
    Opcode.METADATA_INDEX: records.MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset.read,
    Opcode.DATA_END: records.DataEnd.read,
}


def read_record(opcode: int, content: Buffer) -> tuple[Record | None, int]:
    """Parse one record that is neither a message nor a chunk nor an attachment.

    Args:
        opcode: Its kind.
        content: Its bytes, without the head. Bytes behind its fields are ignored.

    Returns:
        The record, None for another opcode; and the size of its fields in bytes (0 for
        None).

    Raises:
        SegmentError: Its fields exceed it, or are not UTF-8.
    """
    try:
        frequent = _FREQUENT.get(opcode)
        if frequent is not None:
            return frequent(content)
        reader = _READERS.get(opcode)
        if reader is None:
            return None, 0
        stream = _Fields(content)
        record = reader(stream)
    except (SegmentError, McapError, struct.error, UnicodeDecodeError) as error:
        name = Opcode(opcode).name.replace("_", " ").lower()  # every parsed kind has a name
        raise SegmentError(f"a {name} record is damaged ({error or 'too short'})") from error
    return record, stream.count


_LAST_KNOWN = max(Opcode)
_IN_SUMMARY = frozenset(
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


def is_in_summary(opcode: int) -> bool:
    """True for a kind of record that a summary may have."""
    return opcode in _IN_SUMMARY or opcode > _LAST_KNOWN


def parse_summary(data: Buffer, *, skipped: int = 0) -> tuple[Summary, dict[int, Buffer]]:
    """Parse the records between the data of a file and its footer.

    Args:
        data: Their bytes.
        skipped: Opcode of records that are not parsed.

    Returns:
        The summary; and the content of the last record of each kind that MCAP does not know.

    Raises:
        SegmentError: It is damaged.
    """
    view, at = memoryview(data), 0
    found = Summary()
    others: dict[int, Buffer] = {}
    while at < len(view):
        if at + RECORD_HEAD.size > len(view):
            raise SegmentError("it ends in the middle of a record")
        opcode, length = RECORD_HEAD.unpack_from(view, at)
        at += RECORD_HEAD.size
        if length > len(view) - at or not is_in_summary(opcode):
            raise SegmentError("it ends in the middle of a record")
        body = view[at : at + length]
        at += length
        if opcode > _LAST_KNOWN:
            others[opcode] = body
        record, _ = read_record(opcode, body) if opcode != skipped else (None, 0)
        if isinstance(record, records.Schema):
            found.schemas[record.id] = record
        elif isinstance(record, records.Channel):
            found.channels[record.id] = record
        elif isinstance(record, records.ChunkIndex):
            found.chunk_indexes.append(record)
        elif isinstance(record, records.AttachmentIndex):
            found.attachment_indexes.append(record)
        elif isinstance(record, records.MetadataIndex):
            found.metadata_indexes.append(record)
        elif isinstance(record, records.Statistics):
            found.statistics = record
    return found, others
