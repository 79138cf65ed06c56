"""Content of panels in space: images, scans and clouds, tracks on the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import asdict
from starlette.responses import Response

from hybridlog.drawing.images import picture
from hybridlog.drawing.points import MAX_POINTS, bounds, points
from hybridlog.drawing.track import track
from hybridlog.view.context import current, json_response, packed_response, route, start_of
from hybridlog_storage.errors import DefinitionError, MissingDependencyError, PayloadError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.view.context import Context, RequestParams


def image(context: Context, params: RequestParams) -> Response:
    """The picture as a file; as JSON, why there is none. Headers say when it is current."""
    found = current(context, params)
    if found.message is None:
        answer: Response = json_response({})
    elif params.tag == found.tag:
        answer = Response(status_code=304)
    else:
        try:
            made = picture(found.message, raw=False)
            answer = Response(made.data, media_type=made.media_type)
        except (DefinitionError, MissingDependencyError, PayloadError) as error:
            answer = json_response({"problem": str(error)})
    answer.headers.update(found.headers)
    return answer


def points_at(context: Context, params: RequestParams) -> Response:
    """The points of the message that is current at a time.

    Parameters: `recording`, `topic`, `at`; `value`, the name of the values to colour by;
    `limit`, the greatest number of points.
    """
    limit = params.integer("limit", 1, MAX_POINTS, MAX_POINTS)
    value = params.text("value", "")
    shown = current(context, params)
    header: dict[str, Any] = {"time": shown.time, "until": shown.until}
    if shown.message is None:
        return packed_response(header, {})
    try:
        found = points(shown.message, values=[value], limit=limit)
    except (DefinitionError, PayloadError) as error:
        return packed_response({**header, "problem": str(error)}, {})
    xyz, all_values, bases = found.pop("xyz"), found.pop("values"), found.pop("bases")
    values = {"value": all_values[value]} if value in all_values else {}
    columns = dict(zip("xyz", xyz.T, strict=True)) | values
    header |= {
        **found,
        "shown": len(xyz),
        "base": bases.get(value, 0.0),
        "bounds": {name: bounds(array) for name, array in columns.items()},
    }
    return packed_response(header, {"xyz": xyz, **values})


def track_of(context: Context, params: RequestParams) -> Response:
    """The track of a topic in metres, of a receiver from its first fix, and the times.

    Parameters: `recording`, `topic`, `pixels`; `begin` and `end` for a part of the time. A time
    is the sum of `times` and `rests`: a float64 is too coarse far from the start.
    """
    recording, query = context.topic(params)
    start = start_of(recording)
    span = None
    if params.has("begin") or params.has("end"):
        span = params.span(start)
    found = track(query, pixels=params.pixels(), span=span)
    offsets, xy = found.pop("times") - start, found.pop("xy")
    header = {**found, "grid": None if found["grid"] is None else asdict(found["grid"])}
    times = offsets.astype(np.float64)
    arrays: dict[str, NDArray[np.floating[Any]]] = {
        "times": times,
        "rests": np.array([n - int(float(n)) for n in offsets.tolist()], np.float32),
        "xy": xy.astype(np.float32),
    }
    return packed_response(header, arrays)


routes = [
    route("/image", image),
    route("/points", points_at),
    route("/track", track_of),
]
