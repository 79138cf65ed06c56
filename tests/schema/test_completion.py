"""Definitions of standard types, supplied where a source has none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from rosbags.typesys import Stores, get_typestore

from hybridlog.schema import ros_codec
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.definition import parse_definition, typestore
from hybridlog.schema.ros_codec import completed
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import REPLACED, SUPPLIED, Channel, Schema
from tests.calls import Calls
from tests.indexed import batch_of, groups_of, index_fields
from tests.ros_values import ROS1, message_of, same

DIFFERENT = [
    ("visualization_msgs/msg/Marker", "ROS2_FOXY"),
    ("visualization_msgs/msg/Marker", "ROS2_HUMBLE"),
    ("shape_msgs/msg/SolidPrimitive", "ROS2_FOXY"),
    ("shape_msgs/msg/SolidPrimitive", "ROS2_LYRICAL"),
    ("sensor_msgs/msg/Range", "ROS2_HUMBLE"),
    ("sensor_msgs/msg/Range", "ROS2_JAZZY"),
    ("rmw_dds_common/msg/Gid", "ROS2_GALACTIC"),
    ("rmw_dds_common/msg/Gid", "ROS2_IRON"),
    ("rosbag2_interfaces/msg/WriteSplitEvent", "ROS2_IRON"),
    ("rosbag2_interfaces/msg/WriteSplitEvent", "ROS2_KILTED"),
    # Nested in these.
    ("visualization_msgs/msg/MarkerArray", "ROS2_FOXY"),
    ("visualization_msgs/msg/InteractiveMarker", "ROS2_GALACTIC"),
]
NO_DEFINITIONS = [
    ("", b""),
    ("", b"string data"),
    ("ros2msg", b""),
    ("ros2msg", b" \n"),
    ("ros2msg", b"# see the wiki\n"),
    ("ros2msg", b"std_msgs/String"),
    ("ros2msg", b"std_msgs/msg/String\n"),
    ("ros2msg", b"A text that is sent by the robot.\n"),
    ("ros2idl", b"module std_msgs {"),
]


def cdr(name: str, schema: Schema | None = None, **metadata: str) -> Channel:
    return Channel("/t", "cdr", schema or Schema(name, "", b""), metadata)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def payload_of(name: str, release: str, seed: int = 1) -> tuple[Any, bytes]:
    store = get_typestore(Stores[release])
    message = message_of(store, name, rng(seed))
    return message, bytes(store.serialize_cdr(message, name))


@pytest.mark.parametrize(("name", "release"), DIFFERENT)
def test_the_release_that_fits_is_chosen(name: str, release: str) -> None:
    pairs = [payload_of(name, release, seed) for seed in range(5)]
    found = completed(cdr(name), [payload for _, payload in pairs])
    assert found.schema is not None
    expected = typestore(release).generate_msgdef(name, ros_version=2)[0].encode()
    assert parse_definition(found.schema) == parse_definition(Schema(name, "ros2msg", expected))
    assert found.metadata[SUPPLIED].endswith(", fits the messages")
    codec = codec_for(found)
    for message, payload in pairs:
        same(codec.decode(payload), message)
        read = codec.columns_of(batch_of(payload))
        assert not read.unreadable
        assert not len(read.surplus)
    proof = typestore(release).hash_rihs01(name)
    proved = completed(cdr(name, topic_type_hash=proof), [])
    assert proved.schema is not None
    assert parse_definition(proved.schema) == parse_definition(found.schema)
    assert proved.metadata["topic_type_hash"] == proof
    assert proved.metadata[SUPPLIED].endswith(", type hash")
    for other, is_supplied in (("1" * 64, False), ("0" * 64, True)):
        unknown = cdr(name, topic_type_hash=f"RIHS01_{other}")
        assert (completed(unknown, [pairs[0][1]]) is not unknown) == is_supplied


def test_an_md5_sum_proves_every_type_of_ros_1() -> None:
    for name in ROS1.fielddefs:
        if name.startswith("builtin_interfaces/"):
            continue
        short = name.replace("/msg/", "/")
        text, md5 = ROS1.generate_msgdef(name, ros_version=1)
        channel = Channel("/t", "ros1", Schema(short, "ros1msg", b""), {"md5sum": md5.upper()})
        found = completed(channel, [])
        assert found.schema == Schema(short, "ros1msg", text.encode())
        assert found.metadata[SUPPLIED] == "noetic, md5sum"
        assert codec_for(found).indexed


@pytest.mark.parametrize(("encoding", "data"), NO_DEFINITIONS)
def test_what_is_no_definition(encoding: str, data: bytes) -> None:
    message, payload = payload_of("std_msgs/msg/String", "ROS2_HUMBLE")
    for name in ("std_msgs/msg/String", "std_msgs/String"):
        found = completed(cdr(name, Schema(name, encoding, data)), [payload])
        assert found.schema == Schema(name, "ros2msg", b"string data\n")
        assert found.metadata.get(REPLACED, "") == (data.decode() if data.strip() else "")
        same(codec_for(found).decode(payload), message)
    encoding = "ros1msg" if encoding else ""
    ros1 = Channel("/t", "ros1", Schema("std_msgs/String", encoding, data))
    found = completed(ros1, [b"\2\0\0\0hi"])
    assert found.schema == Schema("std_msgs/String", "ros1msg", b"string data\n")


def test_a_message_that_is_empty_has_no_fields() -> None:
    for schema in (Schema("std_msgs/Empty", "", b""), Schema("std_msgs/Empty", "ros1msg", b"")):
        found = completed(Channel("/t", "ros1", schema), [b""])
        assert codec_for(found).indexed
        assert codec_for(found).paths() == []
    own = cdr("p/msg/T", Schema("p/msg/T", "ros2msg", b"# nothing\nuint8 A=1\n"))
    assert completed(own, [b"\0\1\0\0\0"]) is own
    assert index_fields(codec_for(own), b"\0\1\0\0\0\0\0\0") == {}
    (group,) = groups_of(codec_for(own), b"\0\1\0\0\5\0\0\0hallo")
    assert group.error is not None
    assert "8 bytes left over: the definition has no fields" in group.error


@pytest.mark.parametrize(
    "metadata",
    [
        {"md5sum": "1" * 32},
        {"md5sum": "0" * 32},
        {"md5sum": "*"},
        {},
    ],
)
def test_an_empty_definition_and_its_md5_sum(metadata: dict[str, str]) -> None:
    channel = Channel("/t", "ros1", Schema("p/T", "ros1msg", b""), metadata)
    assert completed(channel, [b"abc"]) is channel
    (group,) = groups_of(codec_for(channel), b"abc")
    assert "3 bytes left over: the definition has no fields" in str(group.error)
    # A type of this name, but another one than the standard type.
    channel = replace(channel, schema=Schema("std_msgs/String", "ros1msg", b""))
    found = completed(channel, [b"\1\0\0\0a"])
    assert (found is channel) == (
        len(metadata.get("md5sum", "0")) == 32 and "0" * 32 not in metadata.values()
    )


def test_work_on_large_messages_is_bounded(calls: Calls) -> None:
    seen: list[int] = []
    calls(ros_codec, "_fit", lambda _, __, payloads: seen.append(sum(map(len, payloads))))
    large = (3 << 20).to_bytes(4, "little") + bytes(3 << 20)
    bare = Channel("/t", "ros1", Schema("std_msgs/String", "", b""))
    assert completed(bare, [large] * 10) is not bare
    assert seen == [len(large)]
    completed(bare, [b"\1\0\0\0a"] * 1000)
    assert seen[1] <= 64 * 5


def test_what_stays_as_it_is() -> None:
    whole = cdr("", Schema("std_msgs/msg/String", "ros2msg", b"string mine\n"))
    assert completed(whole, [b"\0\1\0\0"]) is whole
    for channel in (
        Channel("/t", "cdr", None),
        Channel("/t", "json", Schema("std_msgs/msg/String", "", b"")),
        Channel("/t", "cdr", Schema("std_msgs/msg/String", "protobuf", b"")),
        cdr("p/msg/T"),
        cdr("../x"),
        cdr("String"),
        cdr(""),
    ):
        assert completed(channel, [b"\0\1\0\0\1\0\0\0\0"]) is channel
    unfit = cdr("std_msgs/msg/String")
    assert completed(unfit, [b"\0\1\0\0\xff\0\0\0\0", b"", b"\0\7\0\0"]) is unfit
    assert completed(unfit, []) is unfit
    name_only = Channel("/t", "cdr", Schema("p/msg/T", "ros2msg", b"p/T\n"))
    assert "is not a field" in str(codec_for(name_only).reason)


def test_an_odd_message_does_not_decide() -> None:
    payloads = [payload_of("shape_msgs/msg/SolidPrimitive", "ROS2_FOXY", s)[1] for s in range(4)]
    found = completed(cdr("shape_msgs/msg/SolidPrimitive"), [b"\0\1", payloads[0][:-3], *payloads])
    assert found.schema is not None
    assert b"polygon" not in found.schema.data
    padded = [payload + bytes(3) for payload in payloads]
    assert completed(cdr("shape_msgs/msg/SolidPrimitive"), padded).schema == found.schema


def test_types_that_cannot_be_read_are_not_supplied() -> None:
    broken = cdr("", Schema("p/msg/T", "ros2msg", b"wstring w\nvisualization_msgs/Marker m\n"))
    assert completed(broken, [b"\0\1\0\0"]) is broken
    with pytest.raises(DefinitionError):
        parse_definition(broken.schema or Schema("", "", b""))
