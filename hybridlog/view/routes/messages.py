"""The message at the cursor as a tree."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

from hybridlog.drawing.tree import MAX_SHOWN, tree
from hybridlog.query.times import format_time
from hybridlog.view.context import route
from hybridlog.view.current import current
from hybridlog_storage.errors import DefinitionError, PayloadError, UsageError

if TYPE_CHECKING:
    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context

_PATH: Final = re.compile(r"(\d{1,9}(\.\d{1,9}){0,99})?", re.ASCII)
_MAX_BEGIN: Final = 1 << 40


def message(context: Context, asked: Asked) -> dict[str, Any]:
    """The message, or the part of it at a path, from an element or character on."""
    place = asked.text("path", "")
    if not _PATH.fullmatch(place):
        raise UsageError("path is a list of numbers with dots between them.")
    path = [int(number) for number in place.split(".")] if place else []
    begin = asked.integer("begin", 0, _MAX_BEGIN, 0)
    count = asked.integer("count", 1, MAX_SHOWN, 1) if asked.has("count") else None
    found = current(context, asked)
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
        "reduced": shown.is_reduced,
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


routes = [route("/message", message)]
