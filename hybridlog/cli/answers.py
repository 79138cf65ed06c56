"""Prints an answer or writes it to a file or a stream; says what it cost and lacks."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain, groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

import click

from hybridlog.cli import output
from hybridlog.cli.options import PATH, AsJson, Forced, Topics, option
from hybridlog.cli.output import ROWS_AT_ONCE, Bar, Column, print_table
from hybridlog.formats import OUTPUTS, formats_of, suffixes_of
from hybridlog_storage.errors import PayloadError, UsageError

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.attachments import Extras
    from hybridlog.formats.slices import Front
    from hybridlog.formats.writing import Answer, Line, Target
    from hybridlog.message import Message
    from hybridlog.query.answers.completeness import Completeness
    from hybridlog.query.answers.follow import Following
    from hybridlog.query.query import Query
    from hybridlog.query.question import Counters


SCREEN: Final = "table"
"""The format for people, on the screen."""
SCREEN_ROWS: Final = 20
"""Rows shown without --limit."""
_LINES_AT_ONCE: Final = 4096
TABLE_FORMATS: Final = formats_of("lines", "table")
"""Formats of tables that are no messages."""
_LISTING_FORMATS: Final = [name for name in TABLE_FORMATS if not OUTPUTS[name].is_of_places]
"""Those of rows that have no place."""

_T = TypeVar("_T")


def format_option(formats: Sequence[str], piped: str = " on a terminal, else jsonl") -> Any:
    """The option `--format` of a command with these formats."""
    return option(
        f"Without: by the suffix of -o, else a table{piped}. One of "
        f"{', '.join([SCREEN, *formats])}.",
        "FORMAT",
        name="--format",
        short="-F",
        type=click.Choice([SCREEN, *formats]),
        excludes=("as_json",),
    )


def output_option(what: str) -> Any:
    """The option `--output`; `-` is as good as none."""
    return option(
        f"{what}; - is standard output.",
        "FILE",
        name="--output",
        short="-o",
        type=PATH,
        callback=lambda _, __, path: None if str(path) == "-" else path,
    )


class Tabular(Forced, AsJson):
    """Options of commands that answer with rows: `usual` is for a terminal, and for others."""

    formats: ClassVar[Sequence[str]] = TABLE_FORMATS
    usual: ClassVar[tuple[str, str]] = SCREEN, "jsonl"
    form: str | None = format_option(TABLE_FORMATS)
    output: Path | None = output_option("Write to this file")
    limit: int | None = option("At most so many.", "N", short="-n", type=click.IntRange(min=0))

    def __init__(self, **values: Any) -> None:
        super().__init__(**values)
        self.check()

    @property
    def to_form(self) -> str:
        """The format of the answer: a name of `OUTPUTS`, or `SCREEN`."""
        if self.as_json:
            return "json"
        if self.form is None and self.output is not None:
            return form_of(self.output, suffixes_of(self.formats))
        return self.form or self.usual[not sys.stdout.isatty()]

    @property
    def place(self) -> Target:
        """The path or stream that a writer takes."""
        return self.output or sys.stdout.buffer

    def check(self) -> None:
        """Refuse what cannot be written."""
        form = self.to_form
        if self.output is None:
            if form != SCREEN and not OUTPUTS[form].is_text and sys.stdout.isatty():
                raise UsageError(f"{form} is no text for a terminal: name its place with -o.")
        elif form == SCREEN:
            raise UsageError("A table is for the screen: use --format csv or parquet with -o.")
        else:
            check_room(self.output, force=self.force)

    def answer(
        self,
        tables: Iterable[pa.Table],
        completeness: Callable[[], Completeness] | None = None,
        noun: str = "row",
        *,
        is_fixed: bool = False,
    ) -> int:
        """Print or write tables, at least one, all rows or nothing; returns their number.

        If they are fixed, the first one has all columns in their types.
        """
        form, limit = self.to_form, self.limit
        if limit is not None or form == SCREEN:
            tables = _limited(tables, SCREEN_ROWS + 1 if limit is None else limit)
        if form == SCREEN:
            return _print_rows(_checked(tables, completeness), limit, noun)
        answer = _rows(tables)
        answer.is_fixed = is_fixed
        return _write(answer, form, self.place, completeness) or 0


def form_of(path: Path, suffixes: Mapping[str, str]) -> str:
    """The format that the name of an output gives."""
    if path.suffix.lower() not in suffixes:
        raise UsageError(
            f"The name {path} does not give the format: add --format, or end it in "
            f"{', '.join(suffixes)}."
        )
    return suffixes[path.suffix.lower()]


class Listing(Tabular):
    """Options of commands that answer with rows, which are text unless another form is given."""

    formats: ClassVar[Sequence[str]] = _LISTING_FORMATS
    usual: ClassVar[tuple[str, str]] = SCREEN, SCREEN
    form: str | None = format_option(_LISTING_FORMATS, "")

    def show(self, rows: Iterable[Any], columns: Sequence[Column], without: str = "") -> None:
        """Print or write rows; see `AsJson.show`."""
        limited = islice(rows, self.limit)
        if self.to_form != SCREEN:
            self.answer(_tables_of(limited))
        elif not print_table(columns, limited):
            output.remarks(filter(None, [without]))
        sys.stdout.flush()


def _tables_of(rows: Iterator[Mapping[str, Any]]) -> Iterator[pa.Table]:
    """Rows as tables, at least one."""
    import pyarrow as pa

    block = [*islice(rows, ROWS_AT_ONCE)]
    names = [*block[0]] if block else []
    while True:
        yield pa.table({name: _column([row[name] for row in block]) for name in names})
        if not (block := [*islice(rows, ROWS_AT_ONCE)]):
            return


def _column(values: list[Any]) -> pa.Array:
    """Values as a column; as JSON if no type has them all exactly: great integers and fractions."""
    import pyarrow as pa

    try:
        return pa.array(values)
    except (pa.ArrowInvalid, OverflowError):
        texts = [None if value is None else json.dumps(value) for value in values]
        return pa.ExtensionArray.from_storage(pa.json_(), pa.array(texts))


@contextmanager
def answering(given: Topics) -> Iterator[Query]:
    """The query of an open store; remarks on its answer are printed at the end."""
    with given.opened(snapshot=True) as store:
        query = given.query(store)
        yield query
        sys.stdout.flush()
        output.remarks(query.completeness().sentences)


def write_answer(
    query: Query,
    form: str,
    target: Target,
    *,
    front: Front | None = None,
    extras: Extras | None = None,
    strict: bool = False,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write an answer, all or nothing; its counters are about what was written."""
    from hybridlog.formats.slices import IN_FORCE

    counters, in_frame = query.counters, query.question.frame is not None
    answer = _answer_of(query, form, target, front or IN_FORCE, extras)
    completeness = query.completeness if strict and in_frame else None
    rows = _write(answer, form, target, completeness, settings=settings, counters=counters)
    if left_out := len(answer.unreadable):
        many = output.counted(left_out, "message")
        output.note(f"{many} left out; the first: {answer.unreadable[0]}.")
    if rows is not None and not in_frame:
        counters.messages = rows + counters.reduced


