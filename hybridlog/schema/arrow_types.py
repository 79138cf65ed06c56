"""The common exact type of Arrow arrays, and arrays converted to it.

A conversion never rounds. Integers become the narrowest integer type for all of them.
They become doubles only beside doubles and within 2^53. Times beside integers become
integers of nanoseconds. Structs get the fields of all. Values without a common exact type
become JSON text (`pa.json_()`).
"""

from __future__ import annotations

import base64
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.schema.arrow_columns import lists, structs
from hybridlog.schema.arrow_objects import EXACT, json_array

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

_INT64_MAX = (1 << 63) - 1
_types = pa.types


def common_type(arrays: Sequence[pa.Array[Any]]) -> pa.DataType:
    """The type that represents the values of all arrays exactly."""
    kinds = list(dict.fromkeys(array.type for array in arrays))
    if len(kinds) > 1 and pa.null() in kinds:
        kinds.remove(pa.null())
        arrays = [array for array in arrays if array.type != pa.null()]
    if not kinds:
        return pa.null()
    if len(kinds) == 1:
        return kinds[0]
    merges = (merge for applies, merge in _MERGES if all(map(applies, kinds)))
    merge = next(merges, None)
    found = pa.json_() if merge is None else merge(kinds, arrays)
    if found != pa.json_():
        return found
    # The type of an array without values, such as the elements of empty lists, is irrelevant.
    valued = [array for array in arrays if array.null_count < len(array)]
    return common_type(valued) if 0 < len(valued) < len(arrays) else found


def common_schema(tables: Iterable[pa.Table]) -> pa.Schema:
    """One schema that represents the values of all tables exactly, columns in first-seen order.

    Args:
        tables: Each is released before the next one is taken.
    """
    fields: dict[str, pa.Field] = {}
    seen: dict[str, dict[pa.DataType, pa.Array[Any]]] = {}
    for table in tables:
        for field, column in zip(table.schema, table.columns, strict=True):
            fields.setdefault(field.name, field)
            kinds = seen.setdefault(field.name, {field.type: pa.nulls(0, field.type)})
            for chunk in column.chunks:
                before = kinds.get(chunk.type)
                parts = [extremes(chunk), *([] if before is None else [before])]
                kinds[chunk.type] = extremes(pa.concat_arrays(parts))
    return pa.schema(
        [field.with_type(common_type(list(seen[name].values()))) for name, field in fields.items()]
    )


def converted(array: pa.Array[Any], kind: pa.DataType) -> pa.Array[Any]:
    """The values of an array in another type that represents them.

    Raises:
        pa.ArrowInvalid: the type does not represent them exactly.
    """
    if array.type == kind:
        return array
    if array.null_count == len(array):
        return pa.nulls(len(array), kind)
    if kind == pa.json_():
        return json_array(plain_values(array))
    if _types.is_struct(kind) and _types.is_struct(array.type):
        return _converted_struct(array, kind)
    if is_list(kind) and is_list(array.type):
        return _converted_list(array, kind)
    if any(same(kind) and same(array.type) for same in (_is_number, _is_text, _is_bytes)):
        return array.cast(kind)
    raise pa.ArrowInvalid(f"{array.type} is not {kind}")


def extremes(array: pa.Array[Any]) -> pa.Array[Any]:
    """Two rows that determine the same common type as all rows."""
    kind = array.type
    if _types.is_integer(kind) and len(array):
        found = pc.min_max(array)
        return pa.array([found["min"].as_py(), found["max"].as_py()], kind)
    if _types.is_struct(kind):
        children = zip(kind, array.flatten(), strict=True)
        return structs({field.name: extremes(child) for field, child in children}, 2)
    if _types.is_fixed_size_list(kind):
        inner = extremes(array.flatten()).take(pa.array(np.arange(2 * kind.list_size) % 2))
        return pa.Array.from_buffers(kind, 2, [None], children=[inner])
    if is_list(kind):
        return lists(extremes(array.flatten()), np.array([0, 2, 2])).cast(kind)
    return _example(array)


