"""Codecs against rosbags, json and protobuf themselves."""

from __future__ import annotations

import io
import json
import math
import struct
import sys
from typing import Any

import bson
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bson.int64 import Int64
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.schema.codec import Codec, no_messages
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.errors import DefinitionError, PayloadError
from hybridlog_storage.messages import Channel, Schema
from tests.indexed import batch_of, groups_of, index_fields
from tests.schema.test_document import assert_same_but_for_rounded_means, document_of


def bodies_of(codec: Codec, payloads: list[bytes]) -> list[bytes | str]:
    found: dict[int, bytes | str] = {}
    for group in groups_of(codec, *payloads):
        assert len(group.rows) == len(group.body)
        if group.error is not None:
            assert group.body.shape[1] == 0
        for row, body in zip(group.rows.tolist(), group.body, strict=True):
            assert row not in found
            found[row] = body.tobytes() if group.error is None else group.error
    assert sorted(found) == list(range(len(payloads)))
    return [found[row] for row in range(len(payloads))]


def check(body: bytes | str, expected: dict[str, Any]) -> None:
    assert isinstance(body, bytes), body
    assert_same_but_for_rounded_means(document_of(body), expected)


# --- ROS: faults ----------------------------------------------------------------------


def ros1(text: str, name: str = "pkg/T") -> Codec:
    return codec_for(Channel("/t", "ros1", Schema(name, "ros1msg", text.encode())))


def test_invalid_utf8_is_mended_in_the_index() -> None:
    codec = ros1("string s\nuint8 v")
    payload = b"\x03\0\0\0a\xff\xc3\x07"
    assert index_fields(codec, payload) == {"s": "a\ufffd\ufffd", "v": 7}
    with pytest.raises(PayloadError, match=r"\.raw"):
        codec.decode(payload)


@pytest.mark.parametrize("surplus", [b"\0", b"\xff" * 20])
def test_objects_of_payloads_with_bytes_left_over(surplus: bytes) -> None:
    plain = ros1("uint8[] data\nuint16 n")
    found: Any = plain.decode(b"\x02\0\0\0\x07\x08\x01\x02" + surplus)
    assert (found.data.tolist(), found.n) == ([7, 8], 0x201)
    schema = Schema("T", "ros2msg", b"string s\nuint16 n")
    for order in "<>":
        body = (b"\0\1" if order == "<" else b"\0\0") + b"\0\0"
        body += struct.pack(f"{order}I3sxH", 3, b"hi", 9)
        found = codec_for(Channel("/t", "cdr", schema)).decode(body + surplus)
        assert (found.s, found.n) == ("hi", 9)
    with pytest.raises(PayloadError, match="does not fit"):
        plain.decode(b"\x02\0\0\0\x07\x08\x01")
    batch = batch_of(b"\0\0\0\0\1\2", b"\0\0\0\0\1\2" + surplus)
    assert plain.columns_of(batch).surplus.tolist() == [1]


def test_arrays_without_elements() -> None:
    rule = "=" * 80
    codec = ros1(
        "uint8[0] a\nuint8 b\nfloat64[0] c\nstring[0] d\nSub[0] e\nSub[] f\ntime[0] g\nint16 h\n"
        f"{rule}\nMSG: pkg/Sub\nuint8[0] z\nint8 w\n"
    )
    payload = struct.pack("<BI2bh", 7, 2, 1, 2, -3)
    inner = [{"z": [], "w": 1}, {"z": [], "w": 2}]
    wanted = {"a": [], "b": 7, "c": [], "d": [], "e": [], "f": inner, "g": [], "h": -3}
    assert index_fields(codec, payload) == wanted
    for count in (1, 20):
        found = codec.columns_of(batch_of(*[payload] * count))
        table = pa.Table.from_struct_array(found.arrow())
        stream = io.BytesIO()
        pq.write_table(table, stream)
        assert pq.read_table(stream).to_pylist() == table.to_pylist() == [wanted] * count
    decoded: Any = codec.decode(payload)
    assert (decoded.b, len(decoded.a), len(decoded.f), decoded.h) == (7, 0, 2, -3)


