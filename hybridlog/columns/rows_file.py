"""Files of rows: what is left of the messages of a log that is gone.

Such a file has the columns of a table, in the order of the chunks. Its `ref` also has the
sender's sequence number, and `left`: size, hash and index document of each message
(`reduced_codec.py`). Unlike a table it is never made again.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.column_file import ColumnFile
from hybridlog.columns.fields import FieldShape, without
from hybridlog.columns.layout import OWN_COLUMNS
from hybridlog.columns.parquet_file import ParquetFileReader
from hybridlog.columns.rows import Messages, own_columns
from hybridlog.columns.rows import Piece as TablePiece
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.reduced_codec import expired_payloads
from hybridlog.schema.states import State, state_of
from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifest import File, Part, hasher, rows_line
from hybridlog_storage.messages import Batch
from hybridlog_storage.segments.chunk import ExpiredMessages

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import StoredChunk

_OWN: Final = frozenset(OWN_COLUMNS)
RESTORE: Final = " Restore it from a copy; `hybridlog verify` shows what is affected."


class RowColumns:
    """Turns messages of one type into rows of what is left of them."""

    def __init__(self, channel: Channel) -> None:
        self._codec = codec_for(channel)
        self._is_reduced = state_of(channel.message_encoding) is State.REDUCED
        self._shape = FieldShape()

    def table(
        self, chunk: StoredChunk, rows: NDArray[np.intp], has_publish_time: Mapping[int, bool]
    ) -> pa.Table:
        """Rows of messages, in the order of the chunk.

        Args:
            chunk: The chunk that holds them.
            rows: Their rows in it, ascending; one at least.
            has_publish_time: Whether messages of a channel have a publish time, by channel id.
        """
        batch = chunk.batch.take(rows)
        state = State.REDUCED if self._is_reduced else State.EXPIRED
        piece = TablePiece(chunk.segment, Messages.of(chunk, 0).take(rows), None, state=state)
        decoded = None
        if self._codec.indexed and not self._is_reduced:
            decoded = self._codec.columns(batch.buffer, batch.offset, batch.length)
            piece.errors += [(bad.rows, bad.reason) for bad in decoded.unreadable]
            if len(decoded.rows):
                columns = self._shape.columns(decoded.arrow())
                piece.fields = without(columns, decoded.rows, len(rows))
        if self._is_reduced:
            left = [bytes(batch.payload(row)) for row in range(len(batch))]
        else:
            left = expired_payloads(batch, decoded)
        segment = np.full(len(rows), chunk.segment, np.int32)
        own = own_columns([piece], piece.messages, segment, piece.fields, has_publish_time)
        own["pub"] = pa.array(batch.publish_time)
        ref = own["ref"]
        more = {"sequence": pa.array(batch.sequence), "left": pa.array(left, pa.binary())}
        names = [field.name for field in ref.type]
        own["ref"] = structs({**dict(zip(names, ref.flatten(), strict=True)), **more}, len(rows))
        schema = [pa.field(name, column.type) for name, column in own.items()]
        arrays = [*own.values()]
        if piece.fields is not None:
            schema += list(piece.fields.type)
            arrays += piece.fields.flatten()
        return pa.Table.from_arrays(arrays, schema=pa.schema(schema))


class Place(NamedTuple):
    """Rows of a chunk in a file.

    Attributes:
        group: Row group.
        begin: Its first row in the group.
        rows: Number of rows.
    """

    group: int
    begin: int
    rows: int


class RowsFile(ColumnFile):
    """One file of rows: messages of a topic. Thread safe.

    Attributes:
        listed: Its line of the manifest.
        topic: Its topic.
        places: Rows of each chunk, by number.

    Raises:
        StoreError: It is missing, damaged, or another file than the listed one.
    """

    def __init__(self, folder: Path, listed: File, cache: Cache | None = None) -> None:
        self.listed = listed
        self._cache = cache or Cache()
        path = folder / listed.name
        try:
            super().__init__(path)
        except FileNotFoundError as error:
            raise StoreError(f"The file of rows {path} is missing.{RESTORE}") from error
        rows = sum(part.messages for part in listed.parts.values())
        if (self.size_bytes, self.about.rows) != (listed.bytes, rows):
            raise self._other()
        try:
            ((self.topic, _),) = self.about.recordings[0].topics.items()
            self.places = self._read_places(self.about.of_rows["chunks"])
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise StoreError(f"The description in {path} is invalid: {error!r}.") from error

    def check(self) -> str:
        """As of `ParquetFileReader`; it is the file that the manifest lists."""
        digest = super().check()
        if digest != self.listed.digest:
            raise self._other()
        return digest

    def _other(self) -> StoreError:
        return StoreError(
            f"The file of rows {self.path} is not the one that the manifest lists.{RESTORE}"
        )

    def _read_places(self, chunks: Any) -> dict[int, Place]:
        found: dict[int, Place] = {}
        if len(chunks) != self.groups:
            raise ValueError("its row groups and its chunks differ")
        for group, inside in enumerate(chunks):
            at = 0
            for chunk, rows in inside:
                found[int(chunk)] = Place(group, at, int(rows))
                at += int(rows)
            if at != self.about.bounds[group][0]:
                raise ValueError("its row groups and its chunks differ")
        return found

    def rows(self, chunk: int) -> pa.StructArray:
        """The rows of a chunk; a struct has all columns.

        Raises:
            StoreError: They are damaged.
        """
        place = self.places[chunk]
        return self._group(place).slice(place.begin, place.rows)

    def _group(self, place: Place) -> pa.StructArray:
        return self._cache.made(
            "column",
            self.number,
            place.group,
            make=lambda: self.read(place.group, range(len(self.leaves))).to_struct_array(),
            size_of=lambda one: int(one.nbytes),
        ).combine_chunks()


def lines_of(folder: Path, log: File, names: Iterable[str]) -> list[File]:
    """Lines of a manifest for files of rows that no manifest lists.

    Args:
        folder: Their folder.
        log: The line of their log.
        names: Their names, the first one first.

    Raises:
        StoreError: One cannot be read.
    """
    found = []
    for name in names:
        about = ParquetFileReader(folder / name).about
        data = (folder / name).read_bytes()
        parts = {int(n): Part(*part) for n, part in about.of_rows["parts"].items()}
        found.append(rows_line(log, name, len(data), hasher(data).hexdigest(), parts))
    return found


class Rows(NamedTuple):
    """The rows of a topic in an expired chunk, as table writers and SQL take them.

    Attributes:
        fields: Columns of fields, a struct each; None without any.
        errors: Unreadable rows, each with the reason.
    """

    fields: Any
    errors: list[tuple[NDArray[np.intp], str]]


def rows_of(columns: pa.StructArray) -> Rows:
    """The fields and errors of rows of a file."""
    present = [field for field in columns.type if field.name not in _OWN]
    fields = None
    if present:
        arrays = [columns.field(field.name) for field in present]
        fields = pa.StructArray.from_arrays(arrays, fields=present)
    errors = []
    error = columns.field("error")
    for reason in pc.unique(error.drop_null()).to_pylist():
        found = pc.equal(error, reason).fill_null(fill_value=False)
        errors.append((np.flatnonzero(found.to_numpy(zero_copy_only=False)), reason))
    return Rows(fields, errors)


def expired_messages(parts: Sequence[pa.StructArray]) -> ExpiredMessages:
    """What is left of the messages of a chunk, in its order."""
    batches = [_batch(part) for part in parts]
    offset = np.concatenate([batch.places[0] for batch in batches])
    order = np.argsort(offset, kind="stable")
    row = np.empty(len(order), np.intp)
    row[order] = np.arange(len(order))
    bounds = np.cumsum([0, *map(len, batches)]).tolist()
    fields = [
        (row[begin:end], part) for part, begin, end in zip(parts, bounds, bounds[1:], strict=False)
    ]
    starts = np.cumsum([0, *(len(batch.buffer) for batch in batches)]).tolist()
    batch = Batch(
        b"".join(batch.buffer for batch in batches),
        np.concatenate([b.offset + at for b, at in zip(batches, starts, strict=False)])[order],
        np.concatenate([b.length for b in batches])[order],
        np.concatenate([b.channel for b in batches])[order],
        np.concatenate([b.log_time for b in batches])[order],
        np.concatenate([b.publish_time for b in batches])[order],
        np.concatenate([b.sequence for b in batches])[order],
        np.concatenate([np.stack(b.places, axis=1) for b in batches])[order],
    )
    return ExpiredMessages(batch, np.concatenate([*map(_arrivals, parts)])[order], fields)


def _arrivals(part: pa.StructArray) -> NDArray[np.int64]:
    return part.field("seq").to_numpy(zero_copy_only=False).astype(np.int64)


def _batch(part: pa.StructArray) -> Batch:
    def numbers(array: Any, kind: Any) -> NDArray[Any]:
        return array.to_numpy(zero_copy_only=False).astype(kind)

    ref = part.field("ref")
    data, bounds = _bytes_of(ref.field("left"))
    place = [numbers(ref.field(name), np.int64) for name in ("off", "len")]
    return Batch(
        data.tobytes(),
        bounds[:-1],
        np.diff(bounds),
        numbers(part.field("channel"), np.int32),
        numbers(part.field("t"), np.int64),
        numbers(part.field("pub"), np.int64),
        numbers(ref.field("sequence"), np.uint32),
        np.stack(place, axis=1),
    )


def _bytes_of(array: pa.Array[Any]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Binary values without a copy: all bytes, and bounds of each row, from 0 on.

    Raises:
        ValueError: Some are null.
    """
    if not pa.types.is_binary(array.type) or array.null_count:
        raise ValueError("a column of bytes has nulls, or another type")
    _, places, data = array.buffers()
    if places is None or not len(array):
        return np.empty(0, np.uint8), np.zeros(len(array) + 1, np.int64)
    bounds = np.frombuffer(places, np.int32, len(array) + 1, array.offset * 4).astype(np.int64)
    content = np.frombuffer(data, np.uint8) if data is not None else np.empty(0, np.uint8)
    return content[int(bounds[0]) : int(bounds[-1])], bounds - bounds[0]
