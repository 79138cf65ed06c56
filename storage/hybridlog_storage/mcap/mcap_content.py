"""Parses records of MCAP chunks, and rare records anywhere, from untrusted bytes.

A Python loop only finds the start of each message; numpy gathers the heads. Records of
other kinds are rare and become objects.

Compresses chunks that gain from it, and decompresses untrusted data.

A size claimed by a file is compared with a limit, and with the ratio of its codec, before
memory is allocated. Above `MAX_FREE` bytes, content may be `MAX_RATIO` times as large as its
compressed form; `Compressor` keeps to that, too.
"""

from __future__ import annotations

import struct
from array import array
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from threading import get_ident
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.summary import Summary
from msgspec import Struct

from hybridlog_storage.cache import RowType
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.messages import Batch, Buffer

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from numpy.typing import NDArray


MAGIC = b"\x89MCAP0\r\n"
"""First and last eight bytes of an MCAP file."""
RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the content, at the start of every record."""
HEAD = RECORD_HEAD.size

CHUNK_HEAD = struct.Struct("<BQQQQII")
"""A chunk record up to the name of its compression, whose length comes last."""
MAX_CHUNK_HEAD = CHUNK_HEAD.size + 16 + 8
"""Most bytes of a chunk record before its content."""
_MAX_NAME = 16

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
_SEARCHED = 1 << 20  # bytes searched at once for the next record

MIN_RECORDS = 1 << 16
"""Records that a chunk may hold in addition to one a compressed byte."""


class ChunkHead(NamedTuple):
    """A chunk record before its content.

    Attributes:
        length: Bytes of the record by its length field, the head included.
        first: Smallest log time, ns.
        last: Largest log time, ns.
        size: Bytes of the content, uncompressed.
        crc: CRC-32 of the content, 0 for none.
        codec: MCAP name of the compression.
        start: Bytes of the record before the compressed content.
        end: Bytes of the record by the length of that content.
    """

    opcode: int
    length: int
    first: int
    last: int
    size: int
    crc: int
    codec: str
    start: int
    end: int


def chunk_head_of(record: Buffer) -> ChunkHead | None:
    """The beginning of a chunk record; None if it is too short, or no name of a codec is there."""
    if len(record) < CHUNK_HEAD.size:
        return None
    opcode, length, first, last, size, crc, named = CHUNK_HEAD.unpack_from(record)
    at = CHUNK_HEAD.size + named
    name = bytes(record[CHUNK_HEAD.size : min(at, CHUNK_HEAD.size + _MAX_NAME)])
    if named > _MAX_NAME or at + 8 > len(record) or not name.isascii():
        return None
    start = at + 8
    end = start + int.from_bytes(record[at:start], "little")
    length += RECORD_HEAD.size
    return ChunkHead(opcode, length, first, last, size, crc, name.decode(), start, end)


_Defines = records.Schema | records.Channel


class Definition(NamedTuple):
    """A schema or channel, and the first row of the batch that it applies to, 0 to n."""

    row: int
    record: _Defines


class Damage(Struct, frozen=True):
    """A place that could not be read.

    Attributes:
        offset: Byte where it starts, in the file.
        length: Bytes that could not be read; 0 if they lie inside what was read.
        reason: Description of the damage.
        messages: Number of messages in it, None if unknown.
    """

    offset: int
    length: int
    reason: str
    messages: int | None = None


class ChunkContent(NamedTuple):
    """The records of one uncompressed chunk, or of a run outside of chunks.

    Attributes:
        batch: Its messages, in order; `channel` is the MCAP channel id, payload offsets
            are into the buffer that was parsed.
        definitions: Schemas and channels in order, each with the first row that it applies to.
        invalid: int64, offset in the buffer of each omitted message record: too short, or
            with a log time beyond 2^63 - 1 ns.
        unreadable: The problem of each definition that could not be read.
        end: Byte of the buffer behind the last record.
    """

    batch: Batch
    definitions: list[Definition]
    invalid: NDArray[np.int64]
    unreadable: list[str]
    end: int


def parse_content(buffer: Buffer, *, loose: bool = False, most: int = 1 << 62) -> ChunkContent:
    """Read the records of an uncompressed chunk. Other kinds are skipped, as MCAP requires.

    `loose` stops, without error, at the first record that is neither a whole message nor a whole
    definition. More than `most` records, one that runs over the end, or one of the invalid kind 0
    raise a `SegmentError` that names the offset.
    """
    found, definitions, unreadable = array("q"), list[Definition](), list[str]()
    unpack, add, size, at, count = RECORD_HEAD.unpack_from, found.append, len(buffer), 0, 0
    while at + HEAD <= size and count <= most:  # over single messages
        opcode, length = unpack(buffer, at)
        end = at + HEAD + length
        if end > size:
            break
        if opcode == _MESSAGE:
            add(at)
        elif not opcode or (loose and opcode not in _DEFINITIONS):
            break
        elif opcode in _DEFINITIONS:
            try:
                record, _ = read_record(opcode, memoryview(buffer)[at + HEAD : end])
            except SegmentError as error:
                unreadable.append(str(error))
            else:
                definitions.append(Definition(len(found), cast("_Defines", record)))
        at = end
        count += 1
    if count > most:
        raise SegmentError("it holds too many records for its size")
    if not loose and at != size:
        problem = f"runs over the end at {size}" if buffer[at] else "has no kind"
        raise SegmentError(f"the record at byte {at} of its content {problem}")
    starts = np.frombuffer(found, np.int64)
    batch, good = _batch(buffer, starts)
    if not good.all():  # rows count valid messages only
        before = np.concatenate(([0], np.cumsum(good)))
        definitions = [Definition(int(before[one.row]), one.record) for one in definitions]
    return ChunkContent(batch, definitions, starts[~good], unreadable, at)


def _batch(buffer: Buffer, starts: NDArray[np.int64]) -> tuple[Batch, NDArray[np.bool_]]:
    """The messages at `starts`, and a mask of the valid ones.

    For a publish time beyond 2^63 - 1 ns stands the log time.
    """
    # With a last record shorter than a head, the gather below would read over the end.
    good = starts + _PAYLOAD <= len(buffer)
    chosen = starts[good]
    heads = heads_at(buffer, chosen)
    right = (heads["length"] >= _FIELDS) & (heads["log_time"] < _TIME_LIMIT)
    if not right.all():
        heads, chosen = heads[right], chosen[right]
        good[good] = right
    late = heads["publish_time"] >= _TIME_LIMIT
    if late.any():
        heads["publish_time"] = np.where(late, heads["log_time"], heads["publish_time"])
    return batch_of(buffer, chosen, heads), good


def heads_at(buffer: Buffer, starts: NDArray[np.int64]) -> NDArray[np.void]:
    """The heads, `MESSAGE_HEAD`[n], of records that start at int64[n]; none runs over the end."""
    if not len(starts):
        return np.empty(0, MESSAGE_HEAD)
    # A view of a head at every byte of the buffer; only the needed ones are copied.
    places = (len(buffer) - _PAYLOAD + 1,)
    every: NDArray[np.void] = np.ndarray(places, MESSAGE_HEAD, buffer=buffer, strides=(1,))
    return every[starts]


def batch_of(buffer: Buffer, starts: NDArray[np.int64], heads: NDArray[np.void]) -> Batch:
    """The messages of a chunk with their heads, from `heads_at`."""
    return Batch(
        buffer,
        starts + _PAYLOAD,
        heads["length"].astype(np.int64) - _FIELDS,
        heads["channel"].astype(np.int32),
        heads["log_time"].astype(np.int64),
        heads["publish_time"].astype(np.int64),
        heads["sequence"].astype(np.uint32),
    )


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


_READERS: dict[int, Callable[[ReadDataStream], records.McapRecord]] = {
    Opcode.HEADER: records.Header.read,
    Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read,
    Opcode.STATISTICS: records.Statistics.read,
    Opcode.METADATA: records.Metadata.read,
    Opcode.METADATA_INDEX: records.MetadataIndex.read,
}


def read_record(opcode: int, content: Buffer) -> tuple[records.McapRecord | None, int]:
    """Parse one record that is neither a message nor a chunk nor an attachment.

    With it comes the size of its fields, bytes; those behind them are ignored. None and 0 for
    another opcode.
    """
    reader = _READERS.get(opcode)
    if reader is None:
        return None, 0
    try:
        stream = _Fields(content)
        record = reader(stream)
    except (SegmentError, McapError, struct.error, UnicodeDecodeError) as error:
        name = Opcode(opcode).name.replace("_", " ").lower()  # every parsed kind has a name
        raise SegmentError(f"a {name} record is damaged ({error or 'too short'})") from error
    return record, stream.count


LAST_KNOWN = max(Opcode)
"""Largest opcode that MCAP defines."""

_FOOTER = struct.Struct("<BQQQI")  # head, start of the summary and of its offsets, checksum
TAIL = _FOOTER.size + len(MAGIC)
"""Bytes of the footer and the magic behind it."""


def footer_of(tail: Buffer) -> tuple[int, int, int] | None:
    """Starts of the summary and of its offsets, and its checksum; None without a footer."""
    opcode, length, *found = _FOOTER.unpack_from(tail)
    is_footer = (opcode, length, bytes(tail[_FOOTER.size :])) == (Opcode.FOOTER, 20, MAGIC)
    return (found[0], found[1], found[2]) if is_footer else None


def parse_summary(data: Buffer, *, skipped: int = 0) -> tuple[Summary, dict[int, Buffer]]:
    """Parse the records between the data of a file and its footer, but for the kind `skipped`.

    With the summary comes the content of the last record of each kind that MCAP does not know.
    """
    view, at = memoryview(data), 0
    found = Summary()
    others: dict[int, Buffer] = {}
    lists: dict[type, list[Any]] = {
        records.ChunkIndex: found.chunk_indexes,
        records.AttachmentIndex: found.attachment_indexes,
        records.MetadataIndex: found.metadata_indexes,
    }
    while at < len(view):
        if at + RECORD_HEAD.size > len(view):
            raise SegmentError("it ends in the middle of a record")
        opcode, length = RECORD_HEAD.unpack_from(view, at)
        at += RECORD_HEAD.size
        if length > len(view) - at:
            raise SegmentError("it ends in the middle of a record")
        body = view[at : at + length]
        at += length
        if opcode > LAST_KNOWN:
            others[opcode] = body
        record, _ = read_record(opcode, body) if opcode != skipped else (None, 0)
        if isinstance(record, records.Schema):
            found.schemas[record.id] = record
        elif isinstance(record, records.Channel):
            found.channels[record.id] = record
        elif isinstance(record, records.Statistics):
            found.statistics = record
        elif type(record) in lists:
            lists[type(record)].append(record)
    return found, others


class RecordFile:
    """A file of records that is read forward; `read` takes an offset and a length.

    `window` bytes are read at once around the heads of records.
    """

    def __init__(self, read: Callable[[int, int], memoryview], size: int, window: int) -> None:
        self.size = size
        self._read = read
        self._ahead = window
        self.forget()

    def forget(self) -> None:
        """Read again what was read before: the file may have changed."""
        self._window = memoryview(b"")
        self._start = 0  # of the window

    def at(self, offset: int, length: int, *, move: bool = False) -> memoryview:
        """Bytes of the file, fewer at its end; `move` reads more than that, for what follows."""
        length = min(length, self.size - offset)
        if length <= 0:
            return memoryview(b"")
        begin = offset - self._start
        if begin >= 0 and begin + length <= len(self._window):
            return self._window[begin : begin + length]
        if not move:
            return self._read(offset, length)
        wanted = max(length, min(self._ahead, self.size - offset))
        self._start, self._window = offset, self._read(offset, wanted)
        if len(self._window) < wanted:  # the file was cut meanwhile
            self.size = offset + len(self._window)
        return self._window[:length]

    def rest(self, offset: int) -> memoryview:
        """The bytes that are in memory, from one on."""
        return self._window[offset - self._start :]

    def search(
        self, start: int, end: int, kinds: Collection[int], proves: Callable[[int], bool]
    ) -> int | None:
        """The first byte of a range where a record of certain kinds proves itself."""
        wanted = np.zeros(256, np.bool_)
        wanted[list(kinds)] = True
        for block in range(start, end - HEAD + 1, _SEARCHED):
            raw = self._read(block, min(_SEARCHED + HEAD - 1, end - block))
            if len(raw) < HEAD:
                return None
            data = np.frombuffer(raw, np.uint8)
            # No length reaches 2^40, which excludes nearly all positions.
            sieve = wanted[data[: 1 - HEAD]]
            sieve &= (data[6:-2] == 0) & (data[7:-1] == 0) & (data[8:] == 0)
            for place in np.flatnonzero(sieve).tolist():
                if proves(block + place):
                    return block + int(place)
        return None


MAX_UNCOMPRESSED = 1 << 30
"""Most bytes of a chunk's content."""
MAX_FREE = 256 << 20
"""Uncompressed size up to which any ratio is believed, bytes."""
MAX_RATIO = 100
"""Largest believed ratio above that."""

