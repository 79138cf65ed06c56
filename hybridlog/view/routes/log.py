"""Lines of a text log around the cursor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from hybridlog.drawing.log import LEVELS, Line, Log, kind_of
from hybridlog.view.context import route, start_of

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
    recording, query = context.topic(asked)
    start = start_of(recording)
    lines = _log(query, asked)
    time = asked.moment(start)
    # A line at the time itself is before the cursor, as it is current there.
    seq = asked.integer("seq", 0, _MAX_SEQ, _MAX_SEQ)
    found = lines.before(time, seq, before)
    later = lines.after(time, seq, after)
    return {
        "lines": [_line(line, start) for line in (*found, *later)],
        "first": len(found) < before,
        "last": len(later) < after,
    }


def log_count(context: Context, asked: Asked) -> dict[str, Any]:
    """Number of lines that pass the filters."""
    _, query = context.topic(asked)
    return {"count": _log(query, asked).count()}


def _log(query: Query, asked: Asked) -> Log:
    level = asked.word("level", ("", *LEVELS), "")
    text = asked.text("text", "", longest=_MAX_FILTER)
    schemas = (channel.channel.schema for channel in query.channels())
    type_name = next((schema.name for schema in schemas if schema is not None), "")
    return Log(query, kind_of(type_name), level, text)


def _line(line: Line, start: int) -> dict[str, Any]:
    found: dict[str, Any] = {"time": str(line.time - start), "seq": line.seq, "text": line.text}
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
