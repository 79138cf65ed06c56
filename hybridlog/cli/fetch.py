"""`hybridlog fetch`."""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hybridlog_storage.errors import UsageError

from hybridlog.cli import output

if TYPE_CHECKING:
    import pyarrow as pa

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
_SCREEN_ROWS = 50
_WIDEST_CELL = 40


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
    count: bool
    form: str | None
    output: Path | None
    force: bool
    mongo: str | None
    quiet: bool


def run(choices: Choices) -> None:
    """Answer, and say on standard error what the answer has cost."""
    form = _form(choices)
    started = time.monotonic()
    with output.opened(choices.store, choices.mongo) as store:
        query = _query(store, choices)
        if choices.count:
            print(query.count())
        elif form == "table":
            _print_tables(query, choices)
        else:
            target = _target(choices, form)
            write(query, form, target, quiet=choices.quiet)
        if not choices.quiet:
            _closing_line(query.counters, time.monotonic() - started)


def write(query: Query, form: str, target: Target, *, quiet: bool = False) -> None:
    """Write a query's answer to a file or a stream; all of it or nothing."""
    from hybridlog.export import FORMATS, open_batch_writer, open_row_writer, open_table_writer

    if FORMATS[form].kind == "exact":
        from hybridlog.latched import in_force

        with open_batch_writer(form, target, profile=_profile(query)) as exact:
            total = 0 if quiet else query.size_hint()
            with output.progress_bar("fetch", total, quiet=quiet) as bar:
                if form != "raw":
                    for batch, lanes in in_force(query):
                        exact.write(batch, [lane.channel for lane in lanes])
                for batch, lanes in query.batches():
                    exact.write(batch, [lane.channel for lane in lanes])
                    bar(query.counters.payload_bytes, f"{query.counters.messages} messages")
        return
    from hybridlog.tables import stream

    if form == "jsonl":
        with open_row_writer(form, target) as rows:
            for table in stream(query):
                rows.write_table(_for_json(table, query))
        return
    with open_table_writer(form, target) as tables:
        for table in stream(query):
            tables.write(table)


def _query(store: Store, choices: Choices) -> Query:
    query = store.topic(*choices.topic)
    if choices.recording:
        query = query.in_recording(*choices.recording)
    if choices.between is not None:
        query = query.between(*choices.between)
    query = query.clock(choices.clock)
    for predicate in choices.where or ():
        query = query.where(predicate)
    if choices.fields is not None:
        query = query.fields(*(name.strip() for name in choices.fields.split(",") if name.strip()))
    if choices.at is not None:
        if choices.between is not None:
            raise UsageError("--at and --between exclude each other.")
        return query.just_at(choices.at)
    if choices.every > 1:
        query = query.every(choices.every)
    if choices.reverse:
        query = query.reverse()
    if choices.limit is not None:
        query = query.limit(choices.limit)
    return query


def _form(choices: Choices) -> str:
    if choices.form is not None:
        form = choices.form
    elif choices.output is not None:
        form = _SUFFIXES.get(choices.output.suffix.lower(), "")
        if not form:
            raise UsageError(
                f"The name {choices.output} does not say what to write: add --format, or end it "
                f"in {', '.join(_SUFFIXES)}."
            )
    else:
        form = "table" if sys.stdout.isatty() else "jsonl"
    if form == "table" and choices.output is not None:
        raise UsageError("A table is for the screen; use --format csv or parquet with -o.")
    return form


def _target(choices: Choices, form: str) -> Target:
    if choices.output is None or str(choices.output) == "-":
        if form not in {"jsonl", "csv"} and sys.stdout.isatty():
            raise UsageError(f"{form} is no text for a terminal: name a file with -o.")
        return sys.stdout.buffer
    make_room(choices.output, force=choices.force)
    return choices.output


def make_room(path: Path, *, force: bool) -> None:
    """Refuse to overwrite without --force; with it, an old directory goes away."""
    if not path.exists() or not (path.is_file() or path.is_dir()):
        return
    if not force:
        raise UsageError(f"{path} exists; --force overwrites it.")
    if path.is_dir() and not path.is_symlink():
        if not (path / "index.csv").exists() and any(path.iterdir()):
            raise UsageError(f"{path} is a directory that holds other things; it is not touched.")
        shutil.rmtree(path)


def _profile(query: Query) -> str:
    encodings = {lane.channel.message_encoding for lane in query.lanes()}
    return {("ros1",): "ros1", ("cdr",): "ros2"}.get(tuple(sorted(encodings)), "")


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


def _print_tables(query: Query, choices: Choices) -> None:
    """Rows on the screen, long arrays in short."""
    from hybridlog.tables import stream

    wanted = query if choices.limit is not None else query.limit(_SCREEN_ROWS)
    rows: list[tuple[str, ...]] = []
    names: list[str] = []
    for table in stream(wanted):
        names = table.column_names
        columns = [[_cell(v) for v in column] for column in table.columns]
        rows.extend(zip(*columns, strict=True))
    output.print_records(names, rows)
    for name in ("messages", "payload_bytes", "bytes_read", "chunks_read", "documents_read"):
        setattr(query.counters, name, getattr(wanted.counters, name))
    if choices.limit is None and len(rows) == _SCREEN_ROWS:
        output.note(
            f"The first {_SCREEN_ROWS} messages; --limit shows more, -o FILE writes them all."
        )


def _cell(value: pa.Scalar) -> str:
    """A value in few characters."""
    import pyarrow as pa

    if not value.is_valid:
        return ""
    if pa.types.is_timestamp(value.type):
        from hybridlog.query.times import format_time

        return format_time(value.value)
    if pa.types.is_duration(value.type):
        return f"{value.value} ns"
    if pa.types.is_list(value.type) or pa.types.is_fixed_size_list(value.type):
        inner = value.values
        if len(inner) <= 4:
            return f"[{', '.join(_cell(v) for v in inner)}]"
        return f"[{_cell(inner[0])}, {_cell(inner[1])}, … n={len(inner)}]"
    if pa.types.is_floating(value.type):
        return f"{value.as_py():.6g}"
    text = str(value.as_py())
    return text if len(text) <= _WIDEST_CELL else text[: _WIDEST_CELL - 1] + "…"


def _closing_line(counters: Counters, elapsed: float) -> None:
    output.note(
        f"{counters.messages} messages, {output.size(counters.payload_bytes)} of payload, "
        f"{output.size(counters.bytes_read)} read from disk in {counters.chunks_read} chunks, "
        f"{counters.documents_read} index documents, {elapsed:.3f} s"
    )
