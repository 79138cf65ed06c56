"""Writes numpy's .npz: one array for each column, readable without pickle.

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
zero or empty. Columns are spooled to temporary files, so memory stays bounded.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import tempfile
import zipfile
from collections.abc import Iterator
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.formats.writing import FileWriter, Sink, Target, failures
from hybridlog.schema.arrow_types import (
    converted,
    is_bytes,
    is_list,
    is_numeric,
    is_text,
    is_time,
    numpy_type,
)
from hybridlog_storage.disk.unfinished import scratch_directory
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LONGEST_STRING = 256
_STRINGS_AT_ONCE = 1 << 14
_COPY = 1 << 20
_OPEN_FILES = 2_000


class NpzWriter(FileWriter):
    """Writes one .npz file."""

    def __init__(self, target: Target, *, schema: pa.Schema | None = None) -> None:
        super().__init__()
        self._schema = schema
        self._columns: dict[str, _Column] = {}
        self._sink = Sink(target)
        self._rows = 0
        try:
            with failures(self._sink.name):
                self._spools = _Spools()
        except BaseException:
            self._sink.abort()
            raise

    def write(self, table: pa.Table) -> None:
        """Append rows; columns are matched by name. A missing column is null.

        Raises:
            UsageError: A column changes its type, or has a type without a numpy form.
            DiskFullError: No space left.
        """
        with failures(self._sink.name):
            for batch in table.combine_chunks().to_batches():
                self._write_batch(batch)

    def _write_batch(self, batch: pa.RecordBatch) -> None:
        names = batch.schema.names
        if len(set(names)) != len(names):
            raise UsageError("two columns have the same name; leave one out with --fields")
        for name, given in zip(names, batch.columns, strict=True):
            array = self._plain(name, given)
            column = self._columns.get(name)
            if column is None:
                if pa.types.is_null(array.type):
                    continue  # its type is unknown; nulls are filled in later
                column = self._columns[name] = _column(_array_name(name), array.type, self._spools)
                column.append_nulls(self._rows)
            column.append(array)
        self._rows += batch.num_rows
        for name, column in self._columns.items():
            if name not in names:
                column.append_nulls(batch.num_rows)

    def _plain(self, name: str, array: pa.Array) -> pa.Array:
        """The array in the type that its column is known to have, JSON as text."""
        if self._schema is not None and name in self._schema.names:
            array = converted(array, self._schema.field(name).type)
        return array.storage if isinstance(array, pa.ExtensionArray) else array

    def _finish(self) -> None:
        with (
            failures(self._sink.name),
            zipfile.ZipFile(cast("IO[bytes]", self._sink), "w", zipfile.ZIP_STORED) as archive,
        ):
            try:
                self._write_arrays(archive)
            except BaseException:
                # Otherwise the archive would be finished, and a stream would look complete.
                self._sink.abort()
                raise
        self._sink.commit()
        self._spools.close()

    def _write_arrays(self, archive: zipfile.ZipFile) -> None:
        written: set[str] = set()
        for column in self._columns.values():
            for name, dtype, shape, chunks in column.arrays():
                unique = name
                while unique in written:
                    unique += "_"
                written.add(unique)
                # With a fixed date, equal content makes equal files.
                entry = zipfile.ZipInfo(f"{unique}.npy", (1980, 1, 1, 0, 0, 0))
                with archive.open(entry, "w", force_zip64=True) as file:
                    file.write(_npy_header(dtype, shape))
                    for chunk in chunks:
                        file.write(chunk)

    def _discard(self) -> None:
        self._sink.abort()
        self._spools.close()


class _Spools:
    """Temporary files of one writer, removed with it."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self._directory = scratch_directory()
        self._count = 0

    def new(self) -> IO[bytes]:
        """A temporary file for an array's bytes."""
        self._count += 1
        if self._count > _OPEN_FILES:
            raise UsageError("more columns than files can be open; choose some with --fields")
        return self._stack.enter_context(
            tempfile.SpooledTemporaryFile(max_size=1 << 16, dir=str(self._directory.path))
        )

    def close(self) -> None:
        """Remove all files."""
        with contextlib.suppress(OSError):
            self._stack.close()
        self._directory.remove()


_Array = tuple[str, "np.dtype[Any]", tuple[int, ...], Iterator[bytes]]


class _Spool:
    """The bytes of one array of a known dtype."""

    def __init__(self, name: str, dtype: np.dtype[Any], spools: _Spools) -> None:
        self.name = name
        self.dtype = dtype
        self.count = 0
        self._file = spools.new()

    def append(self, values: NDArray[Any]) -> None:
        self._file.write(np.ascontiguousarray(values, self.dtype).tobytes())
        self.count += len(values)

    def chunks(self) -> Iterator[bytes]:
        self._file.seek(0)
        while chunk := self._file.read(_COPY):
            yield chunk

    def array(self) -> _Array:
        return self.name, self.dtype, (self.count,), self.chunks()