@pytest.mark.parametrize(
    ("encoding", "schema", "reason"),
    [
        ("ros1", None, "no definition"),
        ("cdr", Schema("pkg/msg/T", "", b""), "pkg/msg/T: no definition"),
        ("cdr", Schema("T", "ros2msg", b"wstring s"), "wstring"),
        ("cdr", Schema("T", "ros2msg", b"T again"), "itself"),
        ("ros1", Schema("T", "ros1msg", b"int32 x=__import__('os')"), None),
        ("ros1", Schema("T", "ros1msg", b"int32 x; import os"), "T"),
        ("ros1", Schema("T", "ros2msg", b"int32 x"), "'ros2msg'"),
        ("protobuf", Schema("T", "protobuf", b"\xff\xff"), "malformed"),
        ("protobuf", Schema("T", "protobuf", b""), "does not say"),
        ("cbor", None, "'cbor' is stored and fetched, not indexed"),
        ("", None, "without an encoding"),
    ],
)
def test_what_cannot_be_read_is_opaque_and_says_why(
    encoding: str, schema: Schema | None, reason: str | None
) -> None:
    codec = codec_for(Channel("/t", encoding, schema))
    if reason is None:  # a constant
        assert codec.paths() == []
        assert codec.indexed
        return
    assert not codec.indexed
    assert reason in str(codec.reason)
    assert bodies_of(codec, [b"abc", b""]) == [b"", b""]
    assert index_fields(codec, b"abc") == {}
    assert codec.paths() == []
    with pytest.raises(DefinitionError, match="raw"):
        codec.decode(b"abc")
    with pytest.raises(DefinitionError):
        codec.columns_of(batch_of(b"abc"))


def test_objects_of_hostile_definitions() -> None:
    odd = codec_for(Channel("/t", "ros1", Schema("pkg/T'; x", "ros1msg", b"int32 x")))
    if odd.indexed:
        with pytest.raises(DefinitionError, match="not a valid type name"):
            odd.decode(bytes(4))
    with pytest.raises(DefinitionError, match="raw"):
        ros1("string[20000] s").decode(b"")
    with pytest.raises(DefinitionError, match="raw"):
        ros1("int32 from\nint32 from_").decode(bytes(8))


# --- JSON -----------------------------------------------------------------------------

JSON = codec_for(Channel("/j", "json", None))


def indexed(text: str | bytes) -> dict[str, object]:
    payload = text.encode() if isinstance(text, str) else text
    (body,) = bodies_of(JSON, [payload])
    assert isinstance(body, bytes), body
    assert bson.encode(index_fields(JSON, payload)) == document_of(body)
    return index_fields(JSON, payload)


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(1 << 63), (1 << 63) - 1)
    | st.floats(allow_nan=False)
    | st.just(math.nan)
    | st.text(),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=3), inner
        )
    ),
    max_leaves=10,
)


@given(st.lists(st.dictionaries(st.sampled_from("abcd"), plain), max_size=5))
def test_json_is_indexed_as_it_stands(values: list[dict[str, Any]]) -> None:
    payloads = [json.dumps(v).encode() for v in values]
    for value, body in zip(values, bodies_of(JSON, payloads), strict=True):
        assert isinstance(body, bytes)
        assert document_of(body) == bson.encode(value)
    for payload, value in zip(payloads, values, strict=True):
        assert json.dumps(JSON.decode(payload)) == json.dumps(value)


def test_json_rules() -> None:
    assert indexed("[1, 2]") == {"value": [1, 2]}
    assert indexed("7") == {"value": 7}
    assert indexed('{"_id": 1, "_meta": 2, "m": {"_id": 3}}') == {
        "_id_": 1,
        "_meta_": 2,
        "m": {"_id": 3},
    }
    assert indexed('{"a": 1, "a": 2}') == {"a": 2}
    assert indexed('{"a\\u0000b": {"\\u0000": 1}}') == {"a\ufffdb": {"\ufffd": 1}}
    assert indexed('{"a": "x\\u0000y"}') == {"a": "x\0y"}
    assert indexed('{"a": "\\ud800x"}') == {"a": "\ufffdx"}
    assert indexed('{"a": NaN, "b": -Infinity}')["b"] == -math.inf
    assert indexed('{"": "ü"}') == {"": "ü"}
    assert indexed(b'\xef\xbb\xbf{"a": 1}') == {"a": 1}
    found = indexed(f'{{"a": {1 << 63}, "b": {10**400}, "c": -{10**400}, "d": {(1 << 63) - 1}}}')
    assert found == {"a": float(1 << 63), "b": math.inf, "c": -math.inf, "d": (1 << 63) - 1}
    assert type(found["a"]) is float


