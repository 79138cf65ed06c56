"""Writes the answer of a query to a file or a stream."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.progress import progress_bar

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.export.base import Target
    from hybridlog.reader import Query

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
    from hybridlog.latched import in_force

    with open_batch_writer(form, target, profile=_profile(query)) as exact:
        if form != "raw":
            for batch, lanes in in_force(query):
                exact.write(batch, [lane.channel for lane in lanes])
        for batch, lanes in query.batches():
            exact.write(batch, [lane.channel for lane in lanes])
            progress()


def _write_rows(query: Query, form: str, target: Target, progress: Progress) -> int:
    """Write the rows; returns how many."""
    from hybridlog.export import open_table_writer
    from hybridlog.export.jsonl import JsonlWriter
    from hybridlog.tables import stream

    written = 0
    if form == "jsonl":
        with JsonlWriter(target) as rows:
            for table in stream(query):
                rows.write_table(_for_json(table, query))
                written += table.num_rows
                progress()
    else:
        with open_table_writer(form, target) as tables:
            for table in stream(query):
                tables.write(table)
                written += table.num_rows
                progress()
    return written


def _profile(query: Query) -> str:
    encodings = {lane.channel.message_encoding for lane in query.lanes()}
    return {"ros1": "ros1", "cdr": "ros2"}.get(encodings.pop(), "") if len(encodings) == 1 else ""


def _for_json(table: pa.Table, query: Query) -> pa.Table:
    """Log time as a number, and the topic, first."""
    import pyarrow as pa

    time_ns = table.column("log_time").cast(pa.int64())
    table = table.remove_column(0)
    if "topic" not in table.column_names or len(query.topics) == 1:
        topic = pa.repeat(pa.scalar(query.topics[0], pa.string()), table.num_rows)
        name = "topic" if "topic" not in table.column_names else "topic_"
        table = table.add_column(0, name, topic)
    return table.add_column(0, "log_time_ns", time_ns)
