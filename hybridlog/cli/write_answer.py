"""Writes the answer of a query to a file or a stream."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.progress import progress_bar

if TYPE_CHECKING:
    from hybridlog.export.base import Target
    from hybridlog.query.query import Query

Progress = Callable[[], None]


def write_answer(query: Query, form: str, target: Target, *, quiet: bool = False) -> int:
    """Write the answer of a query, all of it or nothing.

    Args:
        query: The query.
        form: A format of `hybridlog.export.FORMATS`.
        target: Path or binary stream.
        quiet: No progress bar.

    Returns:
        Messages that are missing, because they do not fit their definition.
    """
    from hybridlog.export import FORMATS

    total = 0 if quiet else query.size_hint()
    with progress_bar(form, total, quiet=quiet) as bar:
        counters = query.counters

        def progress() -> None:
            bar(counters.payload_bytes, output.counted(counters.messages, "message"))

        if FORMATS[form].kind == "exact":
            _write_exact(query, form, target, progress)
            return 0
        written = _write_rows(query, form, target, progress)
        return counters.messages - counters.reduced - written


def _write_exact(query: Query, form: str, target: Target, progress: Progress) -> None:
    from hybridlog.export import open_batch_writer

    with open_batch_writer(form, target, profile=_profile(query)) as exact:
        if form != "raw":
            for batch, channels in query.latched():
                exact.write(batch, [c.channel for c in channels])
        for batch, channels in query.batches():
            exact.write(batch, [c.channel for c in channels])
            progress()


def _write_rows(query: Query, form: str, target: Target, progress: Progress) -> int:
    """Write the rows; returns how many."""
    from hybridlog.export import open_table_writer
    from hybridlog.export.jsonl import JsonlWriter
    from hybridlog.frames.answer import json_columns

    written = 0
    if form == "jsonl":
        with JsonlWriter(target) as rows:
            for lines in query.to_json_lines():
                rows.write_lines(lines)
                written += len(lines)
                progress()
        return written
    schema = query.schema()
    with open_table_writer(form, target, schema=schema) as tables:
        for table in query.to_tables():
            tables.write(table)
            written += table.num_rows
            progress()
    for name in json_columns(schema):
        output.note(f"{name} has values of several types: it is written as JSON text.")
    return written


def _profile(query: Query) -> str:
    encodings = query.encodings()
    return {"ros1": "ros1", "cdr": "ros2"}.get(encodings.pop(), "") if len(encodings) == 1 else ""
