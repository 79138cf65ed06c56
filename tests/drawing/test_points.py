"""Points of scans and clouds, against readers that take each value by hand."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.arrays.message_arrays import point_columns
from hybridlog.drawing.points import Points, bounds, points
from hybridlog.message import Message
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import Channel, Schema

CODES = "?bBhHiIfd"


def points_of(kind: str, fields: Any, **options: Any) -> Points:
    return points(cast(Message, SimpleNamespace(type=kind, decode=lambda: fields)), **options)


def field(name: str, offset: int = 0, kind: int = 7, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=kind, count=count)


def cloud(
    described: list[tuple[str, int, int, int]],
    rows: list[list[bytes]],
    *,
    step: int,
    row_padding: int = 0,
    is_big: bool = False,
) -> SimpleNamespace:
    """A PointCloud2 of rows of points, which are bytes already."""
    data = b"".join(b"".join(row) + b"\xa5" * row_padding for row in rows)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="lidar"),
        height=len(rows),
        width=len(rows[0]),
        point_step=step,
        row_step=step * len(rows[0]) + row_padding,
        is_bigendian=is_big,
        fields=[field(*one) for one in described],
        data=np.frombuffer(data, np.uint8),
    )


def packed(step: int, is_big: bool, parts: list[tuple[int, int, list[Any]]]) -> bytes:
    """A point: offset, datatype and elements of each field; the rest is no zero."""
    point = bytearray(b"\xa5" * step)
    for offset, kind, elements in parts:
        form = f"{'>' if is_big else '<'}{len(elements)}{CODES[kind]}"
        struct.pack_into(form, point, offset, *elements)
    return bytes(point)


def simple(xyz: list[tuple[float, ...]], **more: Any) -> SimpleNamespace:
    """A cloud of float32 x, y and z."""
    made = cloud(
        [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)],
        [[struct.pack("<3f", *one) for one in xyz]],
        step=12,
    )
    made.__dict__.update(more)
    return made


@st.composite
def layouts(draw: st.DrawFn) -> tuple[Any, list[dict[str, Any]]]:
    """A PointCloud2 in any layout, and the values of each of its points."""
    others = draw(st.lists(st.sampled_from(["intensity", "ring", "t", "noise"]), unique=True))
    names = draw(st.permutations(["x", "y", "z", *others]))
    offset, described = 0, []
    for name in names:
        offset += draw(st.integers(0, 5))
        kind = draw(st.integers(1, 8))
        count = 1 if name in {"x", "y", "z"} else draw(st.sampled_from([0, 1, 1, 3]))
        described.append((name, offset, kind, count))
        offset += max(count, 1) * struct.calcsize(CODES[kind])
    step, is_big = offset + draw(st.integers(0, 5)), draw(st.booleans())
    height, width = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    values, rows = [], []
    for _ in range(height):
        row = []
        for _ in range(width):
            point, parts = {}, []
            for name, at, kind, count in described:
                elements = [_number(draw, kind) for _ in range(max(count, 1))]
                parts.append((at, kind, elements))
                several = {f"{name}[{place}]": value for place, value in enumerate(elements)}
                point |= several if count > 1 else {name: elements[0]}
            row.append(packed(step, is_big, parts))
            values.append(point)
        rows.append(row)
    padding = draw(st.integers(0, 7)) if height > 1 else 0
    shuffled = draw(st.permutations(described))
    return cloud(shuffled, rows, step=step, row_padding=padding, is_big=is_big), values


def _number(draw: st.DrawFn, kind: int) -> float:
    code = CODES[kind]
    if code in "fd":
        common = st.floats(-500, 500, width=32)
        return draw(st.one_of(common, common, st.sampled_from([math.nan, math.inf, -math.inf])))
    bits = 8 * struct.calcsize(code)
    least = 0 if code.isupper() else -(2 ** (bits - 1))
    return draw(st.integers(least, least + 2**bits - 1))


@given(layouts())
def test_clouds_of_any_layout(made: tuple[Any, list[dict[str, Any]]]) -> None:
    message, wanted = made
    got = points_of("sensor_msgs/PointCloud2", message)
    kept = [one for one in wanted if all(math.isfinite(one[axis]) for axis in "xyz")]
    assert got["total"] == len(wanted)
    assert got["dropped"] == ({"not finite": len(wanted) - len(kept)} if kept != wanted else {})
    assert len(got["xyz"]) == len(kept)
    assert set(got["names"]) == set(wanted[0]) - {"x", "y", "z"}
    for place, axis in enumerate("xyz"):
        there = got["xyz"][:, place].astype(float) + got["origin"][place]
        _same(there, [float(one[axis]) for one in kept])
    for name in got["names"]:
        assert np.array_equal(got["values"][name], [float(p[name]) for p in kept], equal_nan=True)


def _same(found: Any, wanted: list[float]) -> None:
    finite = [one for one in wanted if math.isfinite(one)]
    spread = max(finite) - min(finite) if finite else 0.0
    # As exact as float32 can tell two values apart, among these or on its own.
    nearest = max((abs(one) for one in finite), default=0.0)
    close = max(spread * 2.0**-10, 1e-3 if nearest < 8192 else nearest * 2.0**-22)
    assert np.allclose(found, wanted, rtol=0, atol=close, equal_nan=True)


@pytest.mark.parametrize("kind", [6, 7])
@pytest.mark.parametrize("is_big", [False, True])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
def test_packed_colours(name: str, is_big: bool, kind: int) -> None:
    order = ">" if is_big else "<"
    rows = [
        struct.pack(f"{order}3fI", 1, 2, 3, (alpha << 24) | colour)
        for alpha, colour in ((255, 0xFF8001), (0, 0x010203), (127, 0))
    ]
    described = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), (name, 12, kind, 1)]
    got = points_of("sensor_msgs/msg/PointCloud2", cloud(described, [rows], step=16, is_big=is_big))
    assert got["names"] == ("rgb",)
    assert got["values"]["rgb"].tolist() == [0xFF8001, 0x010203, 0]


def test_many_points_are_thinned_after_the_invalid_ones() -> None:
    xyz = [(math.nan if place % 3 == 0 else place, 0.0, 1.0) for place in range(3000)]
    got = points_of("sensor_msgs/PointCloud2", simple(xyz), limit=500)
    valid = [x for x, *_ in xyz if not math.isnan(x)]
    assert (got["total"], got["dropped"], got["every"]) == (3000, {"not finite": 1000}, 4)
    assert got["xyz"][:, 0].tolist() == valid[::4]
    assert points_of("sensor_msgs/PointCloud2", simple(xyz), limit=2000)["every"] == 1
    assert points_of("sensor_msgs/PointCloud2", simple(xyz), limit=1999)["every"] == 2


def test_far_from_the_origin_keeps_millimetres() -> None:
    # Coordinates of a map in UTM; times as seconds since the epoch.
    rows = [
        struct.pack("<4d", 448_262.001 + at / 1000, 5_411_932.678, 300.0, 1_700_000_000 + at / 1000)
        for at in range(10)
    ]
    described = [(name, 8 * at, 8, 1) for at, name in enumerate(("x", "y", "z", "stamp"))]
    got = points_of("sensor_msgs/PointCloud2", cloud(described, [rows], step=32))
    assert got["origin"][2] == 0
    there = got["xyz"].astype(float) + got["origin"]
    assert np.abs(there[:, 0] - [448_262.001 + at / 1000 for at in range(10)]).max() < 1e-4
    assert np.abs(there[:, 1] - 5_411_932.678).max() < 1e-4
    assert got["values"]["stamp"].tolist() == [1_700_000_000 + at / 1000 for at in range(10)]


def test_values_that_float32_cannot_hold_are_not_finite() -> None:
    rows = [struct.pack("<3d", x, 1, 2) for x in (1e300, 5, -1e39)]
    described = [(name, 8 * at, 8, 1) for at, name in enumerate("xyz")]
    got = points_of("sensor_msgs/PointCloud2", cloud(described, [rows], step=24))
    assert got["dropped"] == {"not finite": 2}
    assert got["xyz"].tolist() == [[5, 1, 2]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "has rows of"),
        ({"fields": []}, "has no x, y and z"),
        ({"fields": [field("x")]}, "no x, y and z; its fields are x"),
        ({"fields": [field("x", count=2), field("y")]}, "not single numbers"),
        ({"fields": [field("x", kind=2)] * 257}, "more than 256 fields"),
    ],
)
def test_damaged_clouds(change: dict[str, Any], message: str) -> None:
    damaged = simple([(1, 2, 3)] * 3, **change)
    with pytest.raises(PayloadError, match=message):
        points_of("sensor_msgs/PointCloud2", damaged)


def test_empty_messages() -> None:
    got = points_of("sensor_msgs/PointCloud2", simple([(1, 2, 3)], width=0, fields=[]))
    assert (got["total"], got["xyz"].shape, got["frame"]) == (0, (0, 3), "lidar")
    assert bounds(got["xyz"][:, 0]) is None


def test_old_clouds() -> None:
    message = SimpleNamespace(
        header=SimpleNamespace(frame_id="old"),
        points=[SimpleNamespace(x=1, y=2, z=3), SimpleNamespace(x=math.nan, y=0, z=0)],
        channels=[SimpleNamespace(name="intensity", values=np.array([5, 6], np.float32))],
    )
    got = points_of("sensor_msgs/PointCloud", message)
    assert got["xyz"].tolist() == [[1, 2, 3]]
    assert got["values"]["intensity"].tolist() == [5]
    assert got["frame"] == "old"
    message.channels *= 257
    with pytest.raises(PayloadError, match="more than 256 channels"):
        points_of("sensor_msgs/PointCloud", message)


def scan(ranges: list[float], intensities: list[float] | None = None, **more: Any) -> Any:
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="laser"),
        angle_min=-1.5,
        angle_increment=0.5,
        range_min=0.25,
        range_max=8.0,
        ranges=np.array(ranges, np.float32),
        intensities=np.array(intensities or [], np.float32),
        **more,
    )


def test_scans() -> None:
    ranges = [1.0, 0.25, 8.0, math.nan, math.inf, -math.inf, 0.125, 8.5, -1.0, 2.0]
    got = points_of("sensor_msgs/msg/LaserScan", scan(ranges, [*map(float, range(10))]))
    kept = [0, 1, 2, 9]
    wanted = [
        (ranges[n] * math.cos(-1.5 + n / 2), ranges[n] * math.sin(-1.5 + n / 2), 0) for n in kept
    ]
    assert np.allclose(got["xyz"], wanted, rtol=0, atol=1e-6)
    assert got["dropped"] == {"not finite": 3, "out of range": 3}
    assert got["total"] == 10
    assert got["flat"]
    assert got["frame"] == "laser"
    assert got["names"] == ("range", "intensity", "angle")
    assert got["values"]["intensity"].tolist() == kept
    assert got["values"]["range"].tolist() == [1, 0.25, 8, 2]


POSE = {
    "position": {"x": 10.0, "y": 20.0, "z": 0.5},
    # A quarter to the left, not normalised.
    "orientation": {"x": 0.0, "y": 0.0, "z": 3.0, "w": 3.0},
}
CLOUD_BYTES = struct.pack("<3fH", 1, 2, 3, 7) + struct.pack("<3fH", 4, 5, math.nan, 8)


def foxglove_cloud(data: Any) -> dict[str, Any]:
    names = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 12, 3))
    return {
        "timestamp": {"sec": 1, "nsec": 2},
        "frame_id": "base",
        "pose": POSE,
        "point_stride": 14,
        "fields": [{"name": n, "offset": at, "type": kind} for n, at, kind in names],
        "data": data,
    }


def foxglove_scan() -> dict[str, Any]:
    return {
        "frame_id": "base",
        "pose": POSE,
        "start_angle": 0.0,
        "end_angle": math.pi,
        "ranges": [1.0, 2.0, 3.0],
        "intensities": [4.0, 5.0, 6.0],
    }


def foxglove_messages() -> list[tuple[Channel, bytes]]:
    """A scan and a cloud in protobuf, made by Foxglove's own SDK, and in JSON."""
    from foxglove import messages as made

    pose = made.Pose(
        position=made.Vector3(**POSE["position"]),
        orientation=made.Quaternion(**POSE["orientation"]),
    )
    wanted = foxglove_cloud(CLOUD_BYTES)
    kinds = {7: "Float32", 3: "Uint16"}
    sdk_cloud = made.PointCloud(
        frame_id="base",
        pose=pose,
        point_stride=14,
        fields=[
            made.PackedElementField(
                name=f["name"],
                offset=f["offset"],
                type=getattr(made.PackedElementFieldNumericType, kinds[f["type"]]),
            )
            for f in wanted["fields"]
        ],
        data=CLOUD_BYTES,
    )
    sdk_scan = made.LaserScan(**{**foxglove_scan(), "pose": pose})
    found = []
    for topic, one in (("/cloud", sdk_cloud), ("/scan", sdk_scan)):
        schema = type(one).get_schema()
        described = Schema(schema.name, "protobuf", schema.data)
        found.append((Channel(f"/protobuf{topic}", "protobuf", described), one.encode()))
    as_text = base64.b64encode(CLOUD_BYTES).decode()
    for topic, kind, value in (
        ("/cloud", "foxglove.PointCloud", foxglove_cloud(as_text)),
        ("/cloud_list", "foxglove.PointCloud", foxglove_cloud(list(CLOUD_BYTES))),
        ("/scan", "foxglove.LaserScan", foxglove_scan()),
    ):
        schema = Schema(kind, "jsonschema", b"{}")
        found.append((Channel(f"/json{topic}", "json", schema), json.dumps(value).encode()))
    return found


