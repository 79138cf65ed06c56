"""Files of rows: what is left of the messages of a log that is gone.

Such a file has the columns of a table, in the order of the chunks. Its `ref` also has the
sender's sequence number, the SHA-256 of the payload, and whether bytes were left over behind
the message; of messages that had been reduced before, what was left of them then
(`reduced_codec.py`). Unlike a table it is never made again.
"""

# Where stubs for pyarrow are installed, they are incomplete for its buffers.
# mypy: disable-error-code="no-any-return, arg-type, call-overload, return-value, assignment"

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from bson.int64 import Int64

from hybridlog.columns.column_file import ColumnFile, names_of
from hybridlog.columns.fields import (
    SUMMARY_FIELDS,
    FieldShape,
    has_summaries,
    original_name,
    records_of,
    without,
)
from hybridlog.columns.layout import EMPTY, OWN_COLUMNS
from hybridlog.columns.parquet_file import ParquetFileReader
from hybridlog.columns.rows import Messages, as_table, own_columns
from hybridlog.columns.rows import Piece as TablePiece
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import Array, is_bytes, is_list, is_time, lengths_of, plain_values
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.states import State, state_of
from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifest import File, Part, hasher, rows_line
from hybridlog_storage.messages import Batch, Left

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import StoredChunk

_OWN: Final = frozenset(OWN_COLUMNS)
_LONG: Final = (pa.int64(), pa.uint32(), pa.uint64())
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
        piece = TablePiece(chunk.segment, Messages.of(chunk).take(rows), None, state=state)
        decoded = None
        if self._codec.indexed and not self._is_reduced:
            decoded = self._codec.columns(batch.buffer, batch.offset, batch.length)
            piece.errors += [(bad.rows, bad.reason) for bad in decoded.unreadable]
            if len(decoded.rows):
                columns = self._shape.columns(decoded.arrow())
                piece.fields = without(columns, decoded.rows, len(rows))
        payloads = [batch.payload(row) for row in range(len(batch))]
        more = {"sequence": pa.array(batch.sequence)}
        if self._is_reduced:
            more["reduced"] = pa.array(payloads, pa.binary())
        else:
            digests = [hashlib.sha256(payload).digest() for payload in payloads]
            surplus = np.zeros(len(rows), np.bool_)
            if decoded is not None:
                surplus[decoded.surplus] = True
            more |= {"sha256": pa.array(digests, pa.binary()), "surplus": pa.array(surplus)}
        segment = np.full(len(rows), chunk.segment, np.int32)
        own = own_columns([piece], piece.messages, segment, piece.fields, has_publish_time)
        own["pub"] = pa.array(batch.publish_time)
        ref = own["ref"]
        names = [field.name for field in ref.type]
        own["ref"] = structs({**dict(zip(names, ref.flatten(), strict=True)), **more}, len(rows))
        return as_table(own, piece.fields)


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