class _Column:
    """A column: collects pieces and finally returns arrays."""

    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        self.name = name
        self.kind = kind
        self._valid = _Spool(f"{name}.valid", np.dtype(bool), spools)
        self._has_nulls = False

    def append(self, array: pa.Array) -> None:
        """Append values.

        Raises:
            UsageError: Their type differs from that before.
        """
        if array.type != self.kind:
            try:
                array = array.cast(self.kind)
            except pa.ArrowException as error:
                raise UsageError(
                    f"column {self.name!r} is {self.kind} at first and {array.type} later, which "
                    f"does not fit ({error}); leave it out with --fields"
                ) from error
        self._valid.append(array.is_valid().to_numpy(zero_copy_only=False))
        self._has_nulls = self._has_nulls or array.null_count > 0
        self._append(array)

    def append_nulls(self, count: int) -> None:
        """Append rows without a value."""
        if count:
            self.append(pa.nulls(count, self.kind))

    def arrays(self) -> Iterator[_Array]:
        """Name, dtype, shape and bytes of each array of the column."""
        yield from self._arrays()
        if self._has_nulls:
            yield self._valid.array()

    def _append(self, array: pa.Array) -> None:
        raise NotImplementedError

    def _arrays(self) -> Iterator[_Array]:
        raise NotImplementedError


class _Numbers(_Column):
    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        super().__init__(name, kind, spools)
        self._spool = _Spool(name, numpy_type(kind), spools)

    def _append(self, array: pa.Array) -> None:
        if array.null_count:
            array = pc.fill_null(array, _filler(self.kind))
        self._spool.append(array.to_numpy(zero_copy_only=False))

    def _arrays(self) -> Iterator[_Array]:
        yield self._spool.array()


class _Times(_Column):
    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        super().__init__(name, kind, spools)
        stamp = pa.types.is_timestamp(kind)
        self._unit = pa.timestamp("ns") if stamp else pa.duration("ns")
        dtype = np.dtype("datetime64[ns]" if stamp else "timedelta64[ns]")
        self._spool = _Spool(name, dtype, spools)

    def _append(self, array: pa.Array) -> None:
        plain = array.cast(self._unit).cast(pa.int64())
        nat = int(np.iinfo(np.int64).min)
        values = pc.fill_null(plain, nat).to_numpy(zero_copy_only=False)
        self._spool.append(values.view(self._spool.dtype))

    def _arrays(self) -> Iterator[_Array]:
        yield self._spool.array()


class _Texts(_Column):
    """Strings and binary values, as bytes and their ends."""

    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        super().__init__(name, kind, spools)
        self._text = is_text(kind)
        self._bytes = _Spool(f"{name}.values", np.dtype(np.uint8), spools)
        self._offsets = _Spool(f"{name}.offsets", np.dtype(np.int64), spools)
        self._offsets.append(np.zeros(1, np.int64))
        self._longest = 0
        self._has_nul = False

    def _append(self, array: pa.Array) -> None:
        if not len(array):
            return
        values = pc.fill_null(array.cast(pa.large_binary()), b"")
        _, offset_buffer, data_buffer = values.buffers()
        offsets = np.frombuffer(offset_buffer, np.int64)
        offsets = offsets[values.offset : values.offset + len(values) + 1]
        data = np.zeros(0, np.uint8)
        if data_buffer is not None:
            data = np.frombuffer(data_buffer, np.uint8)[offsets[0] : offsets[-1]]
        self._offsets.append(offsets[1:] - offsets[0] + self._bytes.count)
        self._bytes.append(data)
        if self._text:
            lengths = pc.utf8_length(pc.fill_null(array, ""))
            self._longest = max(self._longest, int(pc.max(lengths).as_py()))
            self._has_nul = self._has_nul or not bool(data.all())

    def _arrays(self) -> Iterator[_Array]:
        if not self._text or self._has_nul or self._longest > _LONGEST_STRING:
            yield self._bytes.array()
            yield self._offsets.array()
            return
        dtype = np.dtype(f"<U{max(1, self._longest)}")
        yield self.name, dtype, (self._offsets.count - 1,), self._unicode(dtype)

    def _unicode(self, dtype: np.dtype[Any]) -> Iterator[bytes]:
        data = b"".join(self._bytes.chunks())
        offsets = np.frombuffer(b"".join(self._offsets.chunks()), np.int64)
        for first in range(0, len(offsets) - 1, _STRINGS_AT_ONCE):
            bounds = offsets[first : first + _STRINGS_AT_ONCE + 1].tolist()
            words = [data[low:high].decode() for low, high in itertools.pairwise(bounds)]
            yield np.array(words, dtype).tobytes()


