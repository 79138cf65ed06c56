"""What is drawn: messages by pixel, gaps and fields over time; images, scans, clouds, tracks."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

import numpy as np
from msgspec import Meta
from msgspec.structs import asdict
from starlette.responses import Response

from hybridlog.drawing.images import picture
from hybridlog.drawing.points import MAX_POINTS, bounds, points
from hybridlog.drawing.series import fields_of, known_fields
from hybridlog.drawing.series import series as read_series
from hybridlog.drawing.times import aligned, lane_of
from hybridlog.drawing.track import track
from hybridlog.view.context import (
    Context,
    Offset,
    Pixels,
    Seq,
    Text,
    current,
    extent,
    json_response,
    packed_response,
    part_of,
    route,
    start_of,
)
from hybridlog_storage.errors import (
    DefinitionError,
    MissingDependencyError,
    PayloadError,
    UsageError,
)
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_LANES: Final = 64
"""Topics of one picture."""
MAX_BINS: Final = 1 << 17
"""Topics times pixels of one picture."""
MAX_FIELDS: Final = 16
"""Most fields of one plot."""
_GREATEST_EXACT: Final = 1 << 53
Lanes: TypeAlias = Annotated[list[Text], Meta(max_length=MAX_LANES)]
Fields: TypeAlias = Annotated[list[Text], Meta(max_length=MAX_FIELDS)]


@route("/timeline")
def timeline(
    context: Context, *, recording: Text, topic: Lanes, begin: Offset, end: Offset, pixels: Pixels
) -> Response:
    """Messages of some topics by bin, as bytes; `pixels` is the most bins that fit in the range.

    The header has `start` (ns since 1970, as text), `begin` of the first bin, `width` of a bin,
    and `lanes`: `exact` (false for estimates) and `period`, the usual time from one message to
    the next, 0 if unknown. Times are ns. The arrays of lane n are `counts n`, an integer a bin, and
    `gaps n`, pairs: first bin, and the one behind the last.
    """
    entry = context.store.entry(recording)
    if len(topic) * pixels > MAX_BINS:
        raise UsageError(f"At most {MAX_BINS // max(len(topic), 1)} pixels for as many topics.")
    start = start_of(entry)
    edges, lanes = aligned(part_of(start, begin, end), pixels), []
    arrays: dict[str, NDArray[Any]] = {}
    for number, name in enumerate(topic):
        lane = lane_of(context.store.session, entry, name)
        period = lane.period()
        lanes.append({"exact": lane.exact, "period": period})
        silent = lane.gaps(edges, extent(entry), period).astype(np.uint32)
        arrays |= {f"counts {number}": _small(lane.counts(edges)), f"gaps {number}": silent}
    head = {
        "start": str(start),
        "begin": int(edges[0]) - start,
        "width": int(edges[1] - edges[0]),
        "lanes": lanes,
    }
    return packed_response(head, arrays)


def _small(counts: NDArray[np.int64]) -> NDArray[Any]:
    """The counts in as few bytes as possible: 1, 2 or 4; none of them is greater."""
    most = int(counts.max(initial=0))
    return np.minimum(counts, (1 << 32) - 1).astype(np.min_scalar_type(min(most, (1 << 32) - 1)))


@route("/fields")
def fields(context: Context, *, recording: Text, topic: Text) -> dict[str, Any]:
    """The fields of a topic that can be drawn, and their types."""
    _, query = context.topic(recording, topic)
    found = fields_of(known_fields(query), iter(query.limit(1)))
    return {"fields": [{"path": path, "type": kind} for path, kind in found]}


@route("/series")
def series(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    begin: Offset,
    end: Offset,
    pixels: Pixels,
    field: Fields,
) -> dict[str, Any]:
    """Least and greatest values by pixel, or each value if there are few."""
    entry, query = context.topic(recording, topic)
    start = start_of(entry)
    found = read_series(query, field, pixels=pixels, span=part_of(start, begin, end))
    if len(found) > MAX_FIELDS:
        raise UsageError(f"These are {len(found)} fields, at most {MAX_FIELDS} fit in a plot.")
    return {
        "exact": all(one.exact for one in found),
        "times": [str(time - start) for time in found[0].times.tolist()] if found else [],
        "fields": [
            {"field": one.field, "least": _values(one.least)}
            | ({} if one.exact else {"greatest": _values(one.greatest)})
            for one in found
        ],
    }


def _values(numbers: NDArray[np.floating[Any]]) -> list[float | str | None]:
    """Null for NaN and infinities, which JSON lacks, and texts for integers that pages round."""
    return [_value(value) if isfinite(value) else None for value in numbers.tolist()]


def _value(number: float) -> float | str:
    is_float = isinstance(number, float) or abs(number) <= _GREATEST_EXACT
    return float(number) if is_float else str(int(number))


@route("/image")
def image(
    context: Context, *, recording: Text, topic: Text, at: Offset, seq: Seq = END
) -> Response:
    """The picture as a file; as JSON, why there is none. Headers say when it is current."""
    found = current(context, recording, topic, at, seq)
    answer: Response = json_response({})
    if found.message is not None:
        try:
            made = picture(found.message, raw=False)
            answer = Response(made.data, media_type=made.media_type)
        except (DefinitionError, MissingDependencyError, PayloadError) as error:
            answer = json_response({"problem": str(error)})
    times = {"Hybridlog-Time": found.time, "Hybridlog-Until": found.until}
    answer.headers.update({name: time for name, time in times.items() if time is not None})
    return answer


@route("/points")
def points_at(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    at: Offset,
    seq: Seq = END,
    value: Text = "",
    limit: Annotated[int, Meta(ge=1, le=MAX_POINTS)] = MAX_POINTS,
) -> Response:
    """The points of the message that is current at a time, at most so many.

    They have the values of that name, to colour by.
    """
    shown = current(context, recording, topic, at, seq)
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


@route("/track")
def track_of(context: Context, *, recording: Text, topic: Text, pixels: Pixels) -> Response:
    """The track of a topic in metres, of a receiver from its first fix, and the times.

    A time is the sum of `times` and `rests`: a float64 is too coarse far from the start.
    """
    entry, query = context.topic(recording, topic)
    start = start_of(entry)
    found = track(query, pixels=pixels)
    offsets, xy = found.pop("times") - start, found.pop("xy")
    header = {**found, "grid": None if found["grid"] is None else asdict(found["grid"])}
    times = offsets.astype(np.float64)
    arrays: dict[str, NDArray[np.floating[Any]]] = {
        "times": times,
        "rests": np.array([n - int(float(n)) for n in offsets.tolist()], np.float32),
        "xy": xy.astype(np.float32),
    }
    return packed_response(header, arrays)


routes = [timeline, fields, series, image, points_at, track_of]
