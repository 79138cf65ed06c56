"""Chooses the encoding of each column of payloads by trying them on the first rows."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from hybridlog.columns.layout import OWN_COLUMNS, RECIPE
from hybridlog.columns.parquet_file import DICTIONARY, leaves
from hybridlog.columns.payload_rows import field_of

if TYPE_CHECKING:
    from collections.abc import Sequence

LEVEL: Final = 3
"""Level of zstd: the higher ones cost more time than they save room (docs/benchmarks.md)."""
_PLAIN: Final = "PLAIN"
_SPLIT: Final = "BYTE_STREAM_SPLIT"
_DELTA: Final = "DELTA_BINARY_PACKED"
_TRIED = 1 << 18  # elements
_ELEMENT = ".list.element"


def encodings_of(table: pa.Table) -> dict[str, str]:
    """The smallest encoding of each column of arrays, by its path in the file.

    Args:
        table: The first rows.
    """
    chosen = {f"{RECIPE}.rest": _PLAIN, f"{RECIPE}.padding": _PLAIN}
    rows = table.to_struct_array().combine_chunks()
    kinds = {leaf.path: leaf.kind for leaf in leaves(table.schema)}
    for path, kind in kinds.items():
        if path.partition(".")[0] in OWN_COLUMNS or path in chosen:
            continue
        if pa.types.is_binary(kind):
            chosen[path] = _PLAIN
        elif path.count(_ELEMENT) == 1 and path.endswith(_ELEMENT):
            array = field_of(rows, path.removesuffix(_ELEMENT))
            found = smallest(array.flatten().slice(0, _TRIED))
            if found:
                chosen[path] = found
    return {path: how for path, how in chosen.items() if path in kinds}


def smallest(values: pa.Array[Any]) -> str:
    """The encoding in which numbers take the fewest bytes; empty for values of other types."""
    sizes = {how: encoded_size(values, how) for how in _candidates(values.type)}
    return min(sizes, key=sizes.__getitem__, default="")


def _candidates(kind: pa.DataType) -> Sequence[str]:
    if pa.types.is_floating(kind):
        return (DICTIONARY, _PLAIN, _SPLIT)
    if pa.types.is_integer(kind):
        return (DICTIONARY, _DELTA, _SPLIT, _PLAIN)
    return ()


def encoded_size(values: pa.Array[Any], how: str, level: int = LEVEL) -> int:
    """Bytes of one column of Parquet with these values.

    Args:
        values: Numbers.
        how: `dictionary`, or the name of an encoding of Parquet.
        level: Level of zstd.
    """
    sink = io.BytesIO()
    pq.write_table(
        pa.table({"a": values}),
        sink,
        compression="zstd",
        compression_level=level,
        use_dictionary=how == DICTIONARY,
        column_encoding=None if how == DICTIONARY else {"a": how},
        write_statistics=False,
        store_schema=False,
    )
    return sink.tell()
