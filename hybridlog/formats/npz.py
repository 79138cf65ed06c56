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
zero or empty. Rows wait in a temporary Arrow file, from which columns are read one by one.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from typing import IO, TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.formats.answer import Answer
from hybridlog.formats.tables import groups
from hybridlog.formats.writing import Sink, Target, failures
from hybridlog.schema.arrow_types import (
    bounds_of,
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

Pieces: TypeAlias = "Callable[[], Iterator[pa.Array]]"
"""Reads a column, piece by piece, from its beginning."""
Arrays: TypeAlias = "Iterator[tuple[str, np.dtype[Any], tuple[int, ...], Iterator[NDArray[Any]]]]"
"""Name, type, shape and content, piece by piece, of arrays."""


def write_npz(answer: Answer, target: Target) -> None:
    """Write one .npz file."""
    directory = scratch_directory()
    try:
        with Sink(target) as sink, failures(sink.name):
            path = str(directory.path / "rows.arrow")
            schema = _spool(groups(answer, "npz"), path)
            with zipfile.ZipFile(cast("IO[bytes]", sink), "w", zipfile.ZIP_STORED) as archive:
                try:
                    for index, field in enumerate(schema):
                        if not pa.types.is_null(field.type):
                            pieces = partial(_column, path, index)
                            for array in _arrays(_array_name(field.name), field.type, pieces):
                                _add(archive, *array)
                except BaseException:
                    # Otherwise the archive would be finished, and a stream would look complete.
                    sink.abort()
                    raise
    finally:
        directory.remove()


def _spool(tables: Iterator[pa.Table], path: str) -> pa.Schema:
    """Write tables of the same columns into an Arrow file; returns the columns of that."""
    table = _plain(next(tables))
    for field in table.schema:
        for _ in _arrays(field.name, field.type, lambda: iter(())):
            pass  # a type that numpy does not have is refused here
    with pa.ipc.new_file(path, table.schema) as file:
        file.write_table(table)
        for more in tables:
            file.write_table(_plain(more))
    return table.schema


def _plain(table: pa.Table) -> pa.Table:
    """The rows without dictionaries, with JSON as text, in one piece."""
    columns = []
    for column in table.combine_chunks().columns:
        kind = column.type
        if isinstance(kind, pa.BaseExtensionType):
            arrays = [one.storage for one in column.chunks]
            columns.append(pa.chunked_array(arrays, kind.storage_type))
        else:
            is_coded = pa.types.is_dictionary(kind)
            columns.append(column.cast(kind.value_type) if is_coded else column)
    return pa.Table.from_arrays(columns, table.column_names)


def _column(path: str, index: int) -> Iterator[pa.Array]:
    with pa.memory_map(path) as mapped:
        file = pa.ipc.open_file(mapped)
        for number in range(file.num_record_batches):
            yield file.get_batch(number).column(index)


def _add(
    archive: zipfile.ZipFile,
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    pieces: Iterator[NDArray[Any]],
) -> None:
    while f"{name}.npy" in archive.NameToInfo:
        name += "_"
    # With a fixed date, equal content makes equal files.
    entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
    about = {
        "descr": np.lib.format.dtype_to_descr(dtype),
        "fortran_order": False,
        "shape": shape,
    }
    with archive.open(entry, "w", force_zip64=True) as file:
        np.lib.format.write_array_header_1_0(file, about)
        for piece in pieces:
            file.write(np.ascontiguousarray(piece, dtype).tobytes())


def _arrays(name: str, kind: pa.DataType, pieces: Pieces) -> Arrays:
    """The arrays of a column."""
    rows = sum(map(len, pieces()))
    if is_numeric(kind):
        yield name, numpy_type(kind), (rows,), map(_numbers, pieces())
    elif is_time(kind):
        is_stamp = pa.types.is_timestamp(kind)
        unit = pa.timestamp("ns") if is_stamp else pa.duration("ns")
        dtype = np.dtype("datetime64[ns]" if is_stamp else "timedelta64[ns]")
        yield name, dtype, (rows,), (_ticks(one.cast(unit)).view(dtype) for one in pieces())
    elif is_text(kind) or is_bytes(kind):
        yield from _texts(name, kind, rows, pieces)
    elif pa.types.is_fixed_size_list(kind) and is_numeric(kind.value_type):
        shape = (rows, kind.list_size)
        yield name, numpy_type(kind.value_type), shape, map(_matrix, pieces())
    elif is_list(kind):
        elements = partial(_each, pieces, lambda one: one.flatten())
        yield from _arrays(f"{name}.values", kind.value_type, elements)
        yield f"{name}.offsets", np.dtype(np.int64), (rows + 1,), _offsets(pieces())
    elif pa.types.is_struct(kind):
        for n, field in enumerate(kind):
            member = partial(_each, pieces, partial(_member, n))
            yield from _arrays(f"{name}.{_array_name(field.name)}", field.type, member)
    elif pa.types.is_dictionary(kind):
        decoded = partial(_each, pieces, lambda one: one.dictionary_decode())
        yield from _arrays(name, kind.value_type, decoded)
    elif not pa.types.is_null(kind):  # elements of lists that are all empty
        raise UsageError(
            f"column {name!r} is {kind}, which numpy does not have; leave it out with --fields"
        )
    if not pa.types.is_dictionary(kind) and any(one.null_count for one in pieces()):
        valid = (one.is_valid().to_numpy(zero_copy_only=False) for one in pieces())
        yield f"{name}.valid", np.dtype(bool), (rows,), valid


def _each(pieces: Pieces, how: Callable[[pa.Array], pa.Array]) -> Iterator[pa.Array]:
    return map(how, pieces())


def _member(n: int, structs: pa.StructArray) -> pa.Array:
    return structs.flatten()[n]  # null where the structure is


def _texts(name: str, kind: pa.DataType, rows: int, pieces: Pieces) -> Arrays:
    """Strings of a fixed width; or bytes and their ends."""
    is_short = is_text(kind)
    longest = 1
    for one in pieces() if is_short else ():
        longest = max(longest, pc.max(pc.utf8_length(one)).as_py() or 0)
        has_nul = pc.any(pc.match_substring(one, "\0")).as_py()
        is_short = is_short and not has_nul and longest <= _LONGEST_STRING
    if is_short:
        dtype = np.dtype(f"<U{longest}")
        parts = (
            one.slice(at, _STRINGS_AT_ONCE)
            for one in pieces()
            for at in range(0, len(one), _STRINGS_AT_ONCE)
        )
        words = (np.array(part.fill_null("").to_pylist(), dtype) for part in parts)
        yield name, dtype, (rows,), words
        return
    binary = partial(_each, pieces, lambda one: one.cast(pa.large_binary()))
    size = sum(int(bounds_of(one)[-1]) for one in binary())
    joined = (np.frombuffer(b"".join(one.fill_null(b"").to_pylist()), np.uint8) for one in binary())
    yield f"{name}.values", np.dtype(np.uint8), (size,), joined
    yield f"{name}.offsets", np.dtype(np.int64), (rows + 1,), _offsets(binary())


def _offsets(pieces: Iterator[pa.Array]) -> Iterator[NDArray[np.int64]]:
    """Ends of rows, behind a 0."""
    end = 0
    yield np.zeros(1, np.int64)
    for one in pieces:
        bounds = bounds_of(one)
        yield bounds[1:] + end
        end += int(bounds[-1])


def _numbers(array: pa.Array) -> NDArray[Any]:
    """NaN, False or 0 for null."""
    kind = array.type
    empty = float("nan") if pa.types.is_floating(kind) else 0
    filler = pa.scalar(False if pa.types.is_boolean(kind) else empty, kind)
    found: NDArray[Any] = array.fill_null(filler).to_numpy(zero_copy_only=False)
    return found


def _ticks(array: pa.Array) -> NDArray[np.int64]:
    """Nanoseconds, with NaT for null."""
    plain = array.cast(pa.int64()).fill_null(int(np.iinfo(np.int64).min))
    found: NDArray[np.int64] = plain.to_numpy(zero_copy_only=False)
    return found


def _matrix(array: pa.Array) -> NDArray[Any]:
    """The elements of lists of one size, one behind the other; those of null rows are null."""
    size = array.type.list_size
    items = array.values.slice(array.offset * size, len(array) * size)
    if array.null_count:
        hidden = np.repeat(array.is_null().to_numpy(zero_copy_only=False), size)
        items = pc.if_else(pa.array(hidden), pa.scalar(None, items.type), items)
    return _numbers(items)


def _array_name(name: str) -> str:
    """A safe name in the archive, which cannot unpack to another directory."""
    safe = "".join("_" if char in '/\\:\0"' or not char.isprintable() else char for char in name)
    return safe.encode("utf-8", "replace").decode()[:200] or "_"
