"""The track of a satellite receiver, or of poses, in metres and of bounded length."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from msgspec import Struct

from hybridlog.drawing.series import ShownRows, Wanted, log_times, over_time
from hybridlog.query.query import field_types, tables_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.drawing.series import Numbers
    from hybridlog.query.query import Query

_RADIUS = 6_378_137.0  # m, semi-major axis of WGS 84
_ECCENTRICITY = 6.694379990141317e-3  # squared
_STATUS: Final = "status.status"
_POSITIONS_PER_PIXEL = 6  # positions of a pixel at most


class Grid(Struct, frozen=True):
    """A local metric grid: east and north of an origin (degrees), on the ellipsoid of WGS 84.

    Lengths are right near the origin; 100 km away from it, they are wrong by a few percent.

    Attributes:
        east: Metres of a degree of longitude at the origin.
        north: Metres of a degree of latitude at the origin.
    """

    latitude: float
    longitude: float
    east: float
    north: float

    @classmethod
    def at(cls, latitude: float, longitude: float) -> Grid:
        """The grid with its origin at a position in degrees."""
        angle = math.radians(latitude)
        part = 1 - _ECCENTRICITY * math.sin(angle) ** 2
        east = _RADIUS / math.sqrt(part) * math.cos(angle)
        north = _RADIUS * (1 - _ECCENTRICITY) / part**1.5
        return cls(latitude, longitude, math.radians(max(east, 0.0)), math.radians(north))

    def metres(self, latitude: Numbers, longitude: Numbers) -> NDArray[np.float64]:
        """Positions in degrees as float64[n, 2], metres east and north of the origin."""
        turn = (longitude - self.longitude + 180) % 360 - 180  # the short way round
        return np.stack([turn * self.east, (latitude - self.latitude) * self.north], axis=1)


Track: TypeAlias = "dict[str, Any]"
"""Positions in order of time.

* `times`: int64[n], log time, ns since the epoch.
* `xy`: float64[n, 2], metres: east and north of the origin of the grid, or x and y of poses in
  their frame. NaN where no line goes: for messages without a fix, and in the middle of times
  without messages that are longer than usual, as in a `Series`.
* `grid`: the `Grid`, with its origin at the first fix; None without any, and for poses.
* `is_geographic`: False for poses.
* `messages`: number of messages; `fixes`: of those that have a fix.
* `exact`: True if each message is here. Else each pixel of time has its first and its last one, the
  fixes farthest east, north, west and south, and one without a fix if it has any.
"""


def position_of(known: Mapping[str, str] | None) -> tuple[tuple[str, str], bool] | None:
    """Paths of both values, and whether they are latitude and longitude; None without any.

    The types of the fields are known, or no definition fixes them.
    """
    if known is None:
        return ("latitude", "longitude"), True
    for first, second in (("latitude", "longitude"), ("position.x", "position.y")):
        for path in known:
            other = path.removesuffix(first) + second
            is_it = path == first or path.endswith(f".{first}")
            if is_it and "[]" not in path and other in known:
                return (path, other), first == "latitude"
    return None


def track(query: Query, *, pixels: int) -> Track:
    """The positions of a topic of one recording, such as NavSatFix or Odometry, over log time.

    A message has a fix if its position is one and its `status.status`, if there is one, is not
    negative. `pixels` are steps of time: up to six times as many messages are returned exactly. The
    counters of the query are set to the cost.
    """
    if pixels < 1:
        raise UsageError("A track has at least one pixel.")
    known = field_types(query)
    found = position_of(known)
    if found is None:
        raise UsageError("These messages have no latitude and longitude, and no pose.")
    paths, is_geographic = [*found[0]], found[1]
    if is_geographic and (known is None or _STATUS in known):
        paths.append(_STATUS)
    narrowed, (begin, end) = over_time(query, paths, None)
    rows = ShownRows((begin, end), pixels, most=_POSITIONS_PER_PIXEL * pixels)
    rows.add(np.empty(0, np.int64), {"x": np.empty(0), "y": np.empty(0)})
    grid, messages, fixes = None, 0, 0
    with query.counters.timed():
        for table in tables_of(narrowed) if begin < end else ():
            first, second, *status = (_numbers(table, path) for path in paths)
            if is_geographic:
                has_fix = _is_position(first, second)
            else:
                has_fix = np.isfinite(first) & np.isfinite(second)
            if status:
                has_fix &= ~(status[0] < 0)
            messages += len(has_fix)
            fixes += int(np.count_nonzero(has_fix))
            xy = np.where(has_fix, (first, second), np.nan)
            if is_geographic and fixes:
                at = int(np.argmax(has_fix))
                grid = grid or Grid.at(float(first[at]), float(second[at]))
                xy = grid.metres(*xy).T
            rows.add(log_times(table), {"x": xy[0], "y": xy[1]})
        query.counters.add(narrowed.counters)
    if not rows.exact:
        rows.thin()
    (times, columns), (gaps, middles) = rows.joined(), rows.gaps()
    places = np.stack([columns[name] for name in "xy"], axis=1)
    return {
        "times": np.insert(times, gaps, middles),
        "xy": np.insert(places, gaps, np.nan, axis=0),
        "grid": grid,
        "is_geographic": is_geographic,
        "messages": messages,
        "fixes": fixes,
        "exact": rows.exact,
    }


def _is_position(latitude: Numbers, longitude: Numbers) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360)
    return found


def _numbers(table: pa.Table, path: str) -> Numbers:
    """A column, NaN for null, and for a column that is not there."""
    values = Wanted.of(path).columns(table).get(path, np.full(table.num_rows, np.nan))
    if values is None:
        raise UsageError(f"{path} is no number: only numbers can be drawn.")
    return values
