"""Writes the answer of a query to a file or a stream."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import TYPE_CHECKING, BinaryIO

from hybridlog.cli import output
from hybridlog.cli.progress import progress_bar
from hybridlog.export.slices import IN_FORCE, Front, add_extras, batches_of, profile_of
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    PayloadError,
    UsageError,
)
from hybridlog_storage.stopping import anywhere

if TYPE_CHECKING:
    from hybridlog.attachments import Extras
    from hybridlog.export.base import Target
    from hybridlog.query.answers.follow import Following
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
        form: A format of `hybridlog.export.FORMATS` or `PICTURES`.
        target: Path or binary stream.
        front: The latched messages in front of the answer.
        extras: What an MCAP file or a bag has beside messages; None for nothing.
        quiet: No progress bar.

    Returns:
        Messages that are missing, because they do not fit their definition.
    """
    from hybridlog.export import FORMATS, PICTURES

    total = 0 if quiet else query.size_hint()
    with progress_bar(form, total, quiet=quiet) as bar:
        counters = query.counters

        def progress() -> None:
            bar(counters.payload_bytes, output.counted(counters.messages, "message"))

        if form in PICTURES:
            _write_pictures(query, form, target, progress)
            return 0
        if FORMATS[form].kind == "exact":
            _write_exact(query, form, target, progress, front=front, extras=extras)
            return 0
        written = _write_rows(query, form, target, progress)
        return counters.messages - counters.reduced - written


def write_following(following: Following, form: str, stream: BinaryIO) -> None:
    """Write messages as they come as `jsonl` or `csv`, and flush those that come together."""
    from hybridlog.export.jsonl import JsonlWriter
    from hybridlog.export.tables import CsvWriter
    from hybridlog.frames.answer import stream as tables_of
    from hybridlog.frames.lines import lines

    if form == "jsonl":
        with JsonlWriter(stream) as rows:
            for some in lines(following):
                with anywhere():
                    rows.write_lines(some)
                    stream.flush()
        return
    tables = tables_of(following, at_once=True)
    first = next(tables)
    with CsvWriter(stream, schema=first.schema) as writer:
        for table in chain([first], tables):
            writer.write(table)
            with anywhere():
                writer.flush()


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
            for problem in add_extras(log, extras):
                output.note(problem)
        given = front if form != "raw" else Front(latched=False)
        for batch, channels in batches_of(query, given):
            exact.write(batch, channels)
            progress()


def _write_rows(query: Query, form: str, target: Target, progress: Progress) -> int:
    """Write the rows; returns how many."""
    from hybridlog.export import open_table_writer
    from hybridlog.export.jsonl import JsonlWriter
    from hybridlog.frames.answer import json_columns
    from hybridlog.frames.lines import lines
    from hybridlog.query.planner import Planner

    written = 0
    if form == "jsonl":
        with JsonlWriter(target) as rows:
            query.session.renew()
            query.counters.reset()
            for some in lines(Planner(query.session, query.question, query.counters)):
                rows.write_lines(some)
                written += len(some)
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


def _write_pictures(query: Query, form: str, target: Target, progress: Progress) -> None:
    """Write the images; messages that are unreadable are left out and told.

    Raises:
        UsageError: a message is no image by its type.
        PayloadError: no image is readable.
        DefinitionError: the same.
    """
    from hybridlog.arrays.message_arrays import IMAGES
    from hybridlog.drawing.images import picture
    from hybridlog.export.pictures import open_pictures_writer

    written = left_out = 0
    refused: HybridlogError | None = None
    with open_pictures_writer(target) as images:
        for message in query:
            if message.type.replace("/msg/", "/") not in IMAGES:
                raise UsageError(
                    f"{message.topic} has {message.type or 'no type'}, which is no image: {form} "
                    "is for Image and CompressedImage, those of ROS and of Foxglove."
                )
            if message.is_reduced:
                query.counters.reduced += 1
                continue
            try:
                found = picture(message, form="jpg" if form == "jpg" else "png")
            except (PayloadError, DefinitionError) as error:
                refused = refused or error
                left_out += 1
                continue
            images.write(message, found)
            written += 1
            progress()
        if refused is not None and not written:
            raise refused
    if refused is not None:
        are = "is" if left_out == 1 else "are"
        output.note(f"{output.counted(left_out, 'message')} {are} left out; the first: {refused}.")
