"""Messages come back from columns byte for byte, whatever their types and values are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlog.columns.clouds import PointField, PointLayout
from hybridlog.columns.payload_rows import TopicColumns
from hybridlog.schema.definition import parse_definition
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import Channel, Schema
from tests.data import DATA, needs_data
from tests.payloads.chunks import assert_exact, chunk_of, piece_of
from tests.payloads.logs import CLOUD, SCAN, cloud, scan, standard_channel
from tests.schema.test_wire import (
    CASE,
    SHAPES,
    bag_groups,
    definitions,
    make,
    mcap_groups,
    supported,
)


def channel_of(text: str, wire: str, name: str = "pkg/msg/T0") -> Channel:
    encoding = "ros1msg" if wire == "ros1" else "ros2msg"
    return Channel("/topic", wire, Schema(name, encoding, text.encode()))


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
@given(data=st.data(), shape=st.fixed_dictionaries(SHAPES), publish=st.booleans())
@settings(CASE, max_examples=30)
def test_messages_of_any_type_come_back(wire: str, data, shape, publish: bool) -> None:
    text = data.draw(definitions(wire))
    if not supported(text, wire):
        return
    _, payloads, _ = make(text, wire, **shape, big=wire == "cdr")
    channel = channel_of(text, wire)
    try:
        TopicColumns(channel)
    except DefinitionError:
        return
    assert_exact(channel, payloads, publish=publish)


def scan_channel() -> Channel:
    return standard_channel(SCAN)


def test_bytes_that_mean_nothing_come_back() -> None:
    """Padding, options of the encapsulation and trailing bytes are not zero."""
    payloads = [bytearray(scan([0.5] * n, frame="f" * n)) for n in (1, 3, 40)]
    for payload in payloads:
        payload[2:4] = b"\x00\x02"
        place = payload.index(b"f\x00") + 2
        if place % 4:
            payload[place] = 0x7E
    assert_exact(scan_channel(), [bytes(p) + b"\xa5\x5a" for p in payloads])


def test_both_byte_orders_may_share_a_chunk() -> None:
    payloads = [scan([n + 0.25] * (3 + n), big=n % 2 == 1) for n in range(6)]
    piece = assert_exact(scan_channel(), payloads)
    found = piece.table.column("ranges").to_pylist()
    assert found == [[n + 0.25] * (3 + n) for n in range(6)]
    assert_exact(scan_channel(), payloads[1::2])


def test_all_bits_of_floats_come_back() -> None:
    bits = np.array([0x7FC00001, 0xFF800001, 0x80000000, 0x00000001, 0x7F800000], np.uint32)
    piece = assert_exact(scan_channel(), [scan(bits.view(np.float32))] * 3)
    assert piece.table.column("angle_min").to_pylist() == [-1.5] * 3


def test_a_message_that_does_not_fit_has_no_columns() -> None:
    payloads = [scan([1.0]), scan([1.0])[:-3]]
    assert piece_of(TopicColumns(scan_channel()), chunk_of(payloads)) is None


FIELDS = st.lists(
    st.tuples(st.integers(0, 3), st.integers(1, 8), st.integers(1, 3)), min_size=1, max_size=5
)


def cloud_channel() -> Channel:
    return standard_channel(CLOUD)


SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}


@given(
    fields=FIELDS,
    tail=st.integers(0, 5),
    points=st.lists(st.integers(0, 20), min_size=1, max_size=4),
    big=st.booleans(),
    zero=st.booleans(),
    seed=st.integers(0, 1000),
)
@settings(CASE, max_examples=40)
def test_clouds_of_any_layout_come_back(fields, tail, points, big, zero, seed) -> None:
    random = np.random.default_rng(seed)
    layout, at = [], 0
    for number, (gap, kind, count) in enumerate(fields):
        layout.append((f"f{number}", at + gap, kind, count))
        at += gap + SIZES[kind] * count
    step = at + tail
    covered = np.zeros(step, np.bool_)
    for _, offset, kind, count in layout:
        covered[offset : offset + SIZES[kind] * count] = True
    payloads = []
    for many in points:
        data = np.frombuffer(random.bytes(many * step), np.uint8).reshape(many, step).copy()
        if zero:
            data[:, ~covered] = 0
        payloads.append(cloud(layout, step, data.tobytes(), big=big))
    piece = assert_exact(cloud_channel(), payloads)
    assert piece.layout is not None
    columns = piece.table.column("points").combine_chunks()
    name, offset, kind, count = layout[-1]
    dtype = np.dtype(
        (">" if big else "<") + ["", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"][kind]
    )
    data = payloads[-1][-1 - points[-1] * step : -1]
    expected = [np.frombuffer(data, dtype, count, n * step + offset) for n in range(points[-1])]
    found = columns.field(name).to_pylist()[-1]
    np.testing.assert_array_equal(found, np.concatenate(expected) if expected else [])
    paddings = piece.table.column("recipe").combine_chunks().field("padding").to_pylist()
    assert not zero or not any(paddings)


def test_clouds_that_are_not_their_points_stay_whole() -> None:
    xy = [("x", 0, 7, 1), ("y", 4, 7, 1)]
    whole = bytes(range(48))
    for odd in (
        [cloud(xy, 8, whole, pad=4, rows=2)],  # rows with padding of their own
        [cloud([*xy, ("z", 6, 7, 1)], 12, whole)],  # fields that overlap
        [cloud(xy, 6, whole)],  # a field outside of the points
        [cloud([("x", 0, 9, 1)], 8, whole)],  # an unknown type
        [cloud(xy, 8, whole), cloud(xy, 12, whole)],  # clouds that differ
        [cloud(xy, 8, whole), cloud([("x", 0, 7, 1), ("w", 4, 7, 1)], 8, whole)],
        [cloud(xy, 8, whole, big=False), cloud(xy, 8, whole, big=True)],
    ):
        piece = assert_exact(cloud_channel(), odd)
        assert piece.layout is None
        assert piece.table.column("data").to_pylist() == [whole] * len(odd)


def test_a_layout_that_contradicts_itself_is_refused() -> None:
    sound = PointLayout(8, (PointField("x", 0, "<f4", 1), PointField("y", 4, "<u2", 2)))
    assert PointLayout.from_json(sound.to_json()) == sound
    for wrong in (
        {"step": 4, "fields": [["x", 2, "<f4", 1]]},
        {"step": 8, "fields": [["x", 0, "<f4", 1], ["y", 2, "<f4", 1]]},
        {"step": 8, "fields": [["x", 0, "<U4", 1]]},
        {"step": 8, "fields": [["x", -4, "<f4", 1]]},
        {"step": 8, "fields": []},
        {"step": 1 << 40, "fields": [["x", 0, "<f4", 1]]},
    ):
        with pytest.raises(ValueError, match="contradicts"):
            PointLayout.from_json(wrong)


def bags() -> list[str]:
    return sorted(str(p.relative_to(DATA)) for p in (DATA / "real").glob("*.bag"))


@needs_data
@pytest.mark.parametrize("name", [*bags(), "real/ouster.mcap", "odd/every_sensor_msg_ros2.mcap"])
def test_real_messages_come_back(name: str) -> None:
    path = Path(DATA / name)
    if path.suffix == ".bag":
        groups = {
            (kind, "ros1msg", text.encode(), "ros1"): payloads
            for (kind, text), payloads in bag_groups(path).items()
        }
    else:
        groups = mcap_groups(path)
    tried = 0
    for (kind, encoding, text, wire), payloads in groups.items():
        channel = Channel("/topic", wire, Schema(kind, encoding, text))
        try:
            parse_definition(channel.schema)
            TopicColumns(channel)
        except DefinitionError:
            continue
        assert_exact(channel, [bytes(p) for p in payloads[:100]])
        tried += 1
    if not tried:
        pytest.skip("no message has arrays of numbers")
