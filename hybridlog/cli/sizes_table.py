"""Prints bytes by recording, topic and tier."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output

if TYPE_CHECKING:
    from hybridlog.maintenance.sizes import Size

NO_TOPIC = "(no topic)"


def as_dict(row: Size) -> dict[str, Any]:
    """A row for JSON, without empty names."""
    return {
        **{name: value for name, value in asdict(row).items() if value != ""},
        "total_bytes": row.total_bytes,
    }


def print_sizes(
    rows: Sequence[Size], total: Size, *, recordings: bool = False, topics: bool = False
) -> None:
    """Print rows and their sum.

    Args:
        rows: The rows.
        total: The sum.
        recordings: Whether the rows are of single recordings.
        topics: Whether the rows are of single topics.
    """
    columns: list[output.Column] = [("recording", "left")] if recordings else []
    if topics:
        columns.append(("topic", "left"))
    has_columns = bool(total.column_bytes)
    columns_too = ("columns",) if has_columns else ()
    headings = ("messages", "payload", "segments", *columns_too, "tables", "MongoDB", "total")
    names: list[output.Column] = [(heading, "right") for heading in headings]
    if output.is_narrow():
        del names[:2]
    cells = []
    for row in (*rows, total):
        is_total = row is total
        named = [("total" if is_total else row.recording)] if recordings else []
        if topics:
            name = row.topic or NO_TOPIC
            named.append(name if not is_total else "" if recordings else "total")
        cells.append([*named, *_numbers(row, has_columns=has_columns)[-len(names) :]])
    output.print_table([*columns, *names], cells)


def _numbers(row: Size, *, has_columns: bool) -> list[str]:
    index = "-" if row.index_bytes is None else output.size(row.index_bytes)
    columns = [row.column_bytes] if has_columns else []
    sizes = [row.payload_bytes, row.segment_bytes, *columns, row.table_bytes]
    return [str(row.messages), *map(output.size, sizes), index, output.size(row.total_bytes)]
