"""Writes tables: Parquet, Arrow IPC, CSV, and numpy's .npz.

Tables arrive in pieces, and these formats fix their columns before the first row. Where no
definition tells them, all pieces go to a temporary file first, so that a column may appear late,
be empty at first, or change its type. A missing column is null.

In an .npz file, all rows of which are held in memory, is one array for each column, readable
without pickle:

| column | arrays |
|---|---|
| numbers, booleans | `name` |
| times, durations | `name`, datetime64[ns] (UTC) or timedelta64[ns] |
| strings up to 256 characters | `name`, fixed-width Unicode |
| longer strings, or with NUL, and binary values | `name.values` (uint8), `name.offsets` |
| lists of fixed size | `name`, one row for each message |
| lists | `name.values`, `name.offsets`: row i is `values[offsets[i]:offsets[i + 1]]` |
| structures | `name.field` |

If a column has nulls, `name.valid` marks the rows with a value; the others are NaN, NaT,
zero or empty.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from tempfile import SpooledTemporaryFile
from typing import IO, TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from hybridlog.columns.column_file import leaves
from hybridlog.formats.jsonl import (
    PIECE_BYTES,
    base64_column,
    json_column,
    json_pieces,
    rows_within,
)
from hybridlog.formats.writing import Answer, Sink, Target
from hybridlog.schema.arrow_types import (
    bounds_of,
    column_of,
    common_schema,
    is_bytes,
    is_list,
    is_numeric,
    is_text,
    is_time,
    numpy_type,
)
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

HELD_BYTES = 32 << 20
"""Limit of the pieces held in memory to learn the columns, bytes; more go to a file."""
GROUP_BYTES = 32 << 20
GROUP_ROWS = 1 << 17
_LONG_ROW = 1 << 20
_LONGEST_STRING = 256
_STRINGS_AT_ONCE = 1 << 14

Arrays: TypeAlias = "Iterator[tuple[str, NDArray[Any]]]"
"""Arrays by name."""


def write_parquet(answer: Answer, target: Target) -> None:
    """Write Parquet, row groups of zstd.

    Columns of floats have no statistics: readers skip row groups by them, and some then
    lose rows where there are NaN among the values.
    """
    _write(answer, target, "parquet", _open_parquet)


def write_arrow(answer: Answer, target: Target) -> None:
    """Write an Arrow IPC file, also known as Feather version 2, with zstd buffers."""
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    _write(
        answer,
        target,
        "arrow",
        lambda sink, table: pa.ipc.new_file(sink, table.schema, options=options),
    )


def write_csv(answer: Answer, target: Target) -> None:
    """Write CSV with a header.

    | value | cell |
    |---|---|
    | null or missing | nothing |
    | empty string | `""` |
    | empty array | `[]` |
    | NaN | `nan` |
    | false | `false` |

    Durations are integer nanoseconds, binary values base64. Lists and structures are JSON
    text, as in JSON lines.
    """
    _write(answer, target, "csv", _CsvFile)


def _write(
    answer: Answer,
    target: Target,
    form: str,
    open_file: Callable[[Sink, pa.Table], Any],
) -> None:
    """Write tables."""
    with Sink(target) as sink:
        try:
            file: Any = None
            for table in groups(answer, form):
                file = file or open_file(sink, table)
                file.write_table(table)
                if answer.is_live:
                    sink.flush()
            file.close()
        except pa.ArrowException as error:
            raise UsageError(
                f"the table cannot be written to {sink.name} as {form}: {error}"
            ) from error


def groups(answer: Answer, form: str) -> Iterator[pa.Table]:
    """The rows in tables of the same columns, each of many rows; at least one, possibly empty."""
    with SpooledTemporaryFile(HELD_BYTES) as spool:
        if answer.is_fixed or answer.is_live:
            tables = iter(answer.tables)
            first = next(tables, pa.table({}))
            schema, tables = first.schema, chain((first,), tables)
        else:
            schema = common_schema(_spooled(answer.tables, spool))
            tables = _unspooled(spool)
        # `empty_table` knows no lists of extension types
        none = pa.Table.from_arrays([pa.nulls(0, one.type) for one in schema], schema=schema)
        pieces, rows, size, given = [none], 0, 0, 0
        for table in tables:
            if late := [name for name in table.column_names if name not in schema.names]:
                raise UsageError(
                    f"column {late[0]!r} first appears after {given + rows} rows, and a {form} "
                    "file fixes its columns before; leave it out with --fields, or write "
                    "--format jsonl"
                )
            try:
                columns = [column_of(table, one) for one in schema]
            except pa.ArrowException as error:
                raise UsageError(f"a column has another type than at first: {error}") from error
            pieces.append(pa.Table.from_arrays(columns, schema=schema))
            rows, size = rows + table.num_rows, size + table.nbytes
            if answer.is_live or size >= GROUP_BYTES or rows >= GROUP_ROWS:
                yield pa.concat_tables(pieces)
                pieces, rows, size, given = [none], 0, 0, given + rows
        if rows or not given:
            yield pa.concat_tables(pieces)


def _spooled(tables: Iterable[pa.Table], spool: Any) -> Iterator[pa.Table]:
    """Tables, each written to a temporary file."""
    for table in tables:
        yield table
        with pa.ipc.new_stream(spool, table.schema) as stream:
            stream.write_table(table)


def _unspooled(spool: Any) -> Iterator[pa.Table]:
    """The tables in a temporary file."""
    end = spool.tell()
    spool.seek(0)
    while spool.tell() < end:
        yield pa.ipc.open_stream(spool).read_all()


def _open_parquet(sink: Sink, table: pa.Table) -> Any:
    kinds = {leaf.path: leaf.kind for leaf in leaves(table.schema)}
    # Arrow holds the dictionary of a long array, and many copies of a long text.
    has_long_rows = table.nbytes > _LONG_ROW * max(table.num_rows, 1)
    return pa.parquet.ParquetWriter(
        sink,
        table.schema,
        compression="zstd",
        use_dictionary=[] if has_long_rows else list(kinds),
        write_statistics=[
            path
            for path, kind in kinds.items()
            if not pa.types.is_floating(kind)
            and not (has_long_rows and not pa.types.is_primitive(kind))
        ],
    )


class _CsvFile:
    """Rows as text, long ones cell by cell and in pieces."""

    def __init__(self, sink: Sink, table: pa.Table) -> None:
        self._sink = sink
        has_columns = bool(table.column_names)
        schema = _as_text(table.slice(0, 0)).schema
        self._writer = pa.csv.CSVWriter(sink, schema) if has_columns else None

    def write_table(self, table: pa.Table) -> None:
        """Write rows."""
        if self._writer is None:
            return
        rows = rows_within(table.nbytes, table.num_rows)
        for begin in range(0, table.num_rows, rows):
            part = table.slice(begin, rows)
            if part.nbytes <= PIECE_BYTES * rows:
                self._writer.write_table(_as_text(part))
                continue
            for row in range(part.num_rows):
                for piece in _row_pieces(part.slice(row, 1)):
                    self._sink.write(piece)

    def close(self) -> None:
        """End the file."""
        if self._writer is not None:
            self._writer.close()


def _row_pieces(row: pa.Table) -> Iterator[bytes]:
    """The text of one row in pieces."""
    for index, column in enumerate(row.columns):
        yield b"," if index else b""
        array = column.combine_chunks()
        if array.null_count or not (pa.types.is_nested(column.type) or is_bytes(column.type)):
            cell = io.BytesIO()
            pa.csv.write_csv(
                _as_text(row.select([index])), cell, pa.csv.WriteOptions(include_header=False)
            )
            yield cell.getvalue()[:-1]
        elif pa.types.is_nested(column.type):
            yield b'"'
            for piece in json_pieces(array):
                yield piece.replace('"', '""').encode("utf-8", "backslashreplace")
            yield b'"'
        else:
            yield from (piece.encode() for piece in json_pieces(array))
    yield b"\n"


def _as_text(table: pa.Table) -> pa.Table:
    """The table with columns that a CSV file can have."""
    columns = [
        pa.chunked_array(map(_text, column.chunks), _text(pa.nulls(0, column.type)).type)
        for column in table.columns
    ]
    return pa.Table.from_arrays(columns, table.column_names)


def _text(array: pa.Array) -> pa.Array:
    kind = array.type
    if kind == pa.json_():
        return array.storage
    if pa.types.is_null(kind):
        return array.cast(pa.string())
    if pa.types.is_dictionary(kind):
        return array.dictionary_decode()
    if is_bytes(kind):
        return base64_column(array)
    if pa.types.is_nested(kind):
        return pc.if_else(array.is_valid(), json_column(array), pa.scalar(None, pa.string()))
    return array


def write_npz(answer: Answer, target: Target) -> None:
    """Write one .npz file."""
    table = pa.concat_tables(groups(answer, "npz"))
    with Sink(target) as sink, zipfile.ZipFile(cast("IO[bytes]", sink), "w") as archive:
        try:
            for field, column in zip(table.schema, table.columns, strict=True):
                for name, array in _arrays(_array_name(field.name), column):
                    _add(archive, name, array)
        except BaseException:
            # Otherwise the archive would be finished, and a stream would look complete.
            sink.abort()
            raise


def _add(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    while f"{name}.npy" in archive.NameToInfo:
        name += "_"
    # With a fixed date, equal content makes equal files.
    entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
    with archive.open(entry, "w", force_zip64=True) as file:
        np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)


def _arrays(name: str, column: pa.ChunkedArray) -> Arrays:
    """The arrays of a column."""
    kind = column.type
    if isinstance(kind, pa.BaseExtensionType):
        chunks = [one.storage for one in column.chunks]
        yield from _arrays(name, pa.chunked_array(chunks, kind.storage_type))
        return
    if pa.types.is_dictionary(kind):
        yield from _arrays(name, column.cast(kind.value_type))
        return
    if is_numeric(kind):
        yield name, _numbers(column)
    elif is_time(kind):
        is_stamp = pa.types.is_timestamp(kind)
        ticks = column.cast(pa.timestamp("ns") if is_stamp else pa.duration("ns")).cast(pa.int64())
        values = ticks.fill_null(int(np.iinfo(np.int64).min)).to_numpy().astype(np.int64)
        yield name, values.view("datetime64[ns]" if is_stamp else "timedelta64[ns]")
    elif is_text(kind) or is_bytes(kind):
        yield from _texts(name, column)
    elif pa.types.is_fixed_size_list(kind) and is_numeric(kind.value_type):
        # A null row has as many elements, which are null.
        rows = [pc.list_flatten(one.fill_null([None] * kind.list_size)) for one in column.chunks]
        items = _numbers(pa.chunked_array(rows, kind.value_type))
        yield name, items.reshape(len(column), kind.list_size)
    elif is_list(kind):
        yield from _arrays(f"{name}.values", pc.list_flatten(column))
        yield f"{name}.offsets", bounds_of(column)
    elif pa.types.is_struct(kind):
        for field, member in zip(kind, column.flatten(), strict=True):
            yield from _arrays(f"{name}.{_array_name(field.name)}", member)
    elif not pa.types.is_null(kind):  # elements of lists that are all empty
        raise UsageError(
            f"column {name!r} is {kind}, which numpy does not have; leave it out with --fields"
        )
    if column.null_count and not pa.types.is_null(kind):
        yield f"{name}.valid", column.is_valid().to_numpy()


def _texts(name: str, column: pa.ChunkedArray) -> Arrays:
    """Strings of a fixed width; or bytes and their ends."""
    if is_text(column.type):
        longest = max(pc.max(pc.utf8_length(column)).as_py() or 0, 1)
        has_nul = pc.any(pc.match_substring(column, "\0")).as_py()
        if longest <= _LONGEST_STRING and not has_nul:
            words = np.empty(len(column), f"<U{longest}")
            for at in range(0, len(column), _STRINGS_AT_ONCE):
                part = column.slice(at, _STRINGS_AT_ONCE).fill_null("").to_pylist()
                words[at : at + len(part)] = part
            yield name, words
            return
    binary = column.cast(pa.large_binary())
    data = b"".join(cell for chunk in binary.fill_null(b"").chunks for cell in chunk.to_pylist())
    yield f"{name}.values", np.frombuffer(data, np.uint8)
    yield f"{name}.offsets", bounds_of(binary)


def _numbers(column: pa.ChunkedArray) -> NDArray[Any]:
    """NaN, False or 0 for null."""
    kind = column.type
    empty = float("nan") if pa.types.is_floating(kind) else 0
    filler = pa.scalar(False if pa.types.is_boolean(kind) else empty, kind)
    found: NDArray[Any] = column.fill_null(filler).to_numpy().astype(numpy_type(kind), copy=False)
    return found


def _array_name(name: str) -> str:
    """A safe name in the archive, which cannot unpack to another directory."""
    safe = "".join("_" if char in '/\\:\0"' or not char.isprintable() else char for char in name)
    return safe.encode("utf-8", "replace").decode()[:200] or "_"
