"""Tools for programs that ask: answers of plain values and pictures, in bounds.

They are worked out in the process for SQL, whose memory is limited. Names and texts in them
are data of the robot. The docstrings and types of `TOOLS` are what a program sees.
"""

from __future__ import annotations

import json
from contextlib import closing, suppress
from itertools import chain, islice
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from pydantic import Field

from hybridlog.arrays.message_arrays import IMAGES, plain_type
from hybridlog.drawing.images import Picture, picture
from hybridlog.frames.lines import json_lines
from hybridlog.query.answers.lost import coverage
from hybridlog.query.planner import match_times
from hybridlog.query.predicate.tokens import MAX_TEXT
from hybridlog.query.times import format_duration, format_time
from hybridlog.record.losses import losses_of
from hybridlog.schema.text import without_nan
from hybridlog.view.context import SQL_MEMORY, Context, known_fields
from hybridlog_storage.errors import PayloadError, TimeError, TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query

MAX_ROWS: Final = 200
"""Rows of an answer."""
MAX_MESSAGES: Final = 20
MAX_PICTURES: Final = 4
MAX_BYTES: Final = 128 << 10
"""Bytes of the text of an answer."""
MAX_PICTURE_BYTES: Final = 2 << 20
"""Bytes of one picture."""
_PLOT: Final = (1000, 320)


class Answer(NamedTuple):
    """An answer: JSON text and pictures."""

    text: str
    pictures: tuple[Picture, ...] = ()


Name = Annotated[str, Field(max_length=500)]
Topic = Annotated[str, Field(max_length=500, description="Full or short name, such as scan")]
Where = Annotated[str, Field(max_length=MAX_TEXT, description="A predicate")]
Time = Annotated[str, Field(max_length=100)]
Fields = Annotated[list[Name], Field(max_length=50, description="Paths of fields")]


def _query(
    context: Context,
    topic: str,
    recording: str | None,
    times: tuple[str | None, str | None],
    *,
    where: str | None = None,
    within: str | None = None,
) -> Query:
    query = context.store.recordings(recording).topic(topic)
    if times != (None, None):
        query = query.between(*times)
    return query if where is None else query.where(where, within=within)


def recordings(context: Context, *, name: Name | None = None) -> Answer:
    """List recordings, the latest first: name, times, messages, completeness.

    `name` is a name, an id or a glob such as monday*.
    """
    chosen = context.store.recordings(name)
    found = chosen[-MAX_ROWS:]
    rows = [
        {
            "recording": one.name,
            "begin": None if one.span is None else format_time(one.span[0]),
            "end": None if one.span is None else format_time(one.span[1]),
            "status": one.status,
            "tags": one.tags,
            "messages": one.messages,
            "topics": len({channel.topic for channel in one.channels}),
            "completeness": coverage(one, losses_of(one)),
        }
        for one in reversed([*found])
    ]
    return _answer({"recordings": rows}, "recordings", is_cut=len(chosen) > len(found))


def schema(
    context: Context, *, topic: Topic | None = None, recording: Name | None = None
) -> Answer:
    """List the topics with their types, or the fields of one topic with theirs."""
    chosen = context.store.recordings(recording).check()
    if topic is None:
        found = chosen[-MAX_ROWS:]
        rows: dict[str, dict[str, Any]] = {}
        for channel in chain.from_iterable(entry.channels for entry in found):
            row = rows.setdefault(
                channel.topic, {"topic": channel.topic, "type": channel.type, "messages": 0}
            )
            row["messages"] += channel.stats.messages
        listed = [rows[name] for name in sorted(rows)]
        is_cut = len(listed) > MAX_ROWS or len(chosen) > len(found)
        return _answer({"topics": listed[:MAX_ROWS]}, "topics", is_cut=is_cut)
    query = chosen.topic(topic)
    fields = [{"field": path, "type": kind} for path, kind in known_fields(query).items()]
    values = {"topics": query.topics, "lacks": query.completeness(is_empty=False).sentences}
    return _answer({**values, "fields": fields[:MAX_ROWS]}, "fields", is_cut=len(fields) > MAX_ROWS)


def ask(
    context: Context,
    *,
    topic: Topic,
    where: Where | None = None,
    within: Time | None = None,
    at_least: Time | None = None,
    recording: Name | None = None,
    begin: Time | None = None,
    end: Time | None = None,
) -> Answer:
    """Count the messages of a topic that satisfy a predicate, and say when it holds.

    The predicate may have conditions on other topics, such as
    `/odom: twist.twist.linear.x > 0.8`, then `within` (0.1s) is the greatest distance in
    time. `at_least` (1s) leaves out shorter intervals.
    """
    query = _query(context, topic, recording, (begin, end), where=where, within=within)
    count = query.count()
    values: dict[str, Any] = {"count": count, **_lacks(query, count)}
    with suppress(TimeError):  # the range is outside all recordings
        parts = match_times(query.source.now(), query.question)
        times = chain.from_iterable(part.log_time.tolist() for part in parts)
        values["first_times"] = [*map(format_time, islice(times, 10))]
    rows = []
    is_cut = False
    if where is not None and len(query.topics) == 1:
        held = query.intervals().at_least(at_least or 0)
        values["interval_count"] = len(held)
        is_cut = len(held) > MAX_ROWS
        names = {one.id: one.name for one in query.source.now().summaries_of(query.question)}
        rows = [
            {
                "recording": names[one.recording],
                "begin": format_time(one.begin_ns),
                "length": format_duration(one.end_ns - one.begin_ns),
                "messages": one.messages,
            }
            for one in islice(held, MAX_ROWS)
        ]
    return _answer({**values, "intervals": rows}, "intervals", is_cut=is_cut)


