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
zero or empty. All rows are held in memory, as a reader of the file holds them, too.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from typing import IO, TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.formats.answer import Answer
from hybridlog.formats.tables import groups
from hybridlog.formats.writing import Sink, Target
from hybridlog.schema.arrow_types import (
    bounds_of,
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

_LONGEST_STRING = 256
_STRINGS_AT_ONCE = 1 << 14

Arrays: TypeAlias = "Iterator[tuple[str, NDArray[Any]]]"
"""Arrays by name."""


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