def _write(
    answer: Answer,
    form: str,
    target: Target,
    completeness: Callable[[], Completeness] | None,
    *,
    settings: Mapping[str, Any] | None = None,
    counters: Counters | None = None,
) -> int | None:
    """Write an answer, all of it or nothing, with progress; gives its rows, if it has such."""
    has_rows, rows = OUTPUTS[form].content in {"lines", "table"}, 0

    def told(pieces: Iterable[Any]) -> Iterator[Any]:
        nonlocal rows
        for piece in pieces:
            yield piece
            rows += len(piece) if has_rows else 0
            if counters is not None:
                bar(counters.payload_bytes, output.counted(counters.messages, "message"))

    for name in ("lines", "tables", "batches", "points", "messages"):
        setattr(answer, name, _checked(told(getattr(answer, name)), completeness))
    with Bar(form, quiet=not isinstance(target, Path)) as bar:
        OUTPUTS[form].write(answer, target, **settings or {})
    output.notes(answer.notes)
    return rows if has_rows else None


def _answer_of(
    query: Query, form: str, target: Target, front: Front, extras: Extras | None
) -> Answer:
    """The answer in the form that a format takes."""
    from hybridlog.formats.slices import Front, log_of
    from hybridlog.formats.writing import Answer
    from hybridlog.query.query import tables_of

    content, question = OUTPUTS[form].content, query.question
    if content in {"pictures", "video"}:
        return _pictures(query, form, target, front)
    if content == "points":
        from hybridlog.tf.in_frame import points_of

        query.counters.reset()
        found = points_of(query.source.now(), question, query.counters)
        rows = (
            (one.points, one.message.topic, one.message.type, one.message.log_time_ns)
            for one in found
        )
        return Answer(points=rows)
    if content in {"log", "payloads"}:
        return log_of(query, front if content == "log" else Front(latched=False), extras)
    if question.frame is not None:
        return _rows(tables_of(query))
    from hybridlog.frames.answer import is_fixed
    from hybridlog.frames.lines import lines
    from hybridlog.query.planner import Planner

    planner = Planner(query.source.now(), question, query.counters)
    if content == "table":
        return Answer(tables=tables_of(query), is_fixed=is_fixed(planner))
    query.counters.reset()
    return Answer(lines=lines(planner))


def _checked(pieces: Iterable[_T], completeness: Callable[[], Completeness] | None) -> Iterator[_T]:
    """An answer that is checked behind its last piece: before a file is complete."""
    yield from pieces
    if completeness is not None:
        completeness().check()