# Maximum ratio of each codec: an RLE block of zstd spends 4 bytes on 128 KiB, a run of
# lz4 one byte on 255. A larger claim is false.
_MAX_RATIO = {"zstd": 1 << 15, "lz4": 255}
_RATIO_SLACK = 1 << 17

_PIECE = 1 << 20  # bytes decompressed at once of a frame that is cut
_SAMPLE = 8192  # bytes of one sample of a chunk
_SAMPLES = 6
_MAX_SHARE = 0.97  # of its size that a compressed chunk may have
# In a hurry: compressing to this share or less is faster than writing uncompressed,
_WORTH_IT = 0.2
_FAST = 1  # at this level of either codec.


def decompress(compression: str, data: Buffer, uncompressed_size: int) -> bytes | memoryview:
    """Decompress the content of a chunk; without a codec, a view of `data`.

    `compression` is its name in MCAP: `zstd`, `lz4`, or empty for none. `SegmentError` if the
    output has not `uncompressed_size`, or that is more than what the data can hold.
    """
    size = uncompressed_size
    if compression == "":
        if len(data) != size:
            raise SegmentError(f"it holds {len(data)} bytes, not {size} as it claims")
        return memoryview(data)
    if compression not in _MAX_RATIO:
        raise SegmentError(
            f"its compression {compression[:32]!r} is not known; rewrite the file with zstd"
        )
    most = min(len(data) * _MAX_RATIO[compression] + _RATIO_SLACK, MAX_UNCOMPRESSED)
    if size > most or is_implausible(size, len(data)):
        raise SegmentError(
            f"it claims {size} bytes uncompressed, which is not believed of its {len(data)} "
            f"bytes of {compression}"
        )
    try:
        found = _unpacked(compression, data, size)
    except MemoryError as error:
        raise SegmentError(f"there is no memory for its {size} bytes") from error
    except (zstandard.ZstdError, RuntimeError) as error:
        raise SegmentError(f"its {compression} data is damaged ({error})") from error
    if len(found) != size:
        raise SegmentError(f"it does not decompress to {size} bytes as it claims")
    return found


