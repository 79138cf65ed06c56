"""The message at the cursor, and rows of the log panel."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from msgspec import Struct

from hybridlog.drawing.tree import MAX_SHOWN, tree
from hybridlog.query.query import channels_of
from hybridlog.query.times import format_time
from hybridlog.schema.states import CAUSES
from hybridlog.view.context import current, route, start_of
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    PayloadError,
    TimeError,
    UsageError,
)

if TYPE_CHECKING:
    from hybridlog.message import Message
    from hybridlog.query.query import Query
    from hybridlog.view.context import Context, RequestParams


LEVELS: Final = ("debug", "info", "warning", "error", "fatal")
"""From the least to the greatest."""
MAX_TEXT: Final = 4000
"""Most characters of a line."""
_MAX_NAME: Final = 200


class Kind(Struct, frozen=True):
    """Fields of a message type that a log line shows: text, and name of the sender; empty for none.

    `levels` are the least numbers in the field `level` for each of `LEVELS`; empty for none.
    """

    text: str
    name: str = ""
    levels: tuple[int, ...] = ()


_FOXGLOVE = Kind("message", "name", (1, 2, 3, 4, 5))
KINDS: Final[Mapping[str, Kind]] = {
    "rosgraph_msgs/Log": Kind("msg", "name", (1, 2, 4, 8, 16)),
    "rcl_interfaces/Log": Kind("msg", "name", (10, 20, 30, 40, 50)),
    "foxglove_msgs/Log": _FOXGLOVE,
    "foxglove.Log": _FOXGLOVE,
    "std_msgs/String": Kind("data"),
}
"""Types of messages that are lines of a log, without `msg/`."""


Line: TypeAlias = "dict[str, Any]"
"""A line of a log.

`time`, log time in ns; `seq`, arrival number in its recording; `text`, or the reason why it cannot
be read, then with `problem`. Where it has them, `level`, one of `LEVELS`, and `name` of the sender;
`cut` if the text is longer.
"""


def kind_of(type_name: str) -> Kind:
    """The fields of a type's messages that a log line shows; other types are refused."""
    kind = KINDS.get(type_name.replace("/msg/", "/"))
    if kind is None:
        raise UsageError(f"{type_name or 'This type'} is no text log; {', '.join(KINDS)} are.")
    return kind


def filtered(query: Query, kind: Kind, level: str = "", text: str = "") -> Query:
    """The lines of a log, one topic of one recording, that pass some filters.

    The least level is one of `LEVELS`; the text or the sender has the characters of `text`, in any
    case; no regular expression. An empty one lets all lines pass.
    """
    if level and kind.levels:
        query = query.where(f"level >= {kind.levels[LEVELS.index(level)]}")
    if text:
        # Written as numbers, characters mean nothing to the pattern nor to the predicate.
        pattern = "".join(c if c.isalnum() else f"\\x{{{ord(c):x}}}" for c in text)
        fields = [field for field in (kind.text, kind.name) if field]
        query = query.where(" or ".join(f'{field} ~ "(?i){pattern}"' for field in fields))
    return query


def lines(
    query: Query, kind: Kind, time: int, seq: int, count: int, *, before: bool = False
) -> list[Line]:
    """The next lines behind one, or the last ones in front of it, in order, of a `filtered` query.

    That line is named by its log time, ns, and its arrival number; -1 stands in front of all lines
    of that time.
    """
    beside = query.between(time, time + 1).where(f"_meta.seq {'<' if before else '>'} {seq}")
    rest = query.between(None, time) if before else query.between(time + 1)
    found: list[Line] = []
    for part in (beside, rest):
        with suppress(TimeError):  # a range before or behind the recording has no lines
            ordered = part.reverse() if before else part
            found += [_line(message, kind) for message in ordered.limit(count - len(found))]
    return found[::-1] if before else found


def _line(message: Message, kind: Kind) -> Line:
    found: Line = {"time": message.log_time_ns, "seq": message.seq}
    try:
        fields = message.fields
        if not fields:
            message.content()
    except HybridlogError as error:
        return {**found, "text": str(error), "problem": True}
    text = str(fields.get(kind.text, ""))
    more = {
        "level": _level(fields.get("level"), kind),
        "name": str(fields.get(kind.name, ""))[:_MAX_NAME],
        "cut": len(text) > MAX_TEXT,
    }
    return {**found, "text": text[:MAX_TEXT], **{name: one for name, one in more.items() if one}}


def _level(value: Any, kind: Kind) -> str:
    if not isinstance(value, int):
        return ""
    reached = [name for name, least in zip(LEVELS, kind.levels, strict=False) if value >= least]
    return reached[-1] if reached else ""


_PATH: Final = re.compile(r"(\d{1,9}(\.\d{1,9}){0,99})?", re.ASCII)
_MAX_BEGIN: Final = 1 << 40


def message(context: Context, params: RequestParams) -> dict[str, Any]:
    """The message, or the part of it at a path, from an element or character on."""
    place = params.text("path", "")
    if not _PATH.fullmatch(place):
        raise UsageError("path is a list of numbers with dots between them.")
    path = [int(number) for number in place.split(".")] if place else []
    begin = params.integer("begin", 0, _MAX_BEGIN, 0)
    count = params.integer("count", 1, MAX_SHOWN, 1) if params.has("count") else None
    found = current(context, params)
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
        answer["tree"] = tree(shown, path, begin=begin, count=count)
    except (DefinitionError, PayloadError) as error:
        answer["problem"] = str(error)
    return answer


def _time(ns: int | None) -> str | None:
    return None if ns is None or not 0 <= ns < 1 << 63 else format_time(ns)


_MAX_LINES: Final = 500
_MAX_SEQ: Final = 1 << 62
_MAX_FILTER: Final = 200


def log(context: Context, params: RequestParams) -> dict[str, Any]:
    """Lines before and after a time; with `seq`, before and after the line of that number."""
    before = params.integer("before", 0, _MAX_LINES, 0)
    after = params.integer("after", 0, _MAX_LINES, 0)
    recording, query = context.topic(params)
    start = start_of(recording)
    some, kind = _filtered(query, params)
    time = params.moment(start)
    # A line at the time itself is before the cursor, as it is current there.
    seq = params.integer("seq", 0, _MAX_SEQ, _MAX_SEQ)
    found = lines(some, kind, time, seq, before, before=True)
    later = lines(some, kind, time, seq, after)
    return {
        "lines": [{**line, "time": str(line["time"] - start)} for line in (*found, *later)],
        "first": len(found) < before,
        "last": len(later) < after,
    }


def log_count(context: Context, params: RequestParams) -> dict[str, Any]:
    """Number of lines that pass the filters."""
    _, query = context.topic(params)
    return {"count": _filtered(query, params)[0].count()}


def _filtered(query: Query, params: RequestParams) -> tuple[Query, Kind]:
    level = params.word("level", ("", *LEVELS), "")
    text = params.text("text", "", longest=_MAX_FILTER)
    schemas = (channel.channel.schema for channel in channels_of(query))
    type_name = next((schema.name for schema in schemas if schema is not None), "")
    kind = kind_of(type_name)
    return filtered(query, kind, level, text), kind


routes = [route("/message", message), route("/log", log), route("/log/count", log_count)]