def _example(array: pa.Array[Any]) -> pa.Array[Any]:
    """Two rows of the type of an array, one with a value where the array has one."""
    kind = array.type
    if array.null_count == len(array):
        return pa.nulls(2, kind)
    if kind == pa.json_():
        return pa.ExtensionArray.from_storage(kind, pa.array(["0", None]))
    if _is_text(kind) or _is_bytes(kind):
        return pa.array([b"", None], pa.binary()).cast(kind)
    valid = int(np.argmax(array.is_valid().to_numpy(zero_copy_only=False)))
    return pa.concat_arrays([array.slice(valid, 1), pa.nulls(1, kind)])


def is_list(kind: pa.DataType) -> bool:
    """True if a type is a list, of any length and offset type."""
    return bool(
        _types.is_list(kind) or _types.is_large_list(kind) or _types.is_fixed_size_list(kind)
    )


def missing_of(array: pa.Array[Any]) -> NDArray[np.bool_] | None:
    """Mask of the null rows of an array; None if there are none."""
    if not array.null_count:
        return None
    missing: NDArray[np.bool_] = array.is_null().to_numpy(zero_copy_only=False)
    return missing


def lengths_of(array: pa.Array[Any]) -> NDArray[np.int64]:
    """Number of elements of each row of a list array; 0 for null rows."""
    lengths = pc.fill_null(pc.list_value_length(array), 0).cast(pa.int64())
    counts: NDArray[np.int64] = lengths.to_numpy(zero_copy_only=False)
    return counts


def with_values(array: pa.Array[Any], values: pa.Array[Any]) -> pa.Array[Any]:
    """Lists of the same lengths as those of a list array, with other elements.

    Args:
        array: The list array.
        values: As many elements as its `flatten()` has.
    """
    offset = np.zeros(len(array) + 1, np.int64)
    np.cumsum(lengths_of(array), out=offset[1:])
    return lists(values, offset, missing_of(array))


def plain_values(array: pa.Array[Any]) -> list[Any]:
    """Values as in JSON, except NaN: times in nanoseconds, bytes in base64.

    Null fields of structs are left out.
    """
    kind = array.type
    if kind == pa.json_():
        texts = array.storage.to_pylist()
        return [None if text is None else json.loads(text) for text in texts]
    if _types.is_struct(kind):
        names = [field.name for field in kind]
        columns = [plain_values(child) for child in array.flatten()]
        rows = [
            {n: v for n, v in zip(names, row, strict=True) if v is not None}
            for row in (zip(*columns, strict=True) if names else [()] * len(array))
        ]
        return [row if there else None for row, there in zip(rows, _is_there(array), strict=True)]
    if is_list(kind):
        values = iter(plain_values(array.flatten()))
        counted = zip(lengths_of(array).tolist(), _is_there(array), strict=True)
        return [[next(values) for _ in range(n)] if there else None for n, there in counted]
    if _is_time(kind):
        array = array.cast(pa.int64())
    elif _is_bytes(kind):
        cells = array.to_pylist()
        return [None if v is None else base64.b64encode(v).decode() for v in cells]
    plain: list[Any] = array.to_pylist()
    return plain


def _is_there(array: pa.Array[Any]) -> list[bool]:
    there: list[bool] = array.is_valid().to_pylist()
    return there


def _converted_struct(array: pa.Array[Any], kind: pa.DataType) -> pa.Array[Any]:
    have = dict(zip([field.name for field in array.type], array.flatten(), strict=True))
    if not {field.name for field in kind} >= set(have):
        raise pa.ArrowInvalid(f"{array.type} has fields that {kind} lacks")
    children = {
        field.name: converted(have[field.name], field.type)
        if field.name in have
        else pa.nulls(len(array), field.type)
        for field in kind
    }
    return structs(children, len(array), missing_of(array))


def _converted_list(array: pa.Array[Any], kind: pa.DataType) -> pa.Array[Any]:
    made = with_values(array, converted(array.flatten(), kind.value_type))
    return made if made.type == kind else made.cast(kind)


def _is_text(kind: pa.DataType) -> bool:
    return bool(_types.is_string(kind) or _types.is_large_string(kind))