def test_json_arrays_past_the_limit() -> None:
    integers = indexed(json.dumps({"a": list(range(33))}))["a"]
    assert integers == {"n": 33, "min": 0, "max": 32, "mean": 16.0}
    assert type(integers["min"]) is Int64  # type: ignore[index]
    floats = indexed(json.dumps({"a": [0.5] * 20 + [math.nan] * 20}))["a"]
    assert floats == {"n": 40, "min": 0.5, "max": 0.5, "mean": 0.5}
    assert indexed(json.dumps({"a": [math.nan] * 40}))["a"] == {
        "n": 40,
        "min": None,
        "max": None,
        "mean": None,
    }
    assert indexed(json.dumps({"a": [1.5] + [1 << 64] * 40}))["a"] == {
        "n": 41,
        "min": 1.5,
        "max": float(1 << 64),
        "mean": pytest.approx(40 * 2.0**64 / 41),
    }
    assert indexed(json.dumps({"a": ["x"] * 40, "b": [{}] * 33, "c": [None] * 33})) == {
        "a": {"n": 40},
        "b": {"n": 33},
        "c": {"n": 33},
    }
    assert indexed(json.dumps({"a": list(range(32))}))["a"] == list(range(32))


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b"", "not JSON"),
        (b'{"a": ', "not JSON"),
        (b'{"a": "\xff"}', "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[" * 150 + b"]" * 150, "nested deeper"),
        (b'{"a": "' + b"x" * (9 << 20) + b'"}', "8 MiB"),
        (b'{"a": ' + b"1" * 10_000 + b"}", "not JSON"),
    ],
)
def test_json_that_cannot_be_indexed(payload: bytes, why: str) -> None:
    bodies = bodies_of(JSON, [b'{"a": 1}', payload, b'{"b": 2}'])
    assert isinstance(bodies[1], str)
    assert why in bodies[1]
    check(bodies[0], {"a": 1})
    check(bodies[2], {"b": 2})
    assert index_fields(JSON, payload) == {}
    if why == "not JSON":
        with pytest.raises(PayloadError):
            JSON.decode(payload)


# --- protobuf -------------------------------------------------------------------------


def protobuf_channel() -> Channel:
    """A type with a field of every kind."""
    from google.protobuf import duration_pb2, timestamp_pb2
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

    file = FileDescriptorProto(name="t.proto", package="t", syntax="proto2")
    file.dependency.extend([timestamp_pb2.DESCRIPTOR.name, duration_pb2.DESCRIPTOR.name])
    kind = file.enum_type.add(name="Kind")
    kind.value.add(name="NONE", number=0)
    kind.value.add(name="SOME", number=5)
    message = file.message_type.add(name="All")
    for name, key in (("Map", Field.TYPE_STRING), ("Flags", Field.TYPE_BOOL)):
        entry = message.nested_type.add(name=f"{name}Entry")
        entry.options.map_entry = True
        entry.field.add(name="key", number=1, type=key, label=1)
        entry.field.add(name="value", number=2, type=Field.TYPE_INT32, label=1)
    simple = "double float int32 int64 uint32 uint64 bool string bytes sint64 fixed32 sfixed32"
    number = 0
    for name in simple.split():
        for label in (1, 3):
            number += 1
            message.field.add(
                name=f"{name}_{label}",
                number=number,
                type=getattr(Field, f"TYPE_{name.upper()}"),
                label=label,
            )
    for name, type_name, label in (
        ("stamp", ".google.protobuf.Timestamp", 1),
        ("took", ".google.protobuf.Duration", 1),
        ("unset", ".google.protobuf.Duration", 1),
        ("child", ".t.All", 1),
        ("children", ".t.All", 3),
        ("map", ".t.All.MapEntry", 3),
        ("flags", ".t.All.FlagsEntry", 3),
    ):
        number += 1
        message.field.add(
            name=name, number=number, type=Field.TYPE_MESSAGE, type_name=type_name, label=label
        )
    message.field.add(
        name="kind", number=number + 1, type=Field.TYPE_ENUM, type_name=".t.Kind", label=1
    )
    message.field.add(name="_id", number=number + 2, type=Field.TYPE_INT32, label=1)
    # Timestamp comes with the set, Duration is left out as some writers do; order reversed.
    files = FileDescriptorSet(file=[file])
    files.file.add().ParseFromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    return Channel("/p", "protobuf", Schema("t.All", "protobuf", files.SerializeToString()))


