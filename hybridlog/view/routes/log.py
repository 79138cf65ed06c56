"""Lines of a text log around the cursor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from hybridlog.drawing.log import LEVELS, Kind, Line, filtered, kind_of, lines_after, lines_before
from hybridlog.view.context import route, start_of
from hybridlog_storage.errors import TimeError

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context

_MAX_LINES: Final = 500
_MAX_SEQ: Final = 1 << 62
_MAX_FILTER: Final = 200


def log(context: Context, asked: Asked) -> dict[str, Any]:
    """Lines before and after a time; with `seq`, before and after the line of that number."""
    before = asked.integer("before", 0, _MAX_LINES, 0)
    after = asked.integer("after", 0, _MAX_LINES, 0)
    query, kind, start = _query(context, asked)
    time = max(start + asked.offset("at"), 0)
    # A line at the time itself is before the cursor, as it is current there.
    seq = asked.integer("seq", 0, _MAX_SEQ, _MAX_SEQ)
    found = lines_before(query, kind, time, seq, before) if before else []
    later = lines_after(query, kind, time, seq, after) if after else []
    return {
        "lines": [_line(line, start) for line in (*found, *later)],
        "first": len(found) < before,
        "last": len(later) < after,
    }


def log_count(context: Context, asked: Asked) -> dict[str, Any]:
    """Number of lines that pass the filters."""
    query, _, _ = _query(context, asked)
    try:
        return {"count": query.count()}
    except TimeError:
        return {"count": 0}


def _query(context: Context, asked: Asked) -> tuple[Query, Kind, int]:
    entry = context.recording(asked)
    query = context.query(entry, asked.text("topic"))
    types = {channel.channel.schema for channel in query.channels()}
    kind = kind_of(next((schema.name for schema in types if schema is not None), ""))
    level = asked.word("level", ("", *LEVELS), "")
    text = asked.text("text", "", longest=_MAX_FILTER)
    return filtered(query, kind, level, text), kind, start_of(entry)


def _line(line: Line, start: int) -> dict[str, Any]:
    found = {"time": line.time - start, "seq": line.seq, "text": line.text}
    if line.level:
        found["level"] = line.level
    if line.name:
        found["name"] = line.name
    if not line.is_whole:
        found["cut"] = True
    if not line.is_readable:
        found["problem"] = True
    return found


routes = [route("/log", log), route("/log/count", log_count)]