def beginning(compression: str, data: Buffer, size: int) -> bytes:
    """The first bytes of a content of `size` bytes, as far as a truncated frame holds them."""
    if not compression:
        return bytes(data[:size])
    found = bytearray()
    with suppress(zstandard.ZstdError, RuntimeError):
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
        reader = zstandard.ZstdDecompressor().stream_reader(data)
        while piece := reader.read(min(size - len(found), _PIECE)):
            found += piece
    return bytes(found)


def is_implausible(uncompressed_size: int, size: int) -> bool:
    """True if this much content of so few compressed bytes is not believed."""
    return uncompressed_size > MAX_FREE and uncompressed_size > size * MAX_RATIO


def _unpacked(compression: str, data: Buffer, size: int) -> bytes:
    """The content of one frame; if that has another size, some of it."""
    if compression == "zstd":
        if zstandard.frame_content_size(data) not in {-1, size}:
            return b"" if size else b"?"
        most = max(size, 1)
        return _decompressor(get_ident()).decompress(data, most, allow_extra_data=False)
    frame = lz4.frame.LZ4FrameDecompressor()
    found: bytes = frame.decompress(data, max_length=size + 1)
    if len(found) == size and (not frame.eof or frame.unused_data):
        raise RuntimeError("it does not end where it should")
    return found