def sql(context: Context, *, query: Annotated[str, Field(max_length=MAX_TEXT)]) -> Answer:
    """Ask in SQL (DuckDB) on views of topics; only queries, and no files."""
    with closing(context.store.sql_engine.connect(SQL_MEMORY, only_reads=True)) as connection:
        answer = connection.query(query)
        table, is_cut = answer.first(MAX_ROWS, MAX_BYTES)
        try:
            values = [one.to_pylist(maps_as_pydicts="strict") for one in table.columns]
        except (OverflowError, ValueError) as error:  # such as a date that is infinite
            raise UsageError(
                f"A value has no plain form ({error}): `::varchar` makes it text."
            ) from error
        rows = [*map(list, zip(*values, strict=True))]
        found = {"columns": table.column_names, "lacks": answer.sentences(), "rows": rows}
        return _answer(found, "rows", is_cut=is_cut)


def fetch(
    context: Context,
    *,
    topic: Topic,
    where: Where | None = None,
    within: Time | None = None,
    recording: Name | None = None,
    begin: Time | None = None,
    end: Time | None = None,
    fields: Fields | None = None,
    limit: Annotated[int, Field(ge=1, le=MAX_MESSAGES)] = 5,
    pictures: Annotated[int, Field(ge=0, le=MAX_PICTURES)] = 0,
) -> Answer:
    """Fetch a few messages, and at most so many pictures of images and video."""
    query = _query(context, topic, recording, (begin, end), where=where, within=within)
    if fields:
        query = query.fields(*fields)
    limited = query.limit(limit)
    rows: list[Any] = []
    shown: list[Picture] = []
    problems: list[str] = []
    if fields:
        rows = [json.loads(line) for line in json_lines(limited)]
    for message in limited if pictures or not fields else ():
        if not fields:
            rows.append(
                {
                    "log_time": format_time(message.log_time_ns),
                    "topic": message.topic,
                    "state": str(message.state),
                    "fields": json.loads(json.dumps(message.fields, default=str)),
                }
            )
        if len(shown) < pictures and plain_type(message.type) in IMAGES:
            try:
                shown.append(_picture(message))
            except PayloadError as error:
                problems.append(f"{format_time(message.log_time_ns)}: {error}")
    count = query.count()
    values = {"count": count, **_lacks(query, count), "not_shown": problems}
    values["lacks"] = [*dict.fromkeys([*limited.completeness().sentences, *values["lacks"]])]
    return _answer({**values, "messages": rows}, "messages", tuple(shown), is_cut=count > len(rows))


def _picture(message: Any) -> Picture:
    found = picture(message, raw=False, form="jpg")
    if len(found.data) > MAX_PICTURE_BYTES:
        raise PayloadError(f"a picture of {len(found.data)} bytes is too large for an answer")
    return found


def plot(
    context: Context,
    *,
    topic: Topic,
    fields: Fields,
    recording: Name | None = None,
    begin: Time | None = None,
    end: Time | None = None,
) -> Answer:
    """Draw fields of a topic over time as a picture."""
    from hybridlog.drawing.figure import figure, lines

    query = _query(context, topic, recording, (begin, end))
    found = lines(query, fields, pixels=_PLOT[0])
    if not found:
        raise TopicError("There is no message to draw.")
    drawn = figure(found, size=_PLOT, form="png")
    lacks = _lacks(query, query.counters.messages)
    return _answer(
        {**lacks, "lines": [f"{one.topic} {one.series.field} in {one.recording}" for one in found]},
        "lines",
        (Picture("image/png", ".png", drawn),),
    )


def _lacks(query: Query, count: int) -> dict[str, Any]:
    """The gaps of a query's last answer, in words."""
    found = query.completeness(is_empty=not count)
    return {
        "lost": found.describe(count) if found.has_losses else None,
        "lacks": found.sentences,
    }


def _answer(
    values: dict[str, Any], rows: str, pictures: tuple[Picture, ...] = (), *, is_cut: bool = False
) -> Answer:
    """An answer whose rows fit into it; `more` says whether some were left out."""
    while True:
        plain = without_nan({**values, "more": is_cut})
        text = json.dumps(plain, ensure_ascii=False, allow_nan=False, default=str)
        if len(text.encode()) <= MAX_BYTES:
            return Answer(text, pictures)
        if len(values[rows]) < 2:
            raise PayloadError("a row is too large for an answer: name fewer columns or fields")
        values[rows], is_cut = values[rows][: len(values[rows]) // 2], True


TOOLS: Final = (recordings, schema, ask, sql, fetch, plot)
