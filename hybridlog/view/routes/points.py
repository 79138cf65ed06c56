"""The scan or cloud at a time, as points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlog.drawing.points import MAX_POINTS, bounds, points
from hybridlog.view.context import route
from hybridlog.view.current import current
from hybridlog.view.packed import packed_response
from hybridlog_storage.errors import DefinitionError, PayloadError

if TYPE_CHECKING:
    from starlette.responses import Response

    from hybridlog.view.asked import Asked
    from hybridlog.view.context import Context


def points_at(context: Context, asked: Asked) -> Response:
    """The points of the message that is current at a time.

    Parameters: `recording`, `topic`, `at`; `value`, the name of the values to colour by;
    `limit`, the greatest number of points.
    """
    limit = asked.integer("limit", 1, MAX_POINTS, MAX_POINTS)
    value = asked.text("value", "")
    shown = current(context, asked)
    header: dict[str, Any] = {"time": shown.time, "until": shown.until}
    if shown.message is None:
        return packed_response(header, {})
    try:
        found = points(shown.message, values=[value], limit=limit)
    except (DefinitionError, PayloadError) as error:
        return packed_response({**header, "problem": str(error)}, {})
    values = {"value": found.values[value]} if value in found.values else {}
    columns = dict(zip("xyz", found.xyz.T, strict=True)) | values
    header |= {
        "frame": found.frame,
        "shown": len(found.xyz),
        "total": found.total,
        "dropped": found.dropped,
        "every": found.every,
        "origin": found.origin,
        "flat": found.is_flat,
        "remarks": found.remarks,
        "names": found.names,
        "base": found.bases.get(value, 0.0),
        "bounds": {name: bounds(array) for name, array in columns.items()},
    }
    return packed_response(header, {"xyz": found.xyz, **values})


routes = [route("/points", points_at)]
