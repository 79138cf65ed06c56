"""The message at the cursor, and rows of the log panel."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

from msgspec import Meta

from hybridlog.drawing.tree import MAX_SHOWN, tree
from hybridlog.query.times import format_time
from hybridlog.schema.states import CAUSES
from hybridlog.view.context import (
    Context,
    Offset,
    Question,
    Seq,
    Text,
    current,
    moment_of,
    route,
    start_of,
)
from hybridlog_storage.errors import DefinitionError, HybridlogError, PayloadError, TimeError
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.message import Message
    from hybridlog.query.query import Query

Place: TypeAlias = Annotated[str, Meta(pattern=r"\A(\d{1,9}(\.\d{1,9}){0,99})?\Z")]


@route("/message")
def message(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    at: Offset,
    seq: Seq = END,
    path: Place = "",
    begin: Annotated[int, Meta(ge=0, le=1 << 40)] = 0,
    count: Annotated[int, Meta(ge=1, le=MAX_SHOWN)] | None = None,
) -> dict[str, Any]:
    """The message, or the part of it at a path (numbers), from an element or character on."""
    found = current(context, recording, topic, at, seq)
    shown = found.message
    answer: dict[str, Any] = {"time": found.time, "until": found.until}
    if shown is None:
        return answer
    answer |= {
        "type": shown.type,
        "log_time": format_time(shown.log_time_ns),
        "publish_time": _time(shown.publish_time_ns),
        "seq": shown.seq,
        "sequence": shown.sequence,
        "reduced": CAUSES.get(shown.state),
    }
    try:
        if not shown.is_reduced:
            answer["bytes"] = len(shown.payload)
        place = [int(number) for number in path.split(".")] if path else []
        answer["tree"] = tree(shown, place, begin=begin, count=count)
    except (DefinitionError, PayloadError) as error:
        answer["problem"] = str(error)
    return answer


def _time(ns: int | None) -> str | None:
    return None if ns is None or not 0 <= ns < 1 << 63 else format_time(ns)


MAX_CHARACTERS: Final = 4000
"""Characters of a field of a row; one more says that there are others."""
_Rows: TypeAlias = Annotated[int, Meta(ge=0, le=500)]


@route("/rows")
def rows(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    at: Offset,
    field: Annotated[list[Text], Meta(min_length=1, max_length=8)],
    seq: Seq = END,
    where: Question = "",
    before: _Rows = 0,
    after: _Rows = 0,
) -> dict[str, Any]:
    """Messages before and after a time; with `seq`, before and after the one of that number.

    `time` since the start of the recording, ns, `seq`, and `values` of the fields: numbers, or
    texts; or the `problem` why it cannot be read.
    """
    entry, query = context.topic(recording, topic)
    start = start_of(entry)
    time = moment_of(start, at)
    if where:
        query = query.where(where)
    # A message at the time itself is before the cursor, as it is current there.
    earlier = beside(query, time, seq, before, before=True)
    later = beside(query, time, seq, after)
    return {
        "rows": [_row(one, start, field) for one in (*earlier, *later)],
        "first": len(earlier) < before,
        "last": len(later) < after,
    }


def beside(query: Query, time: int, seq: int, count: int, *, before: bool = False) -> list[Message]:
    """The next messages behind one, or the last ones in front of it, in order.

    The query is of one topic of one recording; that message is named by its log time, ns, and its
    arrival number; -1 stands in front of all messages of that time.
    """
    same = query.between(time, time + 1).where(f"_meta.seq {'<' if before else '>'} {seq}")
    rest = query.between(None, time) if before else query.between(time + 1)
    found: list[Message] = []
    for part in (same, rest):
        with suppress(TimeError):  # a range before or behind the recording has none
            ordered = part.reverse() if before else part
            found += ordered.limit(count - len(found))
    return found[::-1] if before else found


def _row(message: Message, start: int, names: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {"time": str(message.log_time_ns - start), "seq": message.seq}
    try:
        fields = message.fields
        if not fields:
            message.content()
    except HybridlogError as error:
        return {**found, "problem": str(error)}
    values = [fields.get(name, "") for name in names]
    return {
        **found,
        "values": [
            value if type(value) is int else str(value)[: MAX_CHARACTERS + 1] for value in values
        ],
    }


routes = [message, rows]
