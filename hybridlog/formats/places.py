"""Writes where something was: poses for evo (TUM), fixes for maps (GeoJSON)."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from hybridlog.formats.writing import FileWriter, Sink, Target
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

_TIMES = ("header.stamp", "timestamp", "time", "log_time")
"""Columns with the time of a row, the best first."""
POSITIONS = ("position", "translation")
"""Fields with a place. The rotation beside it is of the same place in `_ROTATIONS`."""
_ROTATIONS = ("orientation", "rotation")
_FIX = ("latitude", "longitude", "altitude")


class _RowWriter(FileWriter):
    """Writes a line of text for each row."""

    def __init__(self, target: Target, *, schema: pa.Schema | None = None) -> None:
        super().__init__()
        if schema is not None:
            self._columns(schema.names)
        self._topics: set[str] = set()
        self._sink = Sink(target)

    def write(self, table: pa.Table) -> None:
        """Append rows; those without a place are left out.

        Raises:
            UsageError: The columns hold no such places, or those of several topics.
            DiskFullError: No space left.
        """
        if table.num_rows:
            if "topic" in table.column_names:
                self._topics.update(table["topic"].unique().to_pylist())
                if len(self._topics) > 1:
                    raise UsageError("A file has the places of one topic: name one.")
            self._write_rows(table, self._columns(table.column_names))

    def flush(self) -> None:
        """Write the rows so far."""
        self._sink.flush()

    def _columns(self, names: Sequence[str]) -> list[str]:
        raise NotImplementedError

    def _write_rows(self, table: pa.Table, columns: list[str]) -> None:
        raise NotImplementedError

    def _finish(self) -> None:
        self._sink.commit()

    def _discard(self) -> None:
        self._sink.abort()


class TumWriter(_RowWriter):
    """Writes poses as lines of `time x y z qx qy qz qw`, s and m, which evo reads."""

    def _columns(self, names: Sequence[str]) -> list[str]:
        time, pose = _time_among(names), next(_pose_columns(names), None)
        if time is not None and pose is not None:
            return [time, *pose]
        raise UsageError(
            "tum takes poses: fields such as pose.position and pose.orientation, or transforms."
        )

    def _write_rows(self, table: pa.Table, columns: list[str]) -> None:
        rows = table.select(columns).drop_null()
        times = rows[columns[0]].cast(pa.int64()).to_pylist()
        numbers = np.stack([rows[name].to_numpy() for name in columns[1:]], axis=1)
        lines = (
            f"{time // 10**9}.{time % 10**9:09d} {' '.join(map(repr, pose))}\n"
            for time, pose in zip(times, numbers.astype(np.float64).tolist(), strict=True)
        )
        self._sink.write("".join(lines).encode())


class GeoJsonWriter(_RowWriter):
    """Writes fixes as a collection of points (RFC 7946): longitude, latitude, altitude."""

    def __init__(self, target: Target, *, schema: pa.Schema | None = None) -> None:
        super().__init__(target, schema=schema)
        self._before = b'{"type": "FeatureCollection", "features": ['

    def _columns(self, names: Sequence[str]) -> list[str]:
        time = _time_among(names)
        if time is None or not set(_FIX[:2]) <= set(names):
            raise UsageError("geojson takes fixes: fields latitude and longitude.")
        return [time, *(name for name in _FIX if name in names)]

    def _write_rows(self, table: pa.Table, columns: list[str]) -> None:
        wanted = [
            name for name in (*columns, "status.status", "recording") if name in table.column_names
        ]
        chosen = table.select(wanted)
        for row in chosen.cast(_with_text_times(chosen.schema)).to_pylist():
            longitude, latitude = row.pop("longitude"), row.pop("latitude")
            place = [longitude, latitude, row.pop("altitude", None)]
            if not all(_is_number(one) for one in place[:2]):
                continue
            feature = {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": [*filter(_is_number, place)]},
                "properties": row,
            }
            self._sink.write(self._before + b"\n" + json.dumps(feature).encode())
            self._before = b","

    def _finish(self) -> None:
        if not self._before.startswith(b","):
            self._sink.write(self._before)
        self._sink.write(b"\n]}\n")
        super()._finish()


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
