"""The positions of a satellite receiver or of a robot: the track, and the one at a time."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.drawing.track import Position, fix_of, pose_of, position_of, track
from hybridlog.view.context import route, start_of
from hybridlog.view.current import current
from hybridlog.view.packed import packed_response

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from starlette.responses import Response

    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context


def track_of(context: Context, asked: Asked) -> Response:
    """The track of a topic in metres, of a receiver from its first fix, and the times.

    Parameters: `recording`, `topic`, `pixels`; `begin` and `end` for a part of the time. A time
    is the sum of `times` and `rests`: a float64 is too coarse far from the start.
    """
    recording, query = context.topic(asked)
    start = start_of(recording)
    span = None
    if asked.has("begin") or asked.has("end"):
        span = asked.span(start)
    found = track(query, pixels=asked.pixels(), span=span)
    header = {
        "grid": None if found.grid is None else asdict(found.grid),
        "is_geographic": found.is_geographic,
        "messages": found.messages,
        "fixes": found.fixes,
        "exact": found.exact,
    }
    offsets = found.times - start
    times = offsets.astype(np.float64)
    arrays: dict[str, NDArray[np.floating[Any]]] = {
        "times": times,
        "rests": np.array([n - int(float(n)) for n in offsets.tolist()], np.float32),
        "xy": found.xy.astype(np.float32),
    }
    return packed_response(header, arrays)


def fix_at(context: Context, asked: Asked) -> dict[str, Any]:
    """The position of the message that is current at a time.

    Parameters: `recording`, `topic`, `at`.
    """
    shown = current(context, asked)
    answer: dict[str, Any] = {"time": shown.time, "until": shown.until}
    if shown.message is None:
        return answer
    _, query = context.topic(asked)
    position = position_of(query.field_types()) or Position("", is_geographic=True)
    if position.is_geographic:
        found = asdict(fix_of(shown.message, position.prefix))
    else:
        found = asdict(pose_of(shown.message, position.prefix))
    for name in found.keys() & {"latitude", "longitude", "x", "y"}:
        found[name] = found[name] if math.isfinite(found[name]) else None
    return {**found, **answer}


routes = [route("/track", track_of), route("/fix", fix_at)]
