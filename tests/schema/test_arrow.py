"""Messages as Arrow arrays against json, protobuf and rosbags themselves."""

from __future__ import annotations

import json
import math
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.schema.codec import Codec, Decoded
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.messages import Channel, Schema
from tests.indexed import batch_of

JSON = codec_for(Channel("/t", "json", None))


def decoded_of(codec: Codec, payloads: list[bytes], fields: set[str] | None = None) -> Decoded:
    return codec.columns_of(batch_of(*payloads), fields)


def arrow_of(codec: Codec, payloads: list[bytes], fields: set[str] | None = None) -> Any:
    records = decoded_of(codec, payloads, fields).arrow()
    records.validate(full=True)
    return records


def is_json(kind: pa.DataType) -> bool:
    return bool(kind == pa.json_())


def check(kind: pa.DataType, found: Any, value: Any) -> None:
    """A value of an Arrow array against what the message says."""
    if value is None:
        assert found is None
    elif is_json(kind):
        assert same(json.loads(found), value), (found, value)
    elif isinstance(value, dict):
        assert pa.types.is_struct(kind)
        fields = {kind.field(i).name: kind.field(i).type for i in range(kind.num_fields)}
        assert set(value) <= set(fields)
        for name, inner in fields.items():
            check(inner, found[name], value.get(name))
    elif isinstance(value, list):
        assert len(found) == len(value)
        for one, other in zip(found, value, strict=True):
            check(kind.value_type, one, other)
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
        check(records.type, found, row)


def test_json_rows_that_cannot_be_read_and_values_that_are_no_objects() -> None:
    decoded = decoded_of(JSON, [b'{"a": 1}', b"broken", b"[2]", b"null"])
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


def test_protobuf_presence_maps_and_extremes() -> None:
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    file = FileDescriptorProto(name="t.proto", package="t", syntax="proto2")
    kind = file.message_type.add(name="M")
    entry = kind.nested_type.add(name="EEntry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, type=Field.TYPE_BOOL, label=1)
    entry.field.add(name="value", number=2, type=Field.TYPE_UINT64, label=1)
    kind.field.add(name="u", number=1, type=Field.TYPE_UINT64, label=1)
    kind.field.add(name="s", number=2, type=Field.TYPE_STRING, label=1)
    kind.field.add(name="e", number=3, type=Field.TYPE_MESSAGE, label=3, type_name=".t.M.EEntry")
    kind.field.add(name="m", number=4, type=Field.TYPE_MESSAGE, label=1, type_name=".t.M")
    kind.field.add(name="l", number=5, type=Field.TYPE_MESSAGE, label=3, type_name=".t.M")
    kind.field.add(name="_id", number=6, type=Field.TYPE_SINT32, label=1)
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    make: Any = GetMessageClass(pool.FindMessageTypeByName("t.M"))
    rows = [
        make(u=(1 << 64) - 1, s="", e={True: 5}, m=make(s="in"), _id=-1),
        make(l=[make(u=1), make(m=make(m=make(u=2)))]),
    ]
    schema = Schema("t.M", "protobuf", FileDescriptorSet(file=[file]).SerializeToString())
    codec = codec_for(Channel("/t", "protobuf", schema))
    records = arrow_of(codec, [row.SerializeToString() for row in rows])
    first, second = records.to_pylist()
    assert first["u"] == (1 << 64) - 1
    assert first["s"] == ""
    assert second["s"] is None
    assert first["e"] == {"true": 5}
    assert second["e"] == {"true": None}
    assert first["m"]["s"] == "in"
    assert second["m"] is None
    assert first["l"] == []
    assert second["l"][0]["u"] == 1
    assert second["l"][1]["m"]["m"]["u"] == 2
    assert first["_id_"] == -1
    assert arrow_of(codec, [], {"u", "m.s"}).type.field("u").type == pa.uint64()
