"""`hybridlog fetch`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.cli.asking import question
from hybridlog.cli.coverage import gaps, tell_reduced, tell_unreadable
from hybridlog.cli.opening import opened
from hybridlog.cli.placing import check_room, replacing
from hybridlog.cli.progress import progress_bar
from hybridlog.cli.screen import print_answer
from hybridlog.cli.stopping import Stopped
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.export.base import Target
    from hybridlog.query.plan import Counters
    from hybridlog.reader import Query
    from hybridlog.store import Store

_SUFFIXES = {
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".csv": "csv",
    ".parquet": "parquet",
    ".arrow": "arrow",
    ".feather": "arrow",
    ".npz": "npz",
    ".mcap": "mcap",
    ".bag": "bag",
}
Progress = Callable[[], None]
_TEXT = {"jsonl", "csv"}


@dataclass(frozen=True, slots=True)
class Choices:
    """The options of the command, as typed."""

    topic: list[str]
    store: Path | None
    between: tuple[str, str] | None
    clock: str
    at: str | None
    where: list[str] | None
    recording: list[str] | None
    limit: int | None
    every: int
    reverse: bool
    fields: str | None
    event: tuple[str, str] | None
    before: str | None
    after: str | None
    count: bool
    form: str | None
    output: Path | None
    force: bool
    mongo: str | None
    quiet: bool


def run(choices: Choices) -> None:
    """Answer, and say on standard error what the answer has cost and what it may lack."""
    form = _form(choices)
    path = _path(choices, form)
    started = time.monotonic()
    with opened(choices.store, choices.mongo, quiet=choices.quiet) as store:
        query = _query(store, choices)
        if choices.count:
            output.say(str(query.count()))
        elif form == "table":
            query = print_answer(query)
        elif path is None:
            tell_unreadable(write(query, form, sys.stdout.buffer, quiet=True))
            tell_reduced(query.counters.reduced)
        else:
            _write_file(query, form, path, choices)
        sys.stdout.flush()
        if not choices.quiet:
            closing_line(query.counters, time.monotonic() - started, count=choices.count)
            _tell_gaps(store, query, choices)


def _write_file(query: Query, form: str, path: Path, choices: Choices) -> None:
    try:
        with replacing(path, form=form, force=choices.force):
            missing = write(query, form, path, quiet=choices.quiet)
    except Stopped as stopped:
        stopped.consequence = f"{path} is not written."
        raise
    tell_unreadable(missing)
    tell_reduced(query.counters.reduced)


def write(query: Query, form: str, target: Target, *, quiet: bool = False) -> int:
    """Write a query's answer to a file or a stream; all of it or nothing.

    Args:
        query: The question.
        form: A format of `hybridlog.export.FORMATS`.
        target: Path or binary stream.
        quiet: No progress bar.

    Returns:
        Messages that are not in it, because they do not fit their definition.
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
    from hybridlog.frames.answer import json_columns, schema_of, stream
    from hybridlog.frames.lines import lines

    written = 0
    if form == "jsonl":
        with JsonlWriter(target) as rows:
            for some in lines(query):
                rows.write_lines(some)
                written += len(some)
                progress()
        return written
    schema = schema_of(query)
    with open_table_writer(form, target, schema=schema) as tables:
        for table in stream(query):
            tables.write(table)
            written += table.num_rows
            progress()
    for name in json_columns(schema):
        output.note(f"{name} has values of several types: it is written as JSON text.")
    return written


def _query(store: Store, choices: Choices) -> Query:
    query = question(store, choices.topic, choices.recording)
    if choices.between is not None:
        query = query.between(*choices.between)
    query = query.clock(choices.clock)
    if choices.event is not None:
        topic, predicate = choices.event
        events = question(store, [topic], choices.recording).where(predicate)
        query = query.around(events, choices.before or 0, choices.after or 0)
    for predicate in choices.where or ():
        query = query.where(predicate)
    if choices.fields is not None:
        query = query.fields(*names_of(choices.fields))
    if choices.at is not None:
        return query.just_at(choices.at)
    if choices.every > 1:
        query = query.every(choices.every)
    if choices.reverse:
        query = query.reverse()
    if choices.limit is not None:
        query = query.limit(choices.limit)
    return query


def names_of(text: str) -> list[str]:
    """The fields of --fields, each once.

    Raises:
        UsageError: One of them is empty.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise UsageError(f"--fields wants names with commas between them, not {text!r}.")
    return list(dict.fromkeys(names))


def _form(choices: Choices) -> str:
    _check_event(choices)
    if choices.at is not None:
        for given, option in (
            (choices.between is not None, "--between"),
            (choices.limit is not None, "--limit"),
            (choices.every > 1, "--every"),
            (choices.reverse, "--reverse"),
            (choices.clock != "log", "--clock"),
            (choices.event is not None, "--event"),
        ):
            if given:
                raise UsageError(f"--at asks for one message, by log time; {option} does not fit.")
    if choices.form is not None:
        form = choices.form
    elif choices.output is None or str(choices.output) == "-":
        form = "table" if sys.stdout.isatty() else "jsonl"
    else:
        form = form_of(choices.output)
    if form == "table" and choices.output is not None:
        raise UsageError("A table is for the screen; use --format csv or parquet with -o.")
    return form


def _check_event(choices: Choices) -> None:
    near = choices.before is not None or choices.after is not None
    if near and choices.event is None:
        raise UsageError("--before and --after of what? Say it with --event TOPIC PREDICATE.")
    if choices.event is not None and not near:
        raise UsageError("How long before or after the events? Say it with --before or --after.")


def form_of(path: Path) -> str:
    """The format that the end of a name stands for.

    Raises:
        UsageError: It stands for none.
    """
    form = _SUFFIXES.get(path.suffix.lower())
    if form is None:
        raise UsageError(
            f"The name {path} does not say what to write: add --format, or end it in "
            f"{', '.join(_SUFFIXES)}."
        )
    return form


def _path(choices: Choices, form: str) -> Path | None:
    """Where to; None for standard output. Refused before anything is opened."""
    if choices.count:
        return None
    if choices.output is None or str(choices.output) == "-":
        if form not in {*_TEXT, "table"} and sys.stdout.isatty():
            raise UsageError(f"{form} is no text for a terminal: name a file with -o.")
        return None
    check_room(choices.output, form=form, force=choices.force)
    return choices.output


def _profile(query: Query) -> str:
    encodings = {lane.channel.message_encoding for lane in query.lanes()}
    return {"ros1": "ros1", "cdr": "ros2"}.get(encodings.pop(), "") if len(encodings) == 1 else ""


def closing_line(counters: Counters, elapsed: float, *, count: bool) -> None:
    """Say what an answer has cost.

    Args:
        counters: What was counted.
        elapsed: Seconds, with opening the store.
        count: The answer was a number, not messages.
    """
    taken = f"{output.size(counters.bytes_read)} read from disk"
    if counters.chunks_read:
        taken += f" in {output.counted(counters.chunks_read, 'chunk')}"
    given = counters.messages - counters.reduced
    found = "" if count else f"{output.counted(given, 'message')}, "
    output.note(
        f"{found}{output.size(counters.payload_bytes)} of payload, {taken}, "
        f"{output.counted(counters.documents_read, 'index document')}, {elapsed:.3f} s"
    )


def _tell_gaps(store: Store, query: Query, choices: Choices) -> None:
    recordings = [r for r in store.recordings() if r.id in query.recording_ids]
    between = choices.between if choices.clock == "log" else None
    for line in gaps(recordings, query.topics, between):
        output.note(line)
