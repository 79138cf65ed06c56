"""Lines of a text log around the cursor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from hybridlog.drawing.log import LEVELS, Line, Log, kind_of
from hybridlog.view.context import route
from hybridlog.view.topic import Topic

if TYPE_CHECKING:
    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context

_MAX_LINES: Final = 500
_MAX_SEQ: Final = 1 << 62
_MAX_FILTER: Final = 200


def log(context: Context, asked: Asked) -> dict[str, Any]:
    """Lines before and after a time; with `seq`, before and after the line of that number."""
    before = asked.integer("before", 0, _MAX_LINES, 0)
    after = asked.integer("after", 0, _MAX_LINES, 0)
    topic = Topic(context, asked)
    lines = _log(topic, asked)
    time = asked.moment(topic.start)
    # A line at the time itself is before the cursor, as it is current there.
    seq = asked.integer("seq", 0, _MAX_SEQ, _MAX_SEQ)
    found = lines.before(time, seq, before)
    later = lines.after(time, seq, after)
    return {
        "lines": [_line(line, topic.start) for line in (*found, *later)],
        "first": len(found) < before,
        "last": len(later) < after,
    }


def log_count(context: Context, asked: Asked) -> dict[str, Any]:
    """Number of lines that pass the filters; null while that is not known."""
    return {"count": _log(Topic(context, asked), asked).count()}


def _log(topic: Topic, asked: Asked) -> Log:
    level = asked.word("level", ("", *LEVELS), "")
    text = asked.text("text", "", longest=_MAX_FILTER)
    return Log(topic.query, kind_of(topic.type), level, text, topic.flushed)


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
