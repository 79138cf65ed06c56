"""Writes the answer of a query to a file or a stream."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.progress import progress_bar
from hybridlog.export.slices import IN_FORCE, Front, batches_of, profile_of
from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from hybridlog.attachments import Extras
    from hybridlog.export.base import LogWriter, Target
    from hybridlog.query.query import Query

Progress = Callable[[], None]


def write_answer(
    query: Query,
    form: str,
    target: Target,
    *,
    front: Front = IN_FORCE,
    extras: Extras | None = None,
    quiet: bool = False,
) -> int:
    """Write the answer of a query, all of it or nothing.

    Args:
        query: The query.
        form: A format of `hybridlog.export.FORMATS`.
        target: Path or binary stream.
        front: The latched messages in front of the answer.
        extras: What an MCAP file or a bag has beside messages; None for nothing.
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
            _write_exact(query, form, target, progress, front=front, extras=extras)
            return 0
        written = _write_rows(query, form, target, progress)
        return counters.messages - counters.reduced - written


def _write_exact(
    query: Query,
    form: str,
    target: Target,
    progress: Progress,
    *,
    front: Front,
    extras: Extras | None,
) -> None:
    from hybridlog.export import open_batch_writer, open_log_writer

    profile = profile_of(query)
    if extras is None:
        writer = open_batch_writer(form, target, profile=profile)
    else:
        writer = log = open_log_writer(form, target, profile=profile)
    with writer as exact:
        if extras is not None:
            _write_extras(log, extras)
        given = front if form != "raw" else Front(latched=False)
        for batch, channels in batches_of(query, given):
            exact.write(batch, channels)
            progress()


def _write_extras(log: LogWriter, extras: Extras) -> None:
    log.declare(extras.channels)
    for metadata in extras.metadata:
        log.add_metadata(metadata.name, metadata.values)
    for problem in extras.problems:
        output.note(f"A metadata record is left out: {problem}")
    for attachment in extras.attachments:
        try:
            checked = attachment.open()
        except SegmentError as error:
            output.note(f"The attachment {output.quoted(attachment.name)} is left out: {error}")
            continue
        log.add_attachment(checked)


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