def a_file(name: str, imports: list[str], kind: str = "", package: str = "t") -> Any:
    """A file of one message with one field."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
    from google.protobuf.descriptor_pb2 import FileDescriptorProto

    file = FileDescriptorProto(name=name, package=package, syntax="proto3", dependency=imports)
    field = file.message_type.add(name="T").field.add(name="x", number=1, label=1)
    field.type = Field.TYPE_MESSAGE if kind else Field.TYPE_INT32
    if kind:
        field.type_name = kind
    return file


def codec_of_files(*files: Any) -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    data = FileDescriptorSet(file=files).SerializeToString()
    return codec_for(Channel("/p", "protobuf", Schema("t.T", "protobuf", data)))


def test_descriptor_sets_with_imports_that_lack() -> None:
    from google.protobuf import any_pb2, descriptor_pb2, type_pb2

    stamp, other = ".google.protobuf.Timestamp", a_file("o.proto", [], package="o")
    user = a_file("t.proto", ["google/protobuf/timestamp.proto"], stamp)
    assert [path.type for path in codec_of_files(user).paths()] == ["time"]
    for files in (
        [a_file("t.proto", ["gone.proto"])],
        [a_file("t.proto", ["google/protobuf/any.proto"])],
        [a_file("t.proto", []), a_file("b.proto", ["gone.proto"], ".gone.T", package="b")],
    ):
        assert [(p.path, p.type) for p in codec_of_files(*files).paths()] == [("x", "int32")]
    for name in ("o.proto", "src/o.proto"):
        codec = codec_of_files(a_file("t.proto", ["gone.proto", name], ".o.T"), other)
        assert [p.path for p in codec.paths()] == ["x", "x.x"]
    public = a_file("t.proto", ["gone.proto", "o.proto", "far.proto"], ".o.T")
    public.public_dependency.extend([0, 1])
    public.weak_dependency.append(2)
    assert codec_of_files(public, other).indexed
    assert public.SerializeToString()
    for own in (any_pb2, type_pb2):  # the other one is supplied
        given = descriptor_pb2.FileDescriptorProto.FromString(own.DESCRIPTOR.serialized_pb)
        user = a_file("t.proto", ["google/protobuf/type.proto"], ".google.protobuf.Type")
        assert codec_of_files(user, given).indexed


def test_descriptor_sets_that_are_refused() -> None:
    assert (
        "couldn't resolve name '.gone.T'"
        in codec_of_files(a_file("t.proto", ["gone.proto"], ".gone.T")).reason
    )
    circle = [a_file("t.proto", ["b.proto"]), a_file("b.proto", ["t.proto"], package="b")]
    assert "import each other" in codec_of_files(*circle).reason
    assert "does not say" in codec_of_files(a_file("o.proto", [], package="o")).reason


def test_protobuf_rules() -> None:
    pytest.importorskip("mcap_protobuf")
    codec = codec_for(protobuf_channel())
    assert codec.indexed, codec.reason
    made: Any = type(codec.decode(b""))
    message = made(
        double_1=-0.0,
        float_1=0.5,
        int32_1=-3,
        int64_1=4,
        uint32_1=(1 << 32) - 1,
        uint64_1=(1 << 64) - 1,
        bool_1=True,
        string_1="ü",
        bytes_1=b"abc",
        double_3=[1.0] * 33,
        uint64_3=[1, 1 << 63] * 20,
        bool_3=[True] * 33,
        string_3=["x"] * 33,
        bytes_3=[b"", b"ab"],
        kind=5,
        _id=9,
    )
    message.stamp.seconds, message.stamp.nanos = 1_700_000_000, 5
    message.took.seconds, message.took.nanos = -1, -500
    message.child.int32_1 = 8
    message.children.add().int64_3.extend([1, 2])
    message.map["b"] = 1
    message.map["a"] = 2
    message.flags[True] = 5
    payload = message.SerializeToString()
    found = index_fields(codec, payload)
    assert found["stamp"] == 1_700_000_000_000_000_005
    assert type(found["stamp"]) is Int64
    assert found["took"] == -1_000_000_500
    assert "unset" not in found
    assert (found["int32_1"], type(found["int32_1"])) == (-3, int)
    assert (found["uint32_1"], type(found["uint32_1"])) == ((1 << 32) - 1, Int64)
    assert (found["uint64_1"], type(found["uint64_1"])) == (float(1 << 64), float)
    assert found["bytes_1"] == {"n": 3}
    assert found["bytes_3"] == [{"n": 0}, {"n": 2}]
    assert found["double_3"] == {"n": 33, "min": 1.0, "max": 1.0, "mean": 1.0}
    assert found["uint64_3"] == {"n": 40, "min": 1, "max": 2.0**63, "mean": 2.0**62}
    assert type(found["uint64_3"]["max"]) is float  # type: ignore[index]
    assert type(found["uint64_3"]["min"]) is Int64  # type: ignore[index]
    assert found["bool_3"] == {"n": 33, "min": 1, "max": 1, "mean": 1.0}
    assert found["string_3"] == {"n": 33}
    assert found["map"] == {"a": 2, "b": 1}
    assert list(found["map"]) == ["a", "b"]  # type: ignore[call-overload]
    assert found["flags"] == {"true": 5}
    assert found["kind"] == 5
    assert found["_id_"] == 9
    assert math.copysign(1, found["double_1"]) == -1  # type: ignore[call-overload]
    assert found["child"]["int32_1"] == 8  # type: ignore[index]
    assert found["children"][0]["int64_3"] == [1, 2]  # type: ignore[index]
    (body, broken) = bodies_of(codec, [payload, b"\xff\xff"])
    assert document_of(body) == bson.encode(found)  # type: ignore[arg-type]
    assert "t.All" in str(broken)
    with pytest.raises(PayloadError):
        codec.decode(b"\xff\xff")
    types = {p.path: p.type for p in codec.paths()}
    assert types["stamp"] == "time"
    assert types["double_3"] == "float64[]"
    assert types["child"] == "t.All"
    assert "child.child" not in types
    assert types["_id_"] == "int32"
    wanted = {"stamp", "double_3", "int32_1"}
    records = codec.columns_of(batch_of(payload, b""), wanted).arrow()
    stamps = records.field("stamp").view("int64").to_pylist()
    assert stamps == [1_700_000_000_000_000_005, None]
    assert [len(row) for row in records.field("double_3").to_pylist()] == [33, 0]
    kinds = codec.columns_of(no_messages(), {"uint64_1", "child.string_1"}).arrow().type
    assert kinds.field("uint64_1").type == pa.uint64()
    first, second = codec.columns_of(batch_of(payload, b"")).arrow().to_pylist()
    assert (first["uint64_1"], first["string_1"], first["_id_"]) == ((1 << 64) - 1, "ü", 9)
    assert (first["flags"], second["flags"]) == ({"true": 5}, {"true": None})
    assert (first["child"]["int32_1"], first["child"]["string_1"]) == (8, None)
    assert first["children"][0]["int64_3"] == [1, 2]
    assert [second[name] for name in ("string_1", "child", "children")] == [None, None, []]


def test_protobuf_without_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "google.protobuf.descriptor_pool", None)
    schema = Schema("t.Unseen", "protobuf", b"\x0a\x00")
    codec = codec_for(Channel("/p", "protobuf", schema))
    assert not codec.indexed
    assert "pip install 'hybridlog[protobuf]'" in str(codec.reason)


# --- Arrow arrays, against json and protobuf themselves


def arrow_of(codec: Codec, payloads: list[bytes], fields: set[str] | None = None) -> Any:
    records = codec.columns_of(batch_of(*payloads), fields).arrow()
    records.validate(full=True)
    return records


def check_cell(kind: pa.DataType, found: Any, value: Any) -> None:
    """A value of an Arrow array against what the message says."""
    if value is None:
        assert found is None
    elif kind == pa.json_():
        assert same(json.loads(found), value), (found, value)
    elif isinstance(value, dict):
        assert pa.types.is_struct(kind)
        fields = {kind.field(i).name: kind.field(i).type for i in range(kind.num_fields)}
        assert set(value) <= set(fields)
        for name, inner in fields.items():
            check_cell(inner, found[name], value.get(name))
    elif isinstance(value, list):
        assert len(found) == len(value)
        for one, other in zip(found, value, strict=True):
            check_cell(kind.value_type, one, other)
    else:
        assert same(found, value), (found, value)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, bool) or isinstance(other, bool):
        return one is other
    if isinstance(one, float) and isinstance(other, float) and math.isnan(other):
        return math.isnan(one)
    return bool(one == other)


def test_json_numbers_have_types_that_hold_them() -> None:
    rows = [b'{"u": 18446744073709551615, "f": 1, "n": NaN}', b'{"u": 0, "f": 0.5, "n": null}']
    records = arrow_of(JSON, rows)
    assert [records.field(one).type for one in "ufn"] == [pa.uint64(), pa.float64(), pa.float64()]
    assert records.field("u").to_pylist() == [(1 << 64) - 1, 0]
    assert records.field("n").is_null().to_pylist() == [False, True]


def test_json_text_is_json_also_of_nan_and_surrogates() -> None:
    rows = [b'{"v": [NaN, Infinity, "a"]}', b'{"v": "\\ud800"}', b'{"v": {"k": -Infinity}}']
    texts = arrow_of(JSON, rows).field("v").to_pylist()
    assert [json.loads(text, parse_constant=pytest.fail) for text in texts] == [
        ["NaN", "Infinity", "a"],
        "\ufffd",
        {"k": "-Infinity"},
    ]


JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(1 << 65), 1 << 65)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abc"), inner),
    max_leaves=12,
)


@given(st.lists(st.dictionaries(st.sampled_from("xyz"), JSON_VALUES), min_size=1, max_size=5))
def test_any_json_is_exact(rows: list[dict[str, Any]]) -> None:
    records = arrow_of(JSON, [json.dumps(row).encode() for row in rows])
    for found, row in zip(records.to_pylist(), rows, strict=True):
        check_cell(records.type, found, row)


def test_json_rows_that_cannot_be_read_and_values_that_are_no_objects() -> None:
    decoded = JSON.columns_of(batch_of(b'{"a": 1}', b"broken", b"[2]", b"null"))
    assert decoded.rows.tolist() == [0, 2, 3]
    assert [u.rows.tolist() for u in decoded.unreadable] == [[1]]
    assert decoded.arrow().to_pylist() == [
        {"a": 1, "value": None},
        {"a": None, "value": [2]},
        {"a": None, "value": None},
    ]


def test_chosen_fields() -> None:
    rows = [b'{"a": {"x": 1, "y": 2}, "b": 3, "c": [{"d": 1, "e": 2}], "_id": 7}', b'{"b": 4}']
    chosen = arrow_of(JSON, rows, {"a.x", "c[].d", "_id_"})
    assert chosen.to_pylist() == [
        {"a": {"x": 1}, "c": [{"d": 1}], "_id_": 7},
        {"a": None, "c": None, "_id_": None},
    ]
    assert arrow_of(JSON, rows, {"a"}).field("a").to_pylist() == [{"x": 1, "y": 2}, None]
