"""Writes where something was: poses for evo (TUM), fixes for maps (GeoJSON)."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.formats.writing import Answer, Sink, Target
from hybridlog.wording import counted
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

_TIMES = ("header.stamp", "timestamp", "time", "log_time")
"""Columns with the time of a row, the best first."""
POSITIONS = ("position", "translation")
"""Fields with a place. The rotation beside it is of the same place in `_ROTATIONS`."""
_ROTATIONS = ("orientation", "rotation")
_FIX = ("latitude", "longitude", "altitude")


def write_tum(answer: Answer, target: Target) -> None:
    """Write poses as lines of `time x y z qx qy qz qw`, s and m, which evo reads."""
    left_out = 0
    with Sink(target) as sink:
        for table, columns in _places(answer, _pose_among):
            rows = table.select(columns).drop_null()
            rows = rows.filter(pc.not_equal(rows[columns[0]].cast(pa.int64()), 0))  # is not set
            left_out += table.num_rows - rows.num_rows
            times = rows[columns[0]].cast(pa.int64()).to_pylist()
            numbers = np.stack([rows[name].to_numpy() for name in columns[1:]], axis=1)
            lines = (
                f"{time // 10**9}.{time % 10**9:09d} {' '.join(map(repr, pose))}\n"
                for time, pose in zip(times, numbers.astype(np.float64).tolist(), strict=True)
            )
            sink.write("".join(lines).encode())
            if answer.is_live:
                sink.flush()
    _tell(answer, left_out, "without a time or a whole pose")


def write_geojson(answer: Answer, target: Target) -> None:
    """Write fixes as a collection of points (RFC 7946): longitude, latitude, altitude."""
    left_out = 0
    with Sink(target) as sink:
        before = b'{"type": "FeatureCollection", "features": ['
        for table, columns in _places(answer, _fix_among):
            others = ("status.status", "recording")
            chosen = table.select([*columns, *(n for n in others if n in table.column_names)])
            for row in chosen.cast(_with_text_times(chosen.schema)).to_pylist():
                longitude, latitude = row.pop("longitude"), row.pop("latitude")
                place = [longitude, latitude, row.pop("altitude", None)]
                if not all(_is_number(one) for one in place[:2]):
                    left_out += 1
                    continue
                feature = {
                    "type": "Feature",
                    "geometry": {"type": "Point", "coordinates": [*filter(_is_number, place)]},
                    "properties": row,
                }
                sink.write(before + b"\n" + json.dumps(feature).encode())
                before = b","
            if answer.is_live:
                sink.flush()
        sink.write((b"" if sink.tell() else before) + b"\n]}\n")
    _tell(answer, left_out, "without a latitude and a longitude")


def _tell(answer: Answer, rows: int, why: str) -> None:
    if rows:
        answer.notes.append(f"{counted(rows, 'row')} {why} left out.")


def _places(
    answer: Answer, choose: Callable[[Sequence[str]], list[str]]
) -> Iterator[tuple[pa.Table, list[str]]]:
    """The tables that have rows, and the columns that are written."""
    topics: set[str] = set()
    for table in answer.tables:
        if not table.num_rows:
            continue
        if "topic" in table.column_names:
            topics.update(table["topic"].unique().to_pylist())
            if len(topics) > 1:
                raise UsageError("A file has the places of one topic: name one.")
        yield table, choose(table.column_names)


def _pose_among(names: Sequence[str]) -> list[str]:
    time, pose = _time_among(names), next(_pose_columns(names), None)
    if time is not None and pose is not None:
        return [time, *pose]
    raise UsageError(
        "tum takes poses: fields such as pose.position and pose.orientation, or transforms."
    )


def _fix_among(names: Sequence[str]) -> list[str]:
    time = _time_among(names)
    if time is None or not set(_FIX[:2]) <= set(names):
        raise UsageError("geojson takes fixes: fields latitude and longitude.")
    return [time, *(name for name in _FIX if name in names)]


def _time_among(names: Sequence[str]) -> str | None:
    """The best column with the time of a row."""
    return next((name for name in _TIMES if name in names), None)


def _pose_columns(names: Sequence[str]) -> Iterator[list[str]]:
    """Seven columns for each pose, the shortest path first."""
    plain = [*"xyz", "qx", "qy", "qz", "qw"]
    if set(names).issuperset(plain):
        yield plain
    for position, rotation in poses_among(names):
        yield [f"{position}.{axis}" for axis in "xyz"] + [f"{rotation}.{axis}" for axis in "xyzw"]


def poses_among(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Paths above x, y and z of each pose, and above x, y, z and w of it; the shortest first."""
    known = set(names)
    for name in sorted(known, key=lambda one: (one.count("."), one)):
        for position, rotation in zip(POSITIONS, _ROTATIONS, strict=True):
            if name.endswith(f"{position}.x"):
                stem = name.removesuffix(f"{position}.x")
                pose = f"{stem}{position}", f"{stem}{rotation}"
                numbers = {f"{pose[0]}.{axis}" for axis in "xyz"}
                if known >= numbers | {f"{pose[1]}.{axis}" for axis in "xyzw"}:
                    yield pose


def _with_text_times(schema: pa.Schema) -> pa.Schema:
    """The columns with times as text, which Arrow writes as `2025-06-03 08:00:30.5Z`."""
    return pa.schema(
        [(one.name, pa.string() if pa.types.is_timestamp(one.type) else one.type) for one in schema]
    )


def _is_number(value: Any) -> bool:
    return value is not None and bool(np.isfinite(value))
