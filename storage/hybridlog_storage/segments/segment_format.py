"""The bytes of a segment: MCAP records and the private ones of hybridlog.

Pure functions from values to bytes and back. Rare records are built with the classes of
the `mcap` package. The records written for each chunk are packed here, so that a payload
is copied once on its way to the disk.

Names in channel metadata and of metadata records that start with `hybridlog.` are reserved.
"""

from __future__ import annotations

import json
import os
import struct
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Header, McapRecord, Metadata
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema as SchemaRecord
from msgspec import Struct, to_builtins
from msgspec.json import decode

from hybridlog_storage.cache import RowType
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import Loss
from hybridlog_storage.mcap.mcap_content import (
    CHUNK_HEAD,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    batch_of,
    checked_frame,
    decompress,
    heads_at,
    read_record,
)
from hybridlog_storage.messages import Batch, Buffer, Channel, Schema, run_starts
from hybridlog_storage.segments.chunk_table import PART

if TYPE_CHECKING:
    from numpy.typing import NDArray


SEALED_SUFFIX: Final = ".mcap"
PROFILE: Final = "hybridlog"
LIBRARY: Final = "hybridlog"
FORMAT_VERSION: Final = 4

OUR_NAMES: Final = "hybridlog."
"""Beginning of the names of the store's own metadata records and channel metadata."""
RECORDING_METADATA: Final = "hybridlog.recording"
LOSSES_METADATA: Final = "hybridlog.losses"
NO_PUBLISH_TIME: Final = "hybridlog.no_publish_time"
NO_INDEX: Final = "hybridlog.no_index"

ARRIVAL_OPCODE: Final = 0x90
"""Record of the application range of opcodes: the arrival numbers of the chunk before it, and
the rows that the chunk table will have of it."""
CHUNK_TABLE_OPCODE: Final = 0x92
"""Record of the summary: the chunk table, see `chunk_table`."""
DAMAGED_OPCODE: Final = 0x93
"""Record of bytes that were damaged when a crash was recovered."""
METADATA_CHECK: Final = "hybridlog.crc32"
"""Last key of each metadata record: eight hexadecimal digits of a CRC-32."""

INDEX_HEAD: Final = struct.Struct("<BQHI")
ARRIVAL_HEAD: Final = struct.Struct("<BQQII")
"""Head of an arrival record: opcode, length, byte of its chunk, CRC-32 of the chunk's head and of
its indexes."""

_INDEX: Final = bytes([Opcode.MESSAGE_INDEX])
_INDEX_ENTRY = RowType(("log_time", "<u8"), ("offset", "<u8"))
_COUNTS = struct.Struct("<II")  # parts and messages of a chunk


def sealed_name(number: int) -> str:
    """File name of a sealed segment."""
    return f"{number:06d}{SEALED_SUFFIX}"