class LeftRows:
    """Rows of a topic in a chunk that is gone; see `hybridlog.schema.left.Part`.

    Args:
        all_columns: Its rows; a struct has all columns.
    """

    def __init__(self, all_columns: pa.StructArray) -> None:
        self._all = all_columns
        names = [field.name for field in all_columns.type if field.name not in _OWN]
        fields = [all_columns.type.field(name) for name in names]
        self._columns = structs(
            {name: all_columns.field(name) for name in names}, len(all_columns), None, fields
        )

    def errors(self, rows: NDArray[np.int64]) -> list[tuple[NDArray[np.intp], str]]:
        """Rows that did not fit their definition, by reason."""
        error = self._all.field("error").take(pa.array(rows))
        found = []
        for reason in pc.unique(error.drop_null()).to_pylist():
            is_so = pc.equal(error, reason).fill_null(fill_value=False)
            found.append((np.flatnonzero(is_so.to_numpy(zero_copy_only=False)), reason))
        return found

    def surplus(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """bool[n], True where bytes were left over behind the message."""
        return self._all.field("ref").field("surplus").to_numpy(zero_copy_only=False)[rows]

    def sha256(self, row: int) -> bytes:
        """The hash of a payload."""
        return self._all.field("ref").field("sha256")[row].as_py()

    def columns(self, rows: NDArray[np.int64]) -> pa.StructArray | None:
        """The columns of fields; None without any."""
        return self._columns.take(pa.array(rows)) if self._columns.type.num_fields else None

    def documents(self, rows: NDArray[np.int64], *, typed: bool) -> list[dict[str, object]]:
        """The fields as in index documents; `typed` to tell int64 from int32."""
        return _documents(self._columns.take(pa.array(rows)), typed=typed)

    def records(self, rows: NDArray[np.int64], summarised: Collection[str] = ()) -> pa.StructArray:
        """The fields. Long arrays are null; those at the paths of `summarised` are summaries."""
        columns = self._columns.take(pa.array(rows))
        return records_of(columns, lambda path: ".".join(path) in summarised)

    def lacking(
        self, rows: NDArray[np.int64], fields: Collection[str] | None, but: Collection[str]
    ) -> NDArray[np.bool_]:
        """bool[n], True where a wanted array is not there."""
        wanted = None if fields is None else [names_of(path) for path in fields]
        found = np.zeros(len(rows), np.bool_)
        for path, summary in _summaries_in(self._columns.take(pa.array(rows))):
            if ".".join(path) not in but and (wanted is None or _asks(wanted, path)):
                found |= summary.is_valid().to_numpy(zero_copy_only=False)
        return found


def _asks(wanted: Sequence[tuple[str, ...]], array: tuple[str, ...]) -> bool:
    """True if an array itself is among some fields, and not only its summary."""
    return any(
        path[: len(array)] == array[: len(path)]
        and not (len(path) == len(array) + 1 and path[-1] in SUMMARY_FIELDS)
        for path in wanted
    )


def messages_left(parts: Sequence[pa.StructArray]) -> tuple[Batch, NDArray[np.int64]]:
    """The rows that remain of a chunk, and their arrival numbers, in the order of arrival.

    Args:
        parts: Rows of each file; a struct has all columns.
    """

    def numbers(name: str, kind: Any, *, of_ref: bool = False) -> NDArray[Any]:
        from_parts = [part.field("ref") if of_ref else part for part in parts]
        found = [one.field(name).to_numpy(zero_copy_only=False) for one in from_parts]
        return np.concatenate(found).astype(kind)[order]

    sizes = [len(part) for part in parts]
    order = np.arange(sum(sizes))
    order = np.argsort(numbers("off", np.int64, of_ref=True), kind="stable")
    part = np.repeat(np.arange(len(parts), dtype=np.int32), sizes)[order]
    row = np.concatenate([np.arange(size) for size in sizes])[order]
    begin, length, payloads = np.zeros(len(order), np.int64), np.zeros(len(order), np.int64), [b""]
    for number, rows in enumerate(parts):
        ref = rows.field("ref")
        if ref.type.get_field_index("reduced") >= 0:
            own = np.flatnonzero(part == number)
            found = ref.field("reduced").take(pa.array(row[own]))
            length[own] = pc.binary_length(found).to_numpy()
            begin[own] = sum(map(len, payloads)) + np.cumsum(length[own]) - length[own]
            payloads += found.to_pylist()
            part[own] = -1
    place = (numbers(name, np.int64, of_ref=True) for name in ("off", "len"))
    batch = Batch(
        b"".join(payloads),
        begin,
        length,
        numbers("channel", np.int32),
        numbers("t", np.int64),
        numbers("pub", np.int64),
        numbers("sequence", np.uint32, of_ref=True),
        Left([*map(LeftRows, parts)], part, row, *place),
    )
    return batch, numbers("seq", np.int64)


def _summaries_in(
    columns: Array, above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Array]]:
    """Columns of summaries, but for those inside lists, and the paths of their arrays."""
    for field, column in zip(columns.type, columns.flatten(), strict=True):
        path = (*above, original_name(field))
        if has_summaries(field):
            yield path, column
        elif pa.types.is_struct(field.type):
            yield from _summaries_in(column, path)


def _documents(columns: Array, *, typed: bool) -> list[dict[str, Any]]:
    """Columns as index documents: arrays, or summaries of long ones, and without what is null.

    Args:
        columns: A struct array; its fields are the columns.
        typed: True if a definition fixes the width of integers.
    """
    names = [original_name(field) for field in columns.type]
    cells = [
        _cells(column, field, typed=typed)
        for field, column in zip(columns.type, columns.flatten(), strict=True)
    ]
    rows = zip(*cells, strict=True) if cells else [()] * len(columns)
    return [{n: v for n, v in zip(names, row, strict=True) if v is not None} for row in rows]


def _cells(array: Array, field: Any, *, typed: bool) -> list[Any]:
    kind, is_empty = array.type, EMPTY in (field.metadata or {})
    if has_summaries(field):
        found = array.to_pylist()
        return [None if one is None else {k: _whole(v) for k, v in one.items()} for one in found]
    if pa.types.is_struct(kind):
        there = array.is_valid().to_pylist()
        return [
            d if v else None for d, v in zip(_documents(array, typed=typed), there, strict=True)
        ]
    if is_list(kind):
        inner = field if is_empty else kind.value_field
        values = iter(_cells(array.flatten(), inner, typed=typed))
        counted = zip(lengths_of(array).tolist(), array.is_valid().to_pylist(), strict=True)
        return [[next(values) for _ in range(n)] if there else None for n, there in counted]
    if is_bytes(kind):
        return [None if n is None else {"n": Int64(n)} for n in pc.binary_length(array).to_pylist()]
    values = plain_values(array)
    if is_empty:
        return [None if there is None else {} for there in values]
    return [*map(_whole, values)] if is_time(kind) or (typed and kind in _LONG) else values


def _whole(value: Any) -> Any:
    """An integer as int64 of BSON, whatever its value."""
    return Int64(value) if isinstance(value, int) else value
