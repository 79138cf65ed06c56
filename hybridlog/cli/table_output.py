"""Prints or writes tables that are no messages: topics side by side, regular times."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.output_path import check_room, not_written, replacing
from hybridlog.cli.progress import progress_bar
from hybridlog.cli.signals import if_stopped
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    import pyarrow as pa

    from hybridlog.cli.progress import Bar
    from hybridlog.export.base import Target
    from hybridlog.export.jsonl import Line

_FORMATS = ("table", "jsonl", "csv", "parquet", "arrow")
_SUFFIXES = {
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".csv": "csv",
    ".parquet": "parquet",
    ".arrow": "arrow",
    ".feather": "arrow",
}
_TEXT = {"table", "jsonl", "csv"}


def table_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of `TableChoices` to a command."""
    for add in (
        options.quiet,
        options.mongo,
        options.force,
        options.strict,
        click.option(
            "--output",
            "-o",
            type=options.PATH,
            metavar="FILE",
            help="Write to this file; - is standard output.",
        ),
        click.option(
            "--format",
            "-F",
            "form",
            type=click.Choice(_FORMATS),
            help="Without: by the suffix of -o, else a table on a terminal, else jsonl.",
        ),
        click.option(
            "--limit", "-n", type=click.IntRange(min=0), metavar="N", help="At most so many rows."
        ),
    ):
        command = add(command)
    return command


@dataclass(frozen=True, slots=True, kw_only=True)
class TableChoices:
    """Format and destination of a table.

    Attributes:
        form: Format; None for the usual one.
        output: The file; None for standard output.
        force: Overwrite it.
        limit: Maximum number of rows; None for all.
        quiet: No progress bar.
    """

    form: str | None
    output: Path | None
    force: bool
    limit: int | None
    quiet: bool = False

    def checked(self) -> TableChoices:
        """The same with a format; refuses what cannot be written before a store is opened.

        Raises:
            UsageError: no format is named, or the file exists.
        """
        path = None if self.output is None or str(self.output) == "-" else self.output
        form = self.form
        if form is None and path is None:
            form = "table" if sys.stdout.isatty() else "jsonl"
        elif form is None and path is not None:
            form = _SUFFIXES.get(path.suffix.lower())
            if form is None:
                raise UsageError(
                    f"The name {path} does not give the format: add --format, or end it in "
                    f"{', '.join(_SUFFIXES)}."
                )
        assert form is not None
        if path is None:
            if form not in _TEXT and sys.stdout.isatty():
                raise UsageError(f"{form} is no text for a terminal: name a file with -o.")
        elif form == "table":
            raise UsageError("A table is for the screen: use --format csv or parquet with -o.")
        else:
            check_room(path, force=self.force)
        return replace(self, form=form, output=path)


def write_tables(
    tables: Iterable[pa.Table], schema: Callable[[], pa.Schema | None], choices: TableChoices
) -> int:
    """Print or write tables, all rows or nothing.

    Args:
        tables: The rows, at least one table.
        schema: Gives the columns where only the rows determine them.
        choices: From `TableChoices.checked`.

    Returns:
        Number of rows.
    """
    if choices.form == "table":
        return _print(tables, choices.limit)
    limited = tables if choices.limit is None else _limited(tables, choices.limit)
    form = choices.form or "jsonl"
    if choices.output is None:
        return _write(limited, schema, form, sys.stdout.buffer)
    with (
        if_stopped(partial(not_written, choices.output)),
        replacing(choices.output, force=choices.force),
        progress_bar(form, None, quiet=choices.quiet) as bar,
    ):
        return _write(_shown(limited, bar), schema, form, choices.output)


def _shown(tables: Iterable[pa.Table], bar: Bar) -> Iterator[pa.Table]:
    """The same tables, while the bar counts their rows."""
    done = rows = 0
    for table in tables:
        yield table
        done += table.nbytes
        rows += table.num_rows
        bar(done, output.counted(rows, "row"))


def _write(
    tables: Iterable[pa.Table], schema: Callable[[], pa.Schema | None], form: str, target: Target
) -> int:
    rows = 0
    if form == "jsonl":
        from hybridlog.export.jsonl import JsonlWriter

        with JsonlWriter(target) as writer:
            for table in tables:
                writer.write_lines(_lines(table))
                rows += table.num_rows
        return rows
    from hybridlog.export import open_table_writer

    with open_table_writer(form, target, schema=schema()) as columns:
        for table in tables:
            columns.write(table)
            rows += table.num_rows
    return rows


def _lines(table: pa.Table) -> Iterator[Line]:
    """Rows as JSON objects: the log time as `log_time_ns`, as in all JSON lines."""
    import pyarrow as pa

    from hybridlog.export.jsonl import json_rows

    names = ["log_time_ns" if name == "log_time" else name for name in table.column_names]
    for batch in table.combine_chunks().to_batches():
        yield from json_rows(pa.StructArray.from_arrays(batch.columns, names))


def _limited(tables: Iterable[pa.Table], limit: int) -> Iterator[pa.Table]:
    left = limit
    for table in tables:
        yield table.slice(0, left)
        left -= min(left, table.num_rows)
        if not left:
            return


def _print(tables: Iterable[pa.Table], limit: int | None) -> int:
    from hybridlog.cli.screen import SCREEN_ROWS, print_rows

    # One more than is shown tells whether there is more.
    rows = print_rows(_limited(tables, SCREEN_ROWS + 1 if limit is None else limit), limit)
    if limit is None and rows > SCREEN_ROWS:
        output.note(
            f"The first {SCREEN_ROWS} rows. --limit shows more, --format jsonl or -o FILE gives "
            "all."
        )
        return SCREEN_ROWS
    if not rows:
        output.note("No row.")
    return rows
