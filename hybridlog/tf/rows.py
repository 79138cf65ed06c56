"""The transforms of messages as rows of a table."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.frames.answer import flat
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError


def transforms_of(table: pa.Table, topic: int, *, is_static: bool) -> pa.Table:
    """The transforms of messages as rows: times, frames, seven numbers, topic, `is_static`."""
    times = table["log_time"].combine_chunks().cast(pa.int64())
    columns = {name: table[name].combine_chunks() for name in table.column_names}
    if "transforms" in columns:
        times = times.take(pc.list_parent_indices(columns["transforms"]))
        columns = flat(columns["transforms"].flatten())
    is_foxglove = "parent_frame_id" in columns
    stamp, parent, pose = (
        ("timestamp", "parent_frame_id", "")
        if is_foxglove
        else ("header.stamp", "header.frame_id", "transform.")
    )
    names = {
        "parent": parent,
        "child": "child_frame_id",
        **{f"t{axis}": f"{pose}translation.{axis}" for axis in "xyz"},
        **{f"r{axis}": f"{pose}rotation.{axis}" for axis in "xyzw"},
    }
    if missing := [name for name in names.values() if name not in columns]:
        raise TopicError(f"Messages of transforms lack {listed(missing)}.")
    found = {"log_time": times, "stamp": _nanoseconds(columns, stamp)}
    for own, name in names.items():
        kind = pa.string() if own in {"parent", "child"} else pa.float64()
        found[own] = columns[name].cast(kind)
    found["topic"] = pa.repeat(pa.scalar(topic), len(times))
    found["is_static"] = pa.repeat(pa.scalar(is_static), len(times))
    return pa.table(found).drop_null()


def _nanoseconds(columns: Mapping[str, pa.Array], name: str) -> pa.Array:
    """Times in ns, from Arrow's own or from seconds and nanoseconds."""
    if name in columns:
        return columns[name].cast(pa.timestamp("ns", "UTC")).cast(pa.int64())
    parts = [
        next((f"{name}.{one}" for one in names if f"{name}.{one}" in columns), None)
        for names in (("sec", "seconds"), ("nsec", "nanos", "nanosec"))
    ]
    if None in parts:
        raise TopicError(f"Messages of transforms lack {name}.")
    seconds, rest = (columns[str(part)].cast(pa.int64()) for part in parts)
    return pc.add(pc.multiply(seconds, 10**9), rest)
