"""Fields over time, for plots."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any, Final

from hybridlog.drawing.fields import fields_of
from hybridlog.drawing.series import series as read_series
from hybridlog.query.answers.infer_fields import SAMPLE
from hybridlog.view.context import route, start_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.view.asked import RequestParams
    from hybridlog.view.context import Context

MAX_FIELDS: Final = 16
"""Most fields of one plot."""
_GREATEST_EXACT: Final = 1 << 53


def fields(context: Context, asked: RequestParams) -> dict[str, Any]:
    """The fields of a topic that can be drawn, and their types."""
    _, query = context.topic(asked)
    found = fields_of(query.field_types(), iter(query.limit(SAMPLE)))
    return {"fields": [{"path": path, "type": kind} for path, kind in found]}


def series(context: Context, asked: RequestParams) -> dict[str, Any]:
    """Least and greatest values by pixel, or each value if there are few."""
    recording, query = context.topic(asked)
    start = start_of(recording)
    wanted = asked.texts("field", most=MAX_FIELDS)
    found = read_series(query, wanted, pixels=asked.pixels(), span=asked.span(start))
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


routes = [route("/fields", fields), route("/series", series)]
