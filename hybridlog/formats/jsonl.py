"""Writes JSON: one object for each message, a line each, in UTF-8; or one list of them.

JSON has no NaN and no infinities: they are the strings `"NaN"`, `"Infinity"` and
`"-Infinity"`, as in the JSON form of protobuf. Integers keep all their digits, also those
past 2**53, which some readers round. Binary values are base64. A field that a message
lacks is not there, and one that is null is null.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator
from itertools import chain, repeat
from typing import TYPE_CHECKING

from hybridlog.formats.answer import Answer, Line
from hybridlog.formats.writing import Sink, Target
from hybridlog.schema.text import without_nan
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa

_BLOCK = 1 << 20
_ROWS = 4096


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
    from hybridlog.formats.json_text import PIECE_BYTES, json_column, json_pieces

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