def write_following(following: Following, form: str) -> None:
    """Print messages as they come in a text format, and flush those that come together."""
    from hybridlog.formats.writing import Answer
    from hybridlog.frames.answer import stream
    from hybridlog.frames.lines import lines

    answer = Answer(lines=lines(following), tables=stream(following, at_once=True), is_live=True)
    OUTPUTS[form].write(answer, sys.stdout.buffer)
    output.notes(answer.notes)


def _rows(tables: Iterable[pa.Table]) -> Answer:
    """Tables as they are, or as lines."""
    from hybridlog.formats.writing import Answer

    return Answer(lines=chain.from_iterable(map(_lines_of, tables)), tables=tables)


def _pictures(query: Query, form: str, target: Target, front: Front) -> Answer:
    """The images; messages that are unreadable are left out and told."""
    from hybridlog.arrays.message_arrays import IMAGES
    from hybridlog.formats.files import suffix_of
    from hybridlog.formats.writing import Answer
    from hybridlog.query.answers.current import frames_in_front
    from hybridlog.schema.states import without_payload

    before: list[Message] = []
    is_video = OUTPUTS[form].content == "video"
    if is_video and front.latched:
        before = frames_in_front(query.source.now(), query.question)
    answer, counters = Answer(), query.counters
    is_folder = isinstance(target, Path) and not is_video and suffix_of(target) is None

    def images() -> Iterator[Message]:
        given, missing = 0, ""
        for message in chain(before, query):
            if message.type.replace("/msg/", "/") not in IMAGES:
                raise UsageError(
                    f"{message.topic} has {message.type or 'no type'}, which is no image: {form} "
                    "is for images and compressed video, those of ROS and of Foxglove."
                )
            if message.is_reduced:
                counters.leave_out(1, message.state)
                missing = without_payload(counters.reduced, message.state)
            else:
                yield message
                given += 1
        if answer.unreadable and given == len(answer.unreadable):
            raise answer.unreadable[0]
        if missing and not given and not is_folder:
            raise PayloadError(f"{missing}: there is no picture")
        counters.frames += len(before)

    answer.messages = images()
    return answer


def _lines_of(table: pa.Table) -> Iterator[list[Line]]:
    """Rows as JSON objects: the log time as `log_time_ns`, as in all JSON lines."""
    import pyarrow as pa

    from hybridlog.formats.jsonl import json_rows

    names = ["log_time_ns" if name == "log_time" else name for name in table.column_names]
    if names.count("log_time_ns") > 1:
        raise UsageError(
            "In JSON, log_time is 'log_time_ns', and so is another column: name one with `as`."
        )
    for batch in table.combine_chunks().to_batches(max_chunksize=_LINES_AT_ONCE):
        yield list(json_rows(pa.StructArray.from_arrays(batch.columns, names)))


def _limited(tables: Iterable[pa.Table], limit: int) -> Iterator[pa.Table]:
    for table in tables:
        yield table.slice(0, limit)
        limit -= min(limit, table.num_rows)
        if not limit:
            return


def _print_rows(tables: Iterable[pa.Table], limit: int | None, noun: str) -> int:
    """Print rows for people to read, and whether there are none or more; gives their number."""
    from hybridlog.frames.lines import MAX_CELL, MAX_LINE, cells
    from hybridlog.schema.arrow_types import is_text

    most, read = SCREEN_ROWS if limit is None else limit, 0

    def rows() -> Iterator[tuple[list[Column], list[str]]]:
        nonlocal read
        for table in tables:
            wanted = table.slice(0, max(most - read, 0))
            read += table.num_rows
            columns = [
                Column(each.name, n, cut=MAX_CELL if is_text(each.type) else 0)
                for n, each in enumerate(table.schema)
            ]
            for row in cells(wanted, most=MAX_LINE):
                yield columns, row

    # Headings are printed again only where the columns change.
    for columns, alike in groupby(rows(), itemgetter(0)):
        print_table(columns, map(itemgetter(1), alike))
    if not read:
        output.note(f"No {noun}.")
    if limit is None and read > most:
        output.note(
            f"The first {most} {noun}s. --limit shows more, --format jsonl or -o FILE gives all."
        )
    return min(read, most)


def latched(counters: Counters) -> str:
    """The end of a number of messages: ` and 2 latched messages in front`, if any."""
    found = ""
    if counters.latched:
        found = f" and {output.counted(counters.latched, 'latched message')} in front"
    if counters.frames:
        frames = output.counted(counters.frames, "frame")
        found += f" and {frames} of video in front, from the key frame on"
    return found


def write_bytes(target: Target, content: bytes) -> None:
    """Write a file, all of it or nothing, or into a stream."""
    from hybridlog.formats.writing import Sink

    with Sink(target) as sink:
        sink.write(content)


def check_room(path: Path, *, force: bool) -> None:
    """Refuse to overwrite a file without --force; writers refuse directories with files."""
    if path.is_file() and not force:
        raise UsageError(f"{path} exists; --force overwrites it.")