def test_foxglove_messages_in_a_store(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("foxglove") as recorder:
            for channel, payload in foxglove_messages():
                recorder.write(channel, payload, log_time=10**18)
        for encoding in ("protobuf", "json"):
            (message,) = store.topic(f"/{encoding}/cloud")
            got = points(message)
            assert np.allclose(got["xyz"], [[10 - 2, 20 + 1, 3.5]], rtol=0, atol=1e-5)
            assert got["values"]["ring"].tolist() == [7]
            assert (got["frame"], got["total"], got["dropped"]) == ("base", 2, {"not finite": 1})
            (message,) = store.topic(f"/{encoding}/scan")
            got = points(message)
            wanted = [(10, 21, 0.5), (8, 20, 0.5), (10, 17, 0.5)]
            assert np.allclose(got["xyz"], wanted, rtol=0, atol=1e-5)
            assert got["values"]["intensity"].tolist() == [4, 5, 6]
            assert got["flat"]
            assert message.to_numpy()["angle"].tolist() == pytest.approx([0, math.pi / 2, math.pi])
        (message,) = store.topic("/json/cloud_list")
        assert points(message)["values"]["ring"].tolist() == [7]


def test_damaged_foxglove_clouds() -> None:
    for change, message in (
        ({"data": CLOUD_BYTES[:-1]}, "27 bytes, which is no whole number"),
        ({"point_stride": 0}, "ends at byte"),
        ({"point_stride": 0, "fields": []}, "no whole number"),
        ({"data": "no base64!"}, "unusual fields"),
        ({"data": [300]}, "unusual fields"),
        ({"pose": {"position": {"x": "far"}}}, "unusual fields"),
        ({"fields": [{"name": "x", "offset": 0, "type": 0}]}, "unknown type 0"),
    ):
        with pytest.raises(PayloadError, match=message):
            points_of("foxglove.PointCloud", foxglove_cloud(CLOUD_BYTES) | change)
    # Where nothing was set, JSON has no fields and protobuf has zeros, which turn nothing.
    got = points_of("foxglove.PointCloud", foxglove_cloud(CLOUD_BYTES) | {"pose": {"position": {}}})
    assert got["xyz"].tolist() == [[1, 2, 3]]
    nothing = {name: dict.fromkeys(part, 0.0) for name, part in POSE.items()}
    got = points_of("foxglove_msgs/msg/PointCloud", foxglove_cloud(CLOUD_BYTES) | {"pose": nothing})
    assert got["xyz"].tolist() == [[1, 2, 3]]


def test_other_types() -> None:
    with pytest.raises(PayloadError, match=r"nav_msgs/Odometry has no points; .*PointCloud2"):
        points_of("nav_msgs/Odometry", SimpleNamespace())


def test_columns_have_the_byte_order_of_this_machine() -> None:
    given = np.array([(1, 2)], [("x", ">f4"), ("y", ">f8")])
    assert [pa.array(one).to_pylist() for one in point_columns(given).values()] == [[1], [2]]
