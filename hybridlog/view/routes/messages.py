"""The message at the cursor, and rows of the log panel."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

from hybridlog.drawing.log import LEVELS, Kind, filtered, kind_of, lines
from hybridlog.drawing.tree import MAX_SHOWN, tree
from hybridlog.query.query import channels_of
from hybridlog.query.times import format_time
from hybridlog.schema.states import CAUSES
from hybridlog.view.context import current, route, start_of
from hybridlog_storage.errors import DefinitionError, PayloadError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.view.context import Context, RequestParams


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
        "tag": found.tag,
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