def _is_bytes(kind: pa.DataType) -> bool:
    return bool(_types.is_binary(kind) or _types.is_large_binary(kind))


def _is_time(kind: pa.DataType) -> bool:
    return bool(_types.is_timestamp(kind) or _types.is_duration(kind))


def _is_number(kind: pa.DataType) -> bool:
    """True for a number, or a time, which is a number of nanoseconds."""
    return bool(_types.is_integer(kind) or _types.is_floating(kind) or _is_time(kind))


def _merged_text(kinds: Sequence[pa.DataType], _arrays: Sequence[pa.Array[Any]]) -> pa.DataType:
    return pa.large_string() if len(kinds) > 1 else kinds[0]


def _merged_bytes(kinds: Sequence[pa.DataType], _arrays: Sequence[pa.Array[Any]]) -> pa.DataType:
    return pa.large_binary() if len(kinds) > 1 else kinds[0]


def _merged_numbers(kinds: Sequence[pa.DataType], arrays: Sequence[pa.Array[Any]]) -> pa.DataType:
    whole = [kind for kind in kinds if not _types.is_floating(kind)]
    if not whole:
        return pa.float64()
    if len(whole) == len(kinds):
        return _merged_integers(whole, arrays)
    if any(map(_is_time, kinds)):
        return pa.json_()
    narrow = {pa.int8(), pa.uint8(), pa.int16(), pa.uint16()}
    if narrow.issuperset(whole) and pa.float64() not in kinds:
        return pa.float32()
    low, high = _range(array for array in arrays if array.type in whole)
    return pa.float64() if low >= -EXACT and high <= EXACT else pa.json_()


def _merged_integers(kinds: Sequence[pa.DataType], arrays: Sequence[pa.Array[Any]]) -> pa.DataType:
    if any(map(_is_time, kinds)):
        return pa.int64() if pa.uint64() not in kinds else pa.json_()
    signed = [kind for kind in kinds if _types.is_signed_integer(kind)]
    unsigned = max((k.bit_width for k in kinds if k not in signed), default=0)
    if not signed:
        return pa.type_for_alias(f"uint{unsigned}")
    bits = max(2 * unsigned, *(kind.bit_width for kind in signed))
    if bits <= 64:
        return pa.type_for_alias(f"int{bits}")
    low, high = _range(arrays)
    if high <= _INT64_MAX:
        return pa.int64()
    return pa.uint64() if low >= 0 else pa.json_()


def _range(arrays: Any) -> tuple[int, int]:
    """Least and greatest integer of some arrays, including zero."""
    low = high = 0
    for array in arrays:
        found = pc.min_max(array)
        if found["min"].is_valid:
            low, high = min(low, found["min"].as_py()), max(high, found["max"].as_py())
    return low, high


def _merged_lists(kinds: Sequence[pa.DataType], arrays: Sequence[pa.Array[Any]]) -> pa.DataType:
    item = common_type([array.flatten() for array in arrays])
    sizes = {kind.list_size if _types.is_fixed_size_list(kind) else None for kind in kinds}
    if len(sizes) == 1 and None not in sizes:
        return pa.list_(item, sizes.pop())
    return pa.large_list(item) if any(map(_types.is_large_list, kinds)) else pa.list_(item)


def _merged_structs(_kinds: Sequence[pa.DataType], arrays: Sequence[pa.Array[Any]]) -> pa.DataType:
    children: dict[str, list[pa.Array[Any]]] = {}
    for array in arrays:
        for field, child in zip(array.type, array.flatten(), strict=True):
            children.setdefault(field.name, []).append(child)
    return pa.struct([pa.field(name, common_type(found)) for name, found in children.items()])


_MERGES: list[
    tuple[
        Callable[[pa.DataType], bool],
        Callable[[Sequence[pa.DataType], Sequence[pa.Array[Any]]], pa.DataType],
    ]
] = [
    (_types.is_struct, _merged_structs),
    (is_list, _merged_lists),
    (_is_number, _merged_numbers),
    (_is_text, _merged_text),
    (_is_bytes, _merged_bytes),
]
