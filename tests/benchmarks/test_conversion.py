"""The decoder of the databases, against a serializer of the test's own and real logs."""

from __future__ import annotations

import json
import math
import struct
from base64 import b64decode, b64encode
from collections.abc import Callable
from datetime import datetime
from typing import Any

import bson
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.backends.conversion import converter_for, iso_text, without_nul
from hybridlog.formats.detect import open_source
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.index_bodies import index_fields
from hybridlog_storage.messages import Channel, Schema
from tests.data import DATA, needs_data

T = 1_436_866_013_589_123_456

INTEGERS = {
    f"{'u' * u}int{8 << n}": "bhiq"[n].upper() if u else "bhiq"[n] for u in (0, 1) for n in range(4)
}


def ros1(definition: str, name: str = "t_msgs/T") -> Channel:
    return Channel("/t", "ros1", Schema(name, "ros1msg", definition.encode()))


def cdr(definition: str, encoding: str = "ros2msg") -> Channel:
    return Channel("/t", "cdr", Schema("t_msgs/msg/T", encoding, definition.encode()))


def documents(channel: Channel, payload: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """What MongoDB and what the others get, without `_meta`."""
    converter = converter_for(channel)
    assert converter.reason is None, converter.reason
    found = converter.document(T, payload), json.loads(converter.text(T, payload))
    for document in found:
        assert document.pop("_meta")["t"] == T
    bson.encode(found[0])
    return found


def integer(kind: str) -> st.SearchStrategy[Any]:
    bits = int(kind.partition("int")[2])
    low = 0 if kind.startswith("u") else -(1 << (bits - 1))
    return st.integers(low, low + (1 << bits) - 1)


SCALARS: dict[str, tuple[st.SearchStrategy[Any], Callable[[Any], bytes]]] = {
    **{
        kind: (integer(kind), lambda value, code=code: struct.pack(f"<{code}", value))
        for kind, code in INTEGERS.items()
    },
    "float32": (st.floats(width=32), lambda value: struct.pack("<f", value)),
    "float64": (st.floats(), lambda value: struct.pack("<d", value)),
    "bool": (st.booleans(), lambda value: bytes([value])),
    "string": (
        st.text(),
        lambda value: struct.pack("<I", len(value.encode())) + value.encode(),
    ),
    "time": (
        st.tuples(st.integers(0, (1 << 31) - 1), st.integers(0, 999_999_999)),
        lambda value: struct.pack("<II", *value),
    ),
}


@st.composite
def fields(draw: st.DrawFn) -> tuple[str, int | None, bool, Any]:
    """Type, fixed width, whether an array, value."""
    kind = draw(st.sampled_from(sorted(SCALARS)))
    strategy = SCALARS[kind][0]
    if draw(st.booleans()):
        return kind, None, False, draw(strategy)
    width = draw(st.none() | st.integers(1, 4))
    sizes = (0, 5) if width is None else (width, width)
    return kind, width, True, draw(st.lists(strategy, min_size=sizes[0], max_size=sizes[1]))


def plain(kind: str, value: Any, *, is_json: bool) -> Any:
    """What a single value should become."""
    if kind == "time":
        return {"secs": value[0], "nsecs": value[1]}
    if kind == "uint64" and not is_json and value >= 1 << 63:
        return float(value)
    if isinstance(value, float) and is_json and not math.isfinite(value):
        return None
    return value


def shortest(value: float | None) -> float | None:
    """The double that JSON's shortest text of a float32 is."""
    return None if value is None else float(str(np.float32(value)))


def same(one: Any, other: Any) -> bool:
    """Equality in which NaN equals itself and 1 is not True."""
    return repr(one) == repr(other)


@given(st.lists(fields(), max_size=6))
def test_every_kind_of_field(drawn: list[tuple[str, int | None, bool, Any]]) -> None:
    definition, payload = [], b""
    wanted: tuple[dict[str, Any], dict[str, Any]] = ({}, {})
    for number, (kind, width, is_array, value) in enumerate(drawn):
        name = f"f{number}"
        pack = SCALARS[kind][1]
        brackets = f"[{'' if width is None else width}]" if is_array else ""
        definition.append(f"{kind}{brackets} {name}")
        if is_array and width is None:
            payload += struct.pack("<I", len(value))
        payload += b"".join(map(pack, value if is_array else [value]))
        for is_json, document in enumerate(wanted):
            if is_array and kind == "uint8":
                octets = bytes(value)
                document[name] = b64encode(octets).decode() if is_json else octets
            elif is_array:
                document[name] = [
                    shortest(item) if kind == "float32" and is_json else item
                    for item in (plain(kind, item, is_json=bool(is_json)) for item in value)
                ]
            else:
                document[name] = plain(kind, value, is_json=bool(is_json))
    channel = ros1("\n".join(definition) + "\n")
    found = documents(channel, payload)
    assert same(found[0], wanted[0])
    assert same(found[1], wanted[1])


def test_nested_messages_of_ros1() -> None:
    channel = ros1(
        "Header header\nPart[] parts\nPart[2] two\n"
        + "=" * 80
        + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
        + "=" * 80
        + "\nMSG: t_msgs/Part\nfloat32 from\nduration[] waits\n"
    )
    part = struct.pack("<fIii", 0.5, 1, -3, 4)
    payload = struct.pack("<IIII", 9, 5, 6, 1) + b"x" + struct.pack("<I", 1) + part * 3
    wanted = {
        "header": {"seq": 9, "stamp": {"secs": 5, "nsecs": 6}, "frame_id": "x"},
        "parts": [{"from": 0.5, "waits": [{"secs": -3, "nsecs": 4}]}],
    }
    wanted["two"] = wanted["parts"] * 2
    assert documents(channel, payload) == (wanted, wanted)


@pytest.mark.parametrize("order", ["<", ">"])
def test_cdr_in_both_byte_orders(order: str) -> None:
    channel = cdr("uint8 a\nbuiltin_interfaces/Time stamp\nfloat64[] values\n")
    head = bytes([0, order == "<", 0, 0])
    payload = head + struct.pack(f"{order}B3xiIIdd", 7, 5, 6, 2, 1.5, -2.0)
    wanted = {"a": 7, "stamp": {"secs": 5, "nsecs": 6}, "values": [1.5, -2.0]}
    assert documents(channel, payload) == (wanted, wanted)


def test_idl() -> None:
    definition = (
        "=" * 80
        + "\nIDL: t_msgs/msg/T\n"
        + "module t_msgs { module msg { struct T { t_msgs::msg::Part part; }; }; };\n"
        + "=" * 80
        + "\nIDL: t_msgs/msg/Part\n"
        + "module t_msgs { module msg { struct Part { int32 number; }; }; };\n"
    )
    wanted = {"part": {"number": 5}}
    payload = struct.pack("<4Bi", 0, 1, 0, 0, 5)
    assert documents(cdr(definition, "ros2idl"), payload) == (wanted, wanted)


def test_a_standard_type_that_is_referred_to_only() -> None:
    channel = ros1("geometry_msgs/Point where\n")
    wanted = {"where": {"x": 1.0, "y": 2.0, "z": 3.0}}
    assert documents(channel, struct.pack("<3d", 1, 2, 3)) == (wanted, wanted)


@pytest.mark.parametrize(
    "channel",
    [
        Channel("/t", "ros1", None),
        Channel("/t", "json", Schema("T", "jsonschema", b"{}")),
        Channel("/t", "cdr", Schema("t_msgs/T", "ros1msg", b"int32 a\n")),
        ros1(""" "'; import os\n"""),
        ros1("t_msgs/Unknown a\n"),
        ros1("t_msgs/T again\n"),
        ros1(
            "A[1000000] a\n"
            + "=" * 80
            + "\nMSG: t_msgs/A\nB[1000000] b\n"
            + "=" * 80
            + "\nMSG: t_msgs/B\nint8[] c\n"
        ),
    ],
    ids=["none", "json", "mixed", "nonsense", "unknown", "recursive", "enormous"],
)
def test_what_cannot_be_decoded_is_kept_whole(channel: Channel) -> None:
    converter = converter_for(channel)
    assert converter.reason
    assert converter.document(T, b"\0\1")["data"] == b"\0\1"
    assert b64decode(json.loads(converter.text(T, b"\0\1"))["data"]) == b"\0\1"


def test_a_message_that_does_not_fit_is_kept_whole() -> None:
    converter = converter_for(ros1("string text\n"))
    for payload in (b"", b"\xff\xff\xff\xff", struct.pack("<I", 1) + b"\xff", bytes(9)):
        assert set(converter.document(T, payload)) == {"data", "_meta"}
        assert converter.document(T, payload)["data"] == payload
        assert b64decode(json.loads(converter.text(T, payload))["data"]) == payload


def test_times_are_dates_in_milliseconds() -> None:
    channel = ros1("int32 a\n")
    meta = converter_for(channel).document(T, bytes(4))["_meta"]
    assert meta == {"inserted_at": datetime(2015, 7, 14, 9, 26, 53, 589_000), "t": T}
    assert iso_text(T) == "2015-07-14T09:26:53.589Z"
    assert iso_text(0) == "1970-01-01T00:00:00.000Z"
    assert iso_text((1 << 63) - 1) == "2262-04-11T23:47:16.854Z"


@given(st.text())
def test_null_characters_are_replaced_and_nothing_else(text: str) -> None:
    encoded = json.dumps({"a": [text], "b\\u0000": 1})
    found = json.loads(without_nul(encoded))
    assert found == {"a": [text.replace("\0", "\ufffd")], "b\\u0000": 1}


def test_fields_of_the_appendix_are_found_where_they_are_numbers() -> None:
    point = "\n" + "=" * 80 + "\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    assert converter_for(ros1("float64 position\n")).indexed == (("position",),)
    assert converter_for(ros1("float64[] position\n")).indexed == ()
    assert converter_for(ros1("string position\n")).indexed == ()
    assert converter_for(ros1("geometry_msgs/Point position" + point)).indexed == (("position.x",),)
    assert converter_for(ros1("geometry_msgs/Point[] position" + point)).indexed == ()
    assert converter_for(
        ros1("geometry_msgs/PoseStamped a\ngeometry_msgs/Pose pose\n")
    ).indexed == (("pose.position.x", "pose.position.y", "pose.position.z"),)


@needs_data
@pytest.mark.parametrize(
    "log",
    ["real/robot_localization_test1.bag", "real/auv_ros2.mcap", "odd/every_sensor_msg_ros2.mcap"],
)
def test_real_messages_say_what_hybridlog_reads_in_them(log: str) -> None:
    """Numbers and texts at the top of a message, as another decoder sees them."""
    compared = 0
    with open_source(DATA / log) as source:
        for batch in source.batches():
            for row in range(0, len(batch), 7):
                channel = source.channels[int(batch.channel[row])]
                payload = bytes(batch.payload(row))
                document = converter_for(channel).document(T, payload)
                for name, value in index_fields(codec_for(channel), payload).items():
                    if isinstance(value, bool | int | float | str) and not isinstance(
                        document[name], dict
                    ):
                        assert same(document[name], value), (channel.topic, name)
                        compared += 1
            if compared > 500:
                break
    assert compared > 10
