"""Routes of what is drawn over time: messages by pixel, gaps, marks, and fields of plots."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.drawing.series import fields_of, known_fields
from hybridlog.drawing.series import series as read_series
from hybridlog.drawing.times import aligned, lane_of
from hybridlog.view.context import Context, extent, packed_response, route, start_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from starlette.responses import Response

    from hybridlog.view.context import RequestParams


MAX_LANES: Final = 64
"""Topics of one picture."""
MAX_BINS: Final = 1 << 17
"""Topics times pixels of one picture."""
MAX_FIELDS: Final = 16
"""Most fields of one plot."""
_GREATEST_EXACT: Final = 1 << 53


def timeline(context: Context, params: RequestParams) -> Response:
    """Messages of some topics by bin, as bytes.

    Parameters are `recording`, `begin` and `end` (ns since its start), `pixels` (most bins that
    fit between them), and `topic`, repeated.

    The header has `start` (ns since 1970, as text), `begin` of the first bin, `width` of a bin,
    and `lanes`: `exact` (false for estimates) and `period`, the usual time from one message to
    the next, 0 if unknown. Times are ns. The arrays of lane n are `counts n`, an integer a bin, and
    `gaps n`, pairs: first bin, and the one behind the last.
    """
    recording = context.recording(params)
    topics = params.texts("topic", most=MAX_LANES)
    pixels = params.pixels()
    if len(topics) * pixels > MAX_BINS:
        raise UsageError(f"At most {MAX_BINS // max(len(topics), 1)} pixels for as many topics.")
    start = start_of(recording)
    span = params.span(start)
    edges, lanes = aligned(span, pixels), []
    arrays: dict[str, NDArray[Any]] = {}
    for number, topic in enumerate(topics):
        lane = lane_of(context.store.session, recording, topic)
        period = lane.period()
        lanes.append({"exact": lane.exact, "period": period})
        silent = lane.gaps(edges, extent(recording), period).astype(np.uint32)
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


def fields(context: Context, params: RequestParams) -> dict[str, Any]:
    """The fields of a topic that can be drawn, and their types."""
    _, query = context.topic(params)
    found = fields_of(known_fields(query), iter(query.limit(1)))
    return {"fields": [{"path": path, "type": kind} for path, kind in found]}


def series(context: Context, params: RequestParams) -> dict[str, Any]:
    """Least and greatest values by pixel, or each value if there are few."""
    recording, query = context.topic(params)
    start = start_of(recording)
    wanted = params.texts("field", most=MAX_FIELDS)
    found = read_series(query, wanted, pixels=params.pixels(), span=params.span(start))
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


routes = [
    route("/timeline", timeline),
    route("/fields", fields),
    route("/series", series),
]