@lru_cache(maxsize=64)
def _decompressor(_thread: int) -> zstandard.ZstdDecompressor:
    return zstandard.ZstdDecompressor()  # which threads must not share


@lru_cache(maxsize=64)
def _compressor(_thread: int, level: int, *, check: bool) -> zstandard.ZstdCompressor:
    return zstandard.ZstdCompressor(level=level, write_checksum=check)


def checked_frame(data: Buffer) -> bytes:
    """Data as one zstd frame with a checksum of its content."""
    return _compressor(get_ident(), 1, check=True).compress(data)


class Compressor:
    """Compresses chunks, except those that would not shrink.

    Compressed images and the like cost much time and gain nothing. So a few samples of a large
    chunk are tried first, and a chunk that gains less than 3 % is stored uncompressed. Thread safe;
    compression releases the interpreter lock.

    The codec `none` stores everything as it is. `level` is zstd's.
    """

    def __init__(self, name: Literal["zstd", "lz4", "none"] = "zstd", level: int = 1) -> None:
        self.name = name
        self.level = level

    def compress(self, data: Buffer, *, hurried: bool = False) -> tuple[str, Buffer]:
        """Compress a chunk if it gains enough: name of the codec and bytes, else empty and `data`.

        `hurried` compresses only if samples shrink to a fifth or less, and at level 1 at most.
        """
        bound = _WORTH_IT if hurried else _MAX_SHARE
        level = min(self.level, _FAST) if hurried else self.level
        if self.name == "none" or len(data) == 0 or not self._promising(data, level, bound):
            return "", data
        packed = self._pack(data, level)
        if len(packed) > len(data) * _MAX_SHARE or is_implausible(len(data), len(packed)):
            return "", data
        return self.name, packed

    def _promising(self, data: Buffer, level: int, bound: float) -> bool:
        """True if samples shrink to a share, or the data is hardly larger than the samples.

        They are compressed as the chunk would be: level 1 finds nothing in a noisy picture
        of which level 3 saves a third.
        """
        if len(data) < 4 * _SAMPLE * _SAMPLES:
            return True
        view = memoryview(data)
        step = (len(data) - _SAMPLE) // (_SAMPLES - 1)
        sample = b"".join(view[i * step : i * step + _SAMPLE] for i in range(_SAMPLES))
        return len(self._pack(sample, level)) <= len(sample) * bound

    def _pack(self, data: Buffer, level: int) -> bytes:
        if self.name == "lz4":
            packed: bytes = lz4.frame.compress(data, compression_level=level, store_size=True)
            return packed
        return _compressor(get_ident(), level, check=False).compress(data)