class _Lists(_Column):
    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        super().__init__(name, kind, spools)
        self._items = _column(f"{name}.values", kind.value_type, spools)
        self._offsets = _Spool(f"{name}.offsets", np.dtype(np.int64), spools)
        self._offsets.append(np.zeros(1, np.int64))
        self._end = 0

    def _append(self, array: pa.Array) -> None:
        lengths = pc.fill_null(pc.list_value_length(array), 0).to_numpy(zero_copy_only=False)
        ends = np.cumsum(lengths, dtype=np.int64) + self._end
        self._offsets.append(ends)
        self._end = int(ends[-1]) if len(ends) else self._end
        self._items.append(array.flatten())

    def _arrays(self) -> Iterator[_Array]:
        yield from self._items.arrays()
        yield self._offsets.array()


class _FixedLists(_Column):
    """Lists of numbers of one size: a matrix."""

    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        super().__init__(name, kind, spools)
        self._size = kind.list_size
        self._spool = _Spool(name, numpy_type(kind.value_type), spools)
        self._rows = 0

    def _append(self, array: pa.Array) -> None:
        self._rows += len(array)
        # `values` also has the elements of null rows, which `flatten` omits.
        items = array.values.slice(array.offset * self._size, len(array) * self._size)
        if array.null_count:
            hidden = np.repeat(array.is_null().to_numpy(zero_copy_only=False), self._size)
            items = pc.if_else(pa.array(hidden), pa.scalar(None, items.type), items)
        if items.null_count:
            items = pc.fill_null(items, _filler(self.kind.value_type))
        self._spool.append(items.to_numpy(zero_copy_only=False))

    def _arrays(self) -> Iterator[_Array]:
        yield self.name, self._spool.dtype, (self._rows, self._size), self._spool.chunks()


class _Structs(_Column):
    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        super().__init__(name, kind, spools)
        self._members = [
            _column(f"{name}.{_array_name(member.name)}", member.type, spools)
            for member in (kind.field(index) for index in range(kind.num_fields))
        ]

    def _append(self, array: pa.Array) -> None:
        # `flatten` applies the structure's nulls to its members.
        for member, values in zip(self._members, array.flatten(), strict=True):
            member.append(values)

    def _arrays(self) -> Iterator[_Array]:
        for member in self._members:
            yield from member.arrays()


class _Decoded(_Column):
    """A dictionary column, converted to its values."""

    def __init__(self, name: str, kind: pa.DataType, spools: _Spools) -> None:
        super().__init__(name, kind, spools)
        self._inner = _column(name, kind.value_type, spools)

    def append(self, array: pa.Array) -> None:
        plain = pa.types.is_dictionary(array.type)
        self._inner.append(array.dictionary_decode() if plain else array)

    def arrays(self) -> Iterator[_Array]:
        yield from self._inner.arrays()


class _Nulls(_Column):
    """Elements of lists that are all empty."""

    def _append(self, array: pa.Array) -> None:
        pass

    def _arrays(self) -> Iterator[_Array]:
        yield from ()


def _column(name: str, kind: pa.DataType, spools: _Spools) -> _Column:
    types = pa.types
    table: list[tuple[bool, type[_Column]]] = [
        (is_numeric(kind), _Numbers),
        (is_time(kind), _Times),
        (is_text(kind) or is_bytes(kind), _Texts),
        (types.is_fixed_size_list(kind) and is_numeric(kind.value_type), _FixedLists),
        (is_list(kind), _Lists),
        (types.is_struct(kind), _Structs),
        (types.is_dictionary(kind), _Decoded),
        (types.is_null(kind), _Nulls),
    ]
    for fits, make in table:
        if fits:
            return make(name, kind, spools)
    raise UsageError(
        f"column {name!r} is {kind}, which numpy does not have; leave it out with --fields"
    )


def _filler(kind: pa.DataType) -> pa.Scalar:
    if pa.types.is_floating(kind):
        return pa.scalar(float("nan"), kind)
    return pa.scalar(False if pa.types.is_boolean(kind) else 0, kind)


def _npy_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header,
        {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape},
    )
    return header.getvalue()


def _array_name(name: str) -> str:
    """A safe name in the archive, which cannot unpack to another directory."""
    safe = "".join("_" if char in '/\\:\0"' or not char.isprintable() else char for char in name)
    return safe.encode("utf-8", "replace").decode()[:200] or "_"
