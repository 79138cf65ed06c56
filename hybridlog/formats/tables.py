"""Writes tables: Parquet, Arrow IPC, CSV.

Tables arrive in pieces. The first pieces, up to a limit, are held back to learn the
columns, so a column may appear late or be empty at first. After that a missing column is
null, and a new one is an error, because these formats fix their columns.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from typing import Protocol

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from hybridlog.columns.parquet_file import leaves
from hybridlog.formats.json_text import (
    PIECE_BYTES,
    base64_column,
    json_column,
    json_pieces,
)
from hybridlog.formats.jsonl import rows_within
from hybridlog.formats.writing import FileWriter, Sink, Target
from hybridlog.schema.arrow_types import common_schema, converted, is_bytes
from hybridlog_storage.errors import UsageError

HELD_BYTES = 32 << 20
"""Default limit of the pieces held back to learn the columns, bytes."""
GROUP_BYTES = 32 << 20
GROUP_ROWS = 1 << 17
_LONG_ROW = 1 << 20


class _ArrowFile(Protocol):
    def write_table(self, table: pa.Table) -> None: ...

    def close(self) -> None: ...


class TableFileWriter(FileWriter):
    """Base of the table formats: learns the columns and collects rows into groups.

    Args:
        target: Path or binary stream.
        schema: The columns, if known beforehand; else they are learnt.
        held_bytes: Limit of the pieces held back to learn them.
    """

    format_name = "table"

    def __init__(
        self, target: Target, *, schema: pa.Schema | None = None, held_bytes: int = HELD_BYTES
    ) -> None:
        super().__init__()
        self._schema = schema
        self._held_bytes = held_bytes
        self._pieces: list[pa.Table] = []
        self._bytes = 0
        self._rows = 0
        self._written = 0
        self._file: _ArrowFile | None = None
        self._sink = Sink(target)

    def write(self, table: pa.Table) -> None:
        """Append rows; columns are matched by name.

        Raises:
            UsageError: A column that appears too late, twice, or with values that do not
                fit the type it had.
            DiskFullError: No space left.
        """
        with self._failures():
            _check_names(table.schema)
            if self._schema is not None:
                table = self._fitted(table)
            self._pieces.append(table)
            self._bytes += table.nbytes
            self._rows += table.num_rows
            if self._schema is None:
                if self._bytes >= self._held_bytes:
                    self._write_group()
            elif self._bytes >= GROUP_BYTES or self._rows >= GROUP_ROWS:
                self._write_group()

    def flush(self) -> None:
        """Write the rows so far."""
        with self._failures():
            self._write_group()
        self._sink.flush()

    def _open(self, sink: Sink, schema: pa.Schema) -> _ArrowFile:
        raise NotImplementedError

    def _prepared(self, table: pa.Table) -> pa.Table:
        """Convert a table to columns that the format supports."""
        return table

    def _write_group(self) -> None:
        if self._schema is None:
            self._schema = common_schema(self._pieces)
            self._pieces = [self._fitted(piece) for piece in self._pieces]
        if self._file is None:
            # `empty_table` knows no lists of extension types.
            nothing = [pa.nulls(0, field.type) for field in self._schema]
            empty = self._prepared(pa.Table.from_arrays(nothing, schema=self._schema))
            self._file = self._open(self._sink, empty.schema)
        if self._pieces:
            # More than the bound is here only if one piece was.
            self._file.write_table(self._prepared(pa.concat_tables(self._pieces)))
        self._written += self._rows
        self._pieces, self._bytes, self._rows = [], 0, 0

    def _fitted(self, table: pa.Table) -> pa.Table:
        """The table with exactly the columns of the file."""
        assert self._schema is not None
        if table.schema.equals(self._schema):
            return table
        known = set(self._schema.names)
        for name in table.column_names:
            if name not in known:
                raise UsageError(
                    f"column {name!r} first appears after {self._written + self._rows} rows, and "
                    f"a {self.format_name} file fixes its columns before; leave it out with "
                    "--fields, or write --format jsonl"
                )
        columns = []
        for field in self._schema:
            index = table.schema.get_field_index(field.name)
            if index < 0:
                columns.append(pa.nulls(table.num_rows, field.type))
                continue
            column = table.column(index)
            try:
                arrays = [converted(chunk, field.type) for chunk in column.chunks]
            except pa.ArrowException as error:
                raise UsageError(
                    f"column {field.name!r} is {field.type} at first and {column.type} later, "
                    f"which does not fit ({error}); leave it out with --fields, or write each "
                    "part into a file of its own with --between"
                ) from error
            columns.append(pa.chunked_array(arrays, type=field.type))
        return pa.Table.from_arrays(columns, schema=self._schema)

    @contextlib.contextmanager
    def _failures(self) -> Iterator[None]:
        """Map Arrow errors to hybridlog errors."""
        try:
            yield
        except pa.ArrowException as error:
            raise UsageError(
                f"the table cannot be written to {self._sink.name} as {self.format_name}: {error}"
            ) from error

    def _finish(self) -> None:
        with self._failures():
            self._write_group()
            assert self._file is not None
            self._file.close()
        self._sink.commit()

    def _discard(self) -> None:
        self._sink.abort()
        self._pieces = []
        file, self._file = self._file, None
        if file is not None:
            # Its output is dropped; otherwise Arrow's writers would close when collected.
            with contextlib.suppress(Exception):
                file.close()


class ParquetWriter(TableFileWriter):
    """Writes Parquet, row groups of zstd.

    Columns of floats have no statistics: readers skip row groups by them, and some then
    lose rows where there are NaN among the values.
    """

    format_name = "parquet"

    def _open(self, sink: Sink, schema: pa.Schema) -> _ArrowFile:
        kinds = {leaf.path: leaf.kind for leaf in leaves(schema)}
        # Arrow holds the dictionary of a long array, and many copies of a long text.
        has_long_rows = self._bytes > _LONG_ROW * max(self._rows, 1)
        writer: _ArrowFile = pa.parquet.ParquetWriter(
            sink,
            schema,
            compression="zstd",
            use_dictionary=[] if has_long_rows else list(kinds),
            write_statistics=[
                path
                for path, kind in kinds.items()
                if not pa.types.is_floating(kind)
                and not (has_long_rows and not pa.types.is_primitive(kind))
            ],
        )
        return writer

    def _prepared(self, table: pa.Table) -> pa.Table:
        # Parquet has no empty group, so messages without fields are omitted.
        for index, field in enumerate(table.schema):
            if pa.types.is_struct(field.type) and field.type.num_fields == 0:
                table = table.set_column(index, field.name, pa.nulls(table.num_rows))
        return table


class ArrowWriter(TableFileWriter):
    """Writes an Arrow IPC file, also known as Feather version 2, with zstd buffers."""

    format_name = "arrow"

    def _open(self, sink: Sink, schema: pa.Schema) -> _ArrowFile:
        options = pa.ipc.IpcWriteOptions(compression="zstd")
        writer: _ArrowFile = pa.ipc.new_file(sink, schema, options=options)
        return writer


class CsvWriter(TableFileWriter):
    """Writes CSV with a header.

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

    format_name = "csv"

    def _open(self, sink: Sink, schema: pa.Schema) -> _ArrowFile:
        return _CsvFile(sink, schema) if schema.names else _Nothing()