def record_bytes(record: McapRecord) -> bytes:
    """One record of the `mcap` package as bytes."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()  # type: ignore[no-any-return, no-untyped-call]


START: Final = MAGIC + record_bytes(Header(profile=PROFILE, library=LIBRARY))
"""The first bytes of every segment."""


def schema_record(schema_id: int, schema: Schema) -> SchemaRecord:
    """The MCAP record of a schema."""
    return SchemaRecord(
        id=schema_id, name=schema.name, encoding=schema.encoding, data=bytes(schema.data)
    )


def channel_record(channel_id: int, schema_id: int, channel: Channel) -> ChannelRecord:
    """The MCAP record of a channel; private metadata keys hold what MCAP has no field for."""
    metadata = dict(channel.metadata)
    flags = {NO_PUBLISH_TIME: not channel.has_publish_time, NO_INDEX: not channel.is_indexed}
    for name, is_set in flags.items():
        metadata.pop(name, None)
        if is_set:
            metadata[name] = "1"
    return ChannelRecord(
        id=channel_id,
        topic=channel.topic,
        message_encoding=channel.message_encoding,
        schema_id=schema_id,
        metadata=metadata,
    )


def schema_of(record: SchemaRecord) -> Schema:
    """The schema of a record."""
    return Schema(record.name, record.encoding, bytes(record.data))


def channel_of(record: ChannelRecord, schemas: Mapping[int, Schema]) -> Channel:
    """The channel described by a record; `SegmentError` if its schema is not defined."""
    schema = schemas.get(record.schema_id)
    if schema is None and record.schema_id:
        raise SegmentError(f"channel {record.id} refers to schema {record.schema_id}: unknown")
    metadata = dict(record.metadata)
    return Channel(
        record.topic,
        record.message_encoding,
        schema,
        metadata,
        has_publish_time=metadata.pop(NO_PUBLISH_TIME, None) is None,
        is_indexed=metadata.pop(NO_INDEX, None) is None,
    )


def json_metadata(name: str, value: object) -> Metadata:
    """A metadata record with one JSON value."""
    text = json.dumps(value, ensure_ascii=False, sort_keys=True, separators=(",", ":"))
    return Metadata(name=name, metadata={"json": text})


def json_of(record: Metadata) -> dict[str, object]:
    """The value of a metadata record from `json_metadata`; `SegmentError` if it is not one."""
    try:
        value = json.loads(record.metadata["json"])
    except (KeyError, ValueError) as error:
        raise SegmentError(f"metadata record {record.name!r} cannot be read: {error}") from error
    if not isinstance(value, dict):
        raise SegmentError(f"metadata record {record.name!r} is not a JSON object")
    return value


class _Losses(Struct):
    rows: list[Loss]


def losses_record(rows: Sequence[Loss]) -> Metadata:
    """The metadata record of rows of the loss ledger."""
    return json_metadata(LOSSES_METADATA, {"rows": to_builtins(rows)})


def losses_in(record: Metadata) -> list[Loss]:
    """The rows of the loss ledger in a metadata record."""
    try:
        rows = decode(record.metadata["json"], type=_Losses).rows
    except (KeyError, ValueError, RecursionError) as error:
        raise SegmentError(f"a metadata record is damaged: {error!r}") from error
    for row in rows:
        if (row.first is None) != (row.last is None) or (row.first or 0) > (row.last or 0):
            raise SegmentError("a metadata record is damaged: a loss ends before it begins")
    return rows


def metadata_record(record: Metadata, offset: int) -> bytes:
    """A metadata record as it is written at a byte of a segment, with its checksum."""
    values = {key: value for key, value in record.metadata.items() if key != METADATA_CHECK}
    data = record_bytes(Metadata(record.name, {**values, METADATA_CHECK: "0" * 8}))
    return data[:-8] + _metadata_check(data, offset)


def metadata_of(data: Buffer, offset: int) -> Metadata:
    """The metadata record at a byte of a segment, without its checksum."""
    if len(data) < RECORD_HEAD.size + 8 or bytes(data[-8:]) != _metadata_check(data, offset):
        raise SegmentError("its checksum differs")
    opcode, length = RECORD_HEAD.unpack_from(data)
    record, used = read_record(opcode, memoryview(data)[RECORD_HEAD.size :])
    is_whole = length == used == len(data) - RECORD_HEAD.size
    if not isinstance(record, Metadata) or not is_whole:
        raise SegmentError("its fields do not fill it")
    record.metadata.pop(METADATA_CHECK, None)
    return record


def _metadata_check(data: Buffer, offset: int) -> bytes:
    """Checksum of the place of a metadata record and of all but its last eight bytes."""
    crc = crc32(memoryview(data)[:-8], crc32(offset.to_bytes(8, "little")))
    return b"%08x" % crc


def chunk_head(
    *,
    first: int,
    last: int,
    uncompressed_size: int,
    crc: int,
    compression: str,
    compressed_size: int,
) -> bytes:
    """The head of a chunk record: all bytes before the compressed data."""
    name = compression.encode()
    body = 8 + 8 + 8 + 4 + 4 + len(name) + 8 + compressed_size
    return b"".join(
        (
            CHUNK_HEAD.pack(Opcode.CHUNK, body, first, last, uncompressed_size, crc, len(name)),
            name,
            struct.pack("<Q", compressed_size),
        )
    )


def index_order(channel: NDArray[np.int32], log_time: NDArray[np.int64]) -> NDArray[np.intp]:
    """Rows of a chunk, intp[n], by channel and, within one, by log time.

    Messages of one channel and time stay in the order of the chunk.
    """
    return np.lexsort((log_time, channel))


def message_indexes(
    channel: NDArray[np.int32],
    log_time: NDArray[np.int64],
    record_offset: NDArray[np.int64],
    order: NDArray[np.intp],
) -> dict[int, bytes]:
    """Message index record of each channel in a chunk, by channel id.

    `channel` is int32[n], ids; `log_time` is int64[n], ns; `record_offset` is int64[n], byte of the
    content where each message record starts; `order` is from `index_order`.
    """
    channels = channel[order]
    entries = np.empty(len(order), _INDEX_ENTRY)
    entries["log_time"] = log_time[order]
    entries["offset"] = record_offset[order]
    starts = run_starts(channels).tolist()
    records: dict[int, bytes] = {}
    for start, end in zip(starts, [*starts[1:], len(channels)], strict=True):
        data = entries[start:end].tobytes()
        head = INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(data), int(channels[start]), len(data))
        records[int(channels[start])] = head + data
    return records


def definitions_chunk(content: bytes, offset: int) -> bytes:
    """A chunk of definitions alone at a byte of a file, with its arrival record."""
    packed = checked_frame(content)
    head = chunk_head(
        first=0,
        last=0,
        uncompressed_size=len(content),
        crc=crc32(content),
        compression="zstd",
        compressed_size=len(packed),
    )
    arrivals = arrival_record(offset, crc32(head), 0, _packed_arrivals(b"", 0, 0))
    return b"".join((head, packed, arrivals))


def pack_arrivals(parts: NDArray[np.void], seq: NDArray[np.int64]) -> bytes:
    """Pack `PART`[c] of a chunk, and its arrival numbers in chunk order, with a checksum."""
    steps = seq.astype("<i8")
    steps[1:] -= seq[:-1]
    return _packed_arrivals(parts.tobytes() + steps.tobytes(), len(parts), len(steps))


def _packed_arrivals(rows: bytes, parts: int, messages: int) -> bytes:
    return _COUNTS.pack(parts, messages) + checked_frame(rows)


def arrival_record(chunk: int, head_crc: int, indexes_crc: int, packed: bytes) -> bytes:
    """The record behind a chunk that starts at a byte of the file, from `pack_arrivals`.

    Checksums are CRC-32: of the chunk record before its content, and of its message indexes.
    """
    length = ARRIVAL_HEAD.size - RECORD_HEAD.size + len(packed)
    return ARRIVAL_HEAD.pack(ARRIVAL_OPCODE, length, chunk, head_crc, indexes_crc) + packed


def group_of(recording: Mapping[str, object], number: int) -> int:
    """The group of a segment by its metadata; its own number where they say none."""
    group = recording.get("group")
    return group if isinstance(group, int) and 0 <= group <= number else number


class Trailer(NamedTuple):
    """The whole records behind a chunk, `length` bytes.

    `head_crc` is the CRC-32 of the chunk record before its content. `indexes` are channel id and
    entries (`log_time`, `offset`) of each message index. `packed` is from `pack_arrivals`.
    """

    length: int
    head_crc: int
    indexes: list[tuple[int, NDArray[np.void]]]
    packed: memoryview

    def arrivals(self) -> tuple[NDArray[np.void], NDArray[np.int64]]:
        """`PART`[c] of the chunk, and its arrival numbers in chunk order."""
        try:
            if len(self.packed) < _COUNTS.size:
                raise SegmentError("they are too short")
            parts, messages = _COUNTS.unpack_from(self.packed)
            size = parts * PART.itemsize
            raw = decompress("zstd", self.packed[_COUNTS.size :], size + messages * 8)
        except SegmentError as error:
            raise SegmentError(f"its arrival numbers are damaged: {error}") from error
        # An empty frame is not checked for bytes behind it.
        if not messages and len(self.packed) != len(_packed_arrivals(b"", 0, 0)):
            raise SegmentError("its arrival numbers are damaged")
        steps = np.frombuffer(raw, "<i8", messages, size)
        return np.frombuffer(raw, PART, parts), np.cumsum(steps, dtype=np.int64)

    def batch(self, content: Buffer) -> Batch:
        """The messages of the chunk, whose uncompressed content is given."""
        found = [entries["offset"].astype(np.int64) for _, entries in self.indexes]
        # Each channel's starts are sorted already; merging sorted runs is ten times as fast.
        starts = np.sort(np.concatenate(found), kind="stable")
        if starts[0] == 0 and int(starts[-1]) + MESSAGE_HEAD.itemsize <= len(content):
            heads = heads_at(content, starts)
            sizes = heads["length"].astype(np.int64)
            ends = starts + sizes + RECORD_HEAD.size
            if (
                int(ends[-1]) == len(content)
                and (ends[:-1] == starts[1:]).all()
                and (heads["opcode"] == int(Opcode.MESSAGE)).all()
                and (sizes >= MESSAGE_HEAD.itemsize - RECORD_HEAD.size).all()
            ):
                return batch_of(content, starts, heads)
        raise SegmentError("its message indexes are those of another one")


def trailer_of(data: Buffer, chunk: int) -> Trailer:
    """Parse the records behind a chunk; `chunk` is the byte where it starts."""
    raw, at = bytes(data), 0
    places: list[tuple[int, int, int]] = []  # channel, number of entries, and their start
    while raw[at : at + 1] == _INDEX and at + INDEX_HEAD.size <= len(raw):
        _, _, channel, size = INDEX_HEAD.unpack_from(raw, at)
        places.append((channel, size // _INDEX_ENTRY.itemsize, at + INDEX_HEAD.size))
        at += INDEX_HEAD.size + size
    packed = at + ARRIVAL_HEAD.size
    if packed <= len(raw):
        opcode, length, owner, head_crc, crc = ARRIVAL_HEAD.unpack_from(raw, at)
        is_whole = (opcode, owner, crc) == (ARRIVAL_OPCODE, chunk, crc32(raw[:at]))
        if is_whole and at + RECORD_HEAD.size + length == len(raw):
            indexes = [(c, np.frombuffer(raw, _INDEX_ENTRY, *place)) for c, *place in places]
            return Trailer(len(raw), head_crc, indexes, memoryview(raw)[packed:])
    raise SegmentError("its message indexes or arrival numbers are damaged")


PIECE = 4 << 20
"""Bytes of content in memory at a time."""
MAX_HEAD = 1 << 20
"""Most bytes of the fields before the content, which hold two texts."""

_TIMES = struct.Struct("<QQ")
_TEXT = struct.Struct("<I")
_SIZE = struct.Struct("<Q")
_CRC = struct.Struct("<I")


class FilePart(NamedTuple):
    """A part of a file, or of memory; `read` takes an offset and a length."""

    read: Callable[[int, int], Buffer]
    start: int
    size: int


class Attachment(Struct, frozen=True):
    """An attachment record of a file; times are ns, 0 if unknown. `data` is in the file.

    Its name need be no valid file name, and need not be unique.
    """

    log_time: int
    create_time: int
    name: str
    media_type: str
    data: FilePart

    def pieces(self) -> Iterator[bytes]:
        """The content, in pieces of at most `PIECE` bytes."""
        read, start, size = self.data
        for at in range(0, size, PIECE):
            piece = bytes(read(start + at, min(PIECE, size - at)))
            if len(piece) < min(PIECE, size - at):
                raise SegmentError(f"bytes of the attachment {self.name!r} are missing")
            yield piece

    def record(self) -> Iterator[bytes]:
        """Its MCAP record, in pieces."""
        name, media_type = self.name.encode(), self.media_type.encode()
        fields = b"".join(
            (
                _TIMES.pack(self.log_time, self.create_time),
                _TEXT.pack(len(name)),
                name,
                _TEXT.pack(len(media_type)),
                media_type,
                _SIZE.pack(self.data.size),
            )
        )
        crc = crc32(fields)
        size = len(fields) + self.data.size + _CRC.size
        yield RECORD_HEAD.pack(Opcode.ATTACHMENT, size) + fields
        for piece in self.pieces():
            crc = crc32(piece, crc)
            yield piece
        yield _CRC.pack(crc)

    def index(self, offset: int, length: int) -> AttachmentIndex:
        """The record of the summary that lists it."""
        return AttachmentIndex(
            offset=offset,
            length=length,
            create_time=self.create_time,
            log_time=self.log_time,
            data_size=self.data.size,
            name=self.name,
            media_type=self.media_type,
        )


def parse_attachment(
    head: Buffer, part: FilePart, *, needs_crc: bool = False
) -> tuple[Attachment, int]:
    """Parse an attachment record; with it comes the size of its fields, bytes.

    `head` is the beginning of its content, up to `MAX_HEAD` bytes, `part` all of it. `needs_crc`
    compares the checksum also where it is 0, which says that there is none.
    """
    try:
        log_time, create_time = _TIMES.unpack_from(head)
        name, at = _text(head, _TIMES.size)
        media_type, at = _text(head, at)
        (size,) = _SIZE.unpack_from(head, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise SegmentError("an attachment record is damaged") from error
    at += _SIZE.size
    if at + size + _CRC.size > part.size:
        raise SegmentError("an attachment record is damaged (its content runs over its end)")
    data = FilePart(part.read, part.start + at, size)
    found = Attachment(log_time, create_time, name, media_type, data)
    (crc,) = _CRC.unpack(part.read(data.start + size, _CRC.size))
    if crc or needs_crc:
        of_content = crc32(memoryview(head)[:at])
        for piece in found.pieces():
            of_content = crc32(piece, of_content)
        if of_content != crc:
            raise SegmentError(f"the checksum of the attachment {name!r} differs")
    return found, at + size + _CRC.size


def _text(head: Buffer, at: int) -> tuple[str, int]:
    """A text behind its length, and where it ends."""
    (size,) = _TEXT.unpack_from(head, at)
    at += _TEXT.size
    if at + size > len(head):
        raise struct.error("the text runs over the end")
    return str(memoryview(head)[at : at + size], "utf-8"), at + size


def reader_of(fd: int) -> Callable[[int, int], bytes]:
    """Reads a file by position, beside its other users and after they have closed it.

    It is closed when nothing refers to the function any more, which takes an offset and a length.
    """
    own = files.duplicate(fd)

    def read(offset: int, size: int) -> bytes:
        return files.pread(own, size, offset)

    weakref.finalize(read, os.close, own).atexit = False
    return read
