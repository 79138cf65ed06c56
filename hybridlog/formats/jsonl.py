"""JSON: writes one object for each message, a line each, in UTF-8, or one list of them.

JSON has no NaN and no infinities: they are the strings `"NaN"`, `"Infinity"` and
`"-Infinity"`, as in the JSON form of protobuf. Integers keep all their digits, also those
past 2**53, which some readers round. Times and durations are integer nanoseconds, binary
values base64. A field that a message lacks is not there, and one that is null is null.
Whole columns become text at a time.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator
from itertools import chain, repeat
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.formats.writing import Answer, Line, Sink, Target
from hybridlog.schema.arrow_types import (
    COMPUTED_AS,
    is_bytes,
    is_list,
    is_text,
    is_time,
)
from hybridlog.schema.text import without_nan
from hybridlog_storage.errors import UsageError

_BLOCK = 1 << 20
_ROWS = 4096
PIECE_BYTES: Final = 3 << 17
"""Bytes of values whose text is made at once where it is made in pieces."""


def write_jsonl(answer: Answer, target: Target) -> None:
    """Write JSON lines."""
    with Sink(target) as sink:
        for lines in answer.lines:
            _write(
                sink, (chain((line,) if isinstance(line, str) else line, "\n") for line in lines)
            )
            if answer.is_live:
                sink.flush()


def write_json(answer: Answer, target: Target) -> None:
    """Write the same objects as one list, a line each."""
    with Sink(target) as sink:
        between = chain(("[\n  ",), repeat(",\n  "))
        for lines in answer.lines:
            _write(
                sink,
                (
                    chain((next(between),), (line,) if isinstance(line, str) else line)
                    for line in lines
                ),
            )
        sink.write(b"\n]\n" if sink.tell() else b"[]\n")


def _write(sink: Sink, pieces: Iterable[Iterable[str]]) -> None:
    block: list[str] = []
    size = 0
    for piece in chain.from_iterable(pieces):
        block.append(piece)
        size += len(piece)
        if size >= _BLOCK:
            sink.write("".join(block).encode("utf-8", "backslashreplace"))
            block, size = [], 0
    # A lone surrogate becomes the escape that JSON has for it.
    sink.write("".join(block).encode("utf-8", "backslashreplace"))


def rows_within(size: int, rows: int) -> int:
    """Rows that are about 16 MiB, from 1 to 4096, when so many have a size together."""
    per_row = max(1, size // max(1, rows))
    return int(min(_ROWS, max(1, (16 << 20) // per_row)))


def json_rows(records: pa.StructArray) -> Iterator[Line]:
    """Rows of columns as lines, long ones in pieces."""
    rows = rows_within(records.nbytes, len(records))
    for begin in range(0, len(records), rows):
        part = records.slice(begin, rows)
        if part.nbytes > PIECE_BYTES * rows:
            yield from (json_pieces(part.slice(row, 1)) for row in range(len(part)))
        else:
            yield from json_column(part).to_pylist()


def json_line(row: object) -> str:
    """A plain value, as of `Decoded.plain`, as one line of JSON, without its end."""
    try:
        try:
            return json.dumps(row, ensure_ascii=False, allow_nan=False, default=_base64)
        except ValueError:  # NaN or an infinity; rare, so it is looked for only then
            return json.dumps(without_nan(row, _base64), ensure_ascii=False)
    except RecursionError:
        raise UsageError("a message is nested too deep for JSON") from None


def _base64(value: bytes) -> str:
    return base64.b64encode(value).decode()


def json_column(array: pa.Array) -> pa.Array:
    """The values of an array as JSON, one string a row; a null is the text `null`.

    The text has at most 2**31 bytes. A union raises `pa.ArrowNotImplementedError`.
    """
    text = _values(array)
    return pc.fill_null(text, "null") if text.null_count else text


def json_pieces(array: pa.Array) -> Iterator[str]:
    """The JSON of an array of one row, in pieces: the text of a long array is never whole."""
    kind = array.type
    if array.nbytes <= PIECE_BYTES or array.null_count:
        yield json_column(array)[0].as_py()
    elif pa.types.is_struct(kind):
        for index, field in enumerate(kind):
            yield f"{', ' if index else '{'}{json.dumps(field.name)}: "
            yield from json_pieces(array.field(index))
        yield "}"
    elif is_list(kind):
        elements = array.flatten()
        rows = max(PIECE_BYTES * len(elements) // max(elements.nbytes, 1), 1)
        yield "["
        for begin in range(0, len(elements), rows):
            part = elements.slice(begin, rows)
            yield ", " if begin else ""
            if len(part) == 1:
                yield from json_pieces(part)
            else:
                yield ", ".join(json_column(part).to_pylist())
        yield "]"
    elif is_bytes(kind):
        data = memoryview(array[0].as_buffer())
        yield '"'
        for begin in range(0, len(data), PIECE_BYTES):  # a multiple of three bytes
            yield base64.b64encode(data[begin : begin + PIECE_BYTES]).decode()
        yield '"'
    else:
        yield json_column(array)[0].as_py()


def _values(array: pa.Array) -> pa.Array:  # noqa: PLR0911 - a case a type
    kind = array.type
    if isinstance(array, pa.ExtensionArray):
        return array.storage if kind == pa.json_() else _values(array.storage)
    if pa.types.is_null(kind):
        return array.cast(pa.string())
    if pa.types.is_dictionary(kind):
        return _values(array.dictionary_decode())
    if pa.types.is_boolean(kind) or pa.types.is_integer(kind) or pa.types.is_decimal(kind):
        return array.cast(pa.string())
    if pa.types.is_floating(kind):
        return _floats(array)
    if pa.types.is_temporal(kind):
        try:
            return _times(array)
        except (OverflowError, pa.ArrowInvalid) as error:
            raise UsageError(
                f"A {kind} is too far away for JSON ({error}). In SQL, `::varchar` makes it text."
            ) from error
    if is_text(kind):
        # Usually few strings are distinct: each is quoted once.
        words = array.dictionary_encode()
        quoted = [json.dumps(word) for word in words.dictionary.to_pylist()]
        return pa.array(quoted, pa.string()).take(words.indices)
    if is_bytes(kind):
        return pc.binary_join_element_wise('"', base64_column(array), '"', "")
    return _nested(array)


def _times(array: pa.Array) -> pa.Array:
    kind = array.type
    if is_time(kind):
        unit = pa.timestamp("ns", kind.tz) if pa.types.is_timestamp(kind) else pa.duration("ns")
        return array.cast(unit).cast(pa.int64()).cast(pa.string())
    return pa.array([_temporal(one) if one.is_valid else None for one in array], pa.string())


def _temporal(one: pa.Scalar) -> str:
    """A date, a time of day, or an interval."""
    value = one.as_py()
    if isinstance(value, pa.MonthDayNano):
        names = ("months", "days", "nanoseconds")
        return json.dumps({name: getattr(value, name) for name in names})
    return json.dumps(str(value))


def _nested(array: pa.Array) -> pa.Array:
    kind = array.type
    if is_list(kind):
        return _lists(array)
    if pa.types.is_struct(kind):
        return _structs(array)
    if pa.types.is_map(kind):
        return _maps(array)
    raise pa.ArrowNotImplementedError(f"no JSON form of {kind}")


def _floats(array: pa.Array) -> pa.Array:
    text = array.cast(pa.string())
    array = array.cast(COMPUTED_AS.get(array.type, array.type))
    if pc.any(pc.equal(array, 0)).as_py():
        # Readers take -0 for an integer, which has no sign.
        text = pc.if_else(pc.equal(text, "-0"), "-0.0", text)
    if pc.all(pc.is_finite(array)).as_py() is not False:
        return text
    infinite = pc.if_else(pc.less(array, 0), '"-Infinity"', '"Infinity"')
    odd = pc.if_else(pc.is_nan(array), '"NaN"', infinite)
    return pc.if_else(pc.is_finite(array), text, odd)


def base64_column(array: pa.Array) -> pa.Array:
    """Binary values in base64, nulls as they are."""
    cells = array.to_pylist()
    encoded = [None if cell is None else base64.b64encode(cell).decode() for cell in cells]
    return pa.array(encoded, pa.string())


def _lists(array: pa.Array) -> pa.Array:
    return _joined("[", array, json_column(array.flatten()), "]")


def _joined(begin: str, array: pa.Array, items: pa.Array, end: str) -> pa.Array:
    """Lists as text, from the texts of their elements."""
    # `flatten` omits values hidden by null lists and slices, so offsets are recomputed.
    lengths = np.asarray(pc.fill_null(pc.list_value_length(array), 0), dtype=np.int64)
    offsets = pa.array(np.concatenate(([0], np.cumsum(lengths))))
    lists = pa.LargeListArray.from_arrays(offsets, items)
    text = pc.binary_join_element_wise(begin, pc.binary_join(lists, ", "), end, "")
    return _with_nulls(text, array)


def _structs(array: pa.Array) -> pa.Array:
    count = array.type.num_fields
    if count == 0:
        return _with_nulls(pa.repeat("{}", len(array)), array)
    parts: list[pa.Array | str] = []
    for index, name in enumerate(array.type.field(i).name for i in range(count)):
        parts.append(f"{', ' if index else '{'}{json.dumps(name)}: ")
        parts.append(json_column(array.field(index)))
    return _with_nulls(pc.binary_join_element_wise(*parts, "}", ""), array)


def _maps(array: pa.MapArray) -> pa.Array:
    """Maps as objects; keys that are no strings are their JSON as a string."""
    lists = array.cast(pa.list_(pa.struct(list(array.type.field(0).type))))
    entries = lists.flatten()
    keys = json_column(entries.field(0))
    if not pa.types.is_string(array.type.key_type):
        keys = pa.array([json.dumps(key) for key in keys.to_pylist()], pa.string())
    pairs = pc.binary_join_element_wise(keys, json_column(entries.field(1)), ": ")
    return _joined("{", lists, pairs, "}")


def _with_nulls(text: pa.Array, array: pa.Array) -> pa.Array:
    if not array.null_count:
        return text
    return pc.if_else(array.is_valid(), text, pa.scalar(None, pa.string()))