class _CsvFile:
    """Rows as text, long ones cell by cell and in pieces."""

    def __init__(self, sink: Sink, schema: pa.Schema) -> None:
        self._sink = sink
        nothing = [pa.nulls(0, field.type) for field in schema]
        empty = _as_text(pa.Table.from_arrays(nothing, schema=schema))
        self._writer = pa.csv.CSVWriter(sink, empty.schema)

    def write_table(self, table: pa.Table) -> None:
        """Write rows."""
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
        self._writer.close()


def _row_pieces(row: pa.Table) -> Iterator[bytes]:
    """The text of one row in pieces."""
    for index, column in enumerate(row.columns):
        yield b"," if index else b""
        array = column.combine_chunks()
        if pa.types.is_string(column.type) and array.nbytes > PIECE_BYTES and not array.null_count:
            text = array[0].as_py()
            yield b'"'
            for begin in range(0, len(text), PIECE_BYTES):
                yield text[begin : begin + PIECE_BYTES].replace('"', '""').encode()
            yield b'"'
        elif array.null_count or not (pa.types.is_nested(column.type) or is_bytes(column.type)):
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
    for index, field in enumerate(table.schema):
        kind = field.type
        if kind == pa.json_():
            chunks = [chunk.storage for chunk in table.column(index).chunks]
            column = pa.chunked_array(chunks, pa.string())
        elif pa.types.is_null(kind) or pa.types.is_dictionary(kind):
            column = table.column(index).cast(
                pa.string() if pa.types.is_null(kind) else kind.value_type
            )
        elif is_bytes(kind):
            chunks = [base64_column(chunk) for chunk in table.column(index).chunks]
            column = pa.chunked_array(chunks, pa.string())
        elif pa.types.is_nested(kind):
            chunks = []
            for array in table.column(index).chunks:
                text = json_column(array)
                chunks.append(pc.if_else(array.is_valid(), text, pa.scalar(None, pa.string())))
            column = pa.chunked_array(chunks, pa.string())
        else:
            continue
        table = table.set_column(index, field.name, column)
    return table


class _Nothing:
    """A file without columns."""

    def write_table(self, table: pa.Table) -> None:
        """Nothing to write."""

    def close(self) -> None:
        """Nothing to close."""


def _check_names(schema: pa.Schema) -> None:
    names = schema.names
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UsageError(f"there are two columns {twice!r}; leave one out with --fields")
