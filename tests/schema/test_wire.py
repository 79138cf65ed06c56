"""The column reader against rosbags, on random types."""

from __future__ import annotations

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from hybridlog.schema.column import Arrays, Records, Scalars, Strings, take
from hybridlog.schema.definition import (
    ArrayOf,
    Instant,
    MessageType,
    Primitive,
    Text,
    parse_definition,
    paths,
)
from hybridlog.schema.ros_codec import WireReader
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import Schema
from tests.schema.test_definition import DUMMY


def oracle(name: str, text: str) -> Typestore:
    """A rosbags type store that knows one definition."""
    store = get_typestore(Stores.EMPTY)
    types = {
        key: (constants, fields or [(DUMMY, (Nodetype.BASE, ("uint8", 0)))])
        for key, (constants, fields) in get_types_from_msg(text, name).items()
    }
    store.register({key: value for key, value in types.items() if key not in store.fielddefs})
    return store


def assert_same(column, kind, values, wire: str, path: str = "") -> None:
    """Check a column against the values that rosbags has for its rows."""
    assert len(column) == len(values), path
    if isinstance(kind, MessageType):
        assert isinstance(column, Records)
        assert list(column.fields) == [name for name, _ in kind.fields], path
        for name, inner in kind.fields:
            attribute = name if not values or hasattr(values[0], name) else f"{name}_"
            below = [getattr(value, attribute) for value in values]
            assert_same(column.fields[name], inner, below, wire, f"{path}.{name}")
    elif isinstance(kind, ArrayOf):
        assert isinstance(column, Arrays)
        assert column.width == kind.width, path
        assert column.offset.dtype == np.int64
        assert column.offset.tolist() == [0, *itertools.accumulate(len(v) for v in values)], path
        if isinstance(kind.element, Primitive):
            flat = np.concatenate([np.asarray(v) for v in values]) if values else []
        else:
            flat = [item for value in values for item in value]
        assert_same(column.values, kind.element, flat, wire, f"{path}[]")
    elif isinstance(kind, Text):
        assert isinstance(column, Strings)
        data, at = column.data.tobytes(), column.offset.tolist()
        texts = [data[a:b].decode() for a, b in itertools.pairwise(at)]
        assert texts == list(values), path
    elif isinstance(kind, Instant):
        assert isinstance(column, Scalars)
        assert column.kind == kind.kind
        assert column.values.dtype == np.int64
        assert column.values.tolist() == [_nanoseconds(v, kind, wire) for v in values], path
    else:
        assert isinstance(column, Scalars)
        assert column.kind == "number"
        _assert_numbers(column.values, kind, values, path)


def _nanoseconds(value, kind: Instant, wire: str) -> int:
    seconds, rest = int(value.sec), int(value.nanosec)
    if wire == "ros1" and kind.kind == "time":
        seconds &= 0xFFFFFFFF
    if wire == "ros1" and kind.kind == "duration" and rest >= 1 << 31:
        rest -= 1 << 32
    return seconds * 1_000_000_000 + rest


def _assert_numbers(found, kind: Primitive, values, path: str) -> None:
    assert found.dtype == np.dtype(kind.code), path
    assert found.dtype.isnative
    assert found.flags.c_contiguous
    assert found.flags.aligned
    if kind.name == "bool":
        # rosbags does not normalise the bytes of bool arrays.
        expected = np.asarray(values, np.bool_).view(np.uint8) != 0
    elif kind.name in {"byte", "char"}:
        # rosbags has one signedness for both versions of ROS.
        expected = (np.asarray(values, np.int64) & 0xFF).astype(np.uint8).view(kind.code)
    else:
        expected = np.asarray(values, kind.code)
    np.testing.assert_array_equal(found, expected, err_msg=path, strict=True)


def pack(payloads, poison: bytes = b"\xa5", seed: int = 0):
    """One buffer with junk of varying length between the payloads."""
    random = np.random.default_rng(seed)
    parts, offset, at = [], [], 0
    for payload in payloads:
        junk = poison * int(random.integers(0, 9))
        at += len(junk)
        offset.append(at)
        parts += [junk, bytes(payload)]
        at += len(payload)
    parts.append(poison * 16)
    lengths = np.array([len(p) for p in payloads], np.int64)
    return b"".join(parts), np.array(offset, np.int64), lengths


def assert_equal_columns(a, b) -> None:
    assert type(a) is type(b)
    if isinstance(a, Scalars):
        assert a.kind == b.kind
        np.testing.assert_array_equal(a.values, b.values, strict=True)
    elif isinstance(a, Strings):
        np.testing.assert_array_equal(a.data, b.data, strict=True)
        np.testing.assert_array_equal(a.offset, b.offset, strict=True)
    elif isinstance(a, Arrays):
        assert a.width == b.width
        np.testing.assert_array_equal(a.offset, b.offset, strict=True)
        assert_equal_columns(a.values, b.values)
    else:
        assert a.rows == b.rows
        assert list(a.fields) == list(b.fields)
        for name in a.fields:
            assert_equal_columns(a.fields[name], b.fields[name])


def check_batch(message_type, wire, payloads, decode) -> None:
    """Everything that rosbags reads must come out the same; nothing may be refused."""
    buffer, offset, length = pack(payloads)
    decoded = WireReader(message_type, wire).read(buffer, offset, length)
    assert [(u.rows.tolist(), u.reason) for u in decoded.unreadable] == []
    assert decoded.rows.tolist() == list(range(len(payloads)))
    assert_same(decoded.records, message_type, [decode(p) for p in payloads], wire)


# --- random types

NUMBERS = [
    *("bool", "byte", "char"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    *("float32", "float64"),
]


@st.composite
def definitions(draw, wire: str):
    """A definition of up to four messages, each of which may hold later ones."""
    count = draw(st.integers(1, 4))
    sections = []
    for index in range(count):
        later = [f"pkg/T{k}" for k in range(index + 1, count)]
        times = (
            ["time", "duration"]
            if wire == "ros1"
            else [
                "builtin_interfaces/Time",
                "builtin_interfaces/Duration",
            ]
        )
        kinds = st.one_of(
            st.sampled_from(NUMBERS),
            st.sampled_from(["string", "float64", "uint8", *times, *later, *later, *later]),
        )
        suffixes = ["", "", "", "[]", "[3]", "[1]"] + (["[<=4]"] if wire == "cdr" else [])
        # The first is never empty, so that most of what is drawn has content.
        fields = draw(
            st.lists(st.tuples(kinds, st.sampled_from(suffixes)), min_size=index == 0, max_size=6)
        )
        lines = [f"{kind}{suffix} f{k}" for k, (kind, suffix) in enumerate(fields)]
        header = [] if index == 0 else ["=" * 80, f"MSG: pkg/T{index}"]
        sections += [*header, *lines]
    return "\n".join(sections) + "\n"


class Values:
    """Random values of a type as rosbags wants them."""

    def __init__(self, store, seed: int, most: int, *, even: bool) -> None:
        self.random = np.random.default_rng(seed)
        self.store = store
        self.most = most
        self.even = even

    def size(self) -> int:
        return self.most if self.even else int(self.random.integers(0, self.most + 1))

    def message(self, name: str):
        values = []
        for field, desc in self.store.fielddefs[name][1]:
            values.append(0 if field.startswith("structure") else self.value(desc))
        return self.store.types[name](*values)

    def value(self, desc):
        node, detail = desc
        if node.name == "NAME":
            return self.message(detail)
        if node.name == "BASE":
            return self.text() if detail[0] == "string" else self.numbers(detail[0], 1)[0].item()
        inner, size = detail
        count = size if node.name == "ARRAY" else min(self.size(), size or self.most)
        if inner[0].name == "BASE" and inner[1][0] != "string":
            return self.numbers(inner[1][0], count)
        return [self.value(inner) for _ in range(count)]

    def text(self) -> str:
        return "".join(self.random.choice(list("abö\x00z"), self.size()).tolist())

    def numbers(self, name: str, count: int):
        if name == "bool":
            return self.random.integers(0, 2, count).astype(np.bool_)
        dtype = np.dtype({"char": "u1", "byte": "i1"}.get(name, name))
        if dtype.kind == "f":
            special = self.random.choice([np.nan, np.inf, -np.inf, -0.0, 1e300, 1.5], count)
            with np.errstate(over="ignore"):
                return special.astype(dtype)
        return np.frombuffer(self.random.bytes(count * dtype.itemsize), dtype).copy()


SHAPES = {
    "seed": st.integers(0, 2**32),
    "rows": st.sampled_from([1, 2, 15, 40]),
    "most": st.integers(0, 3),
    "even": st.booleans(),
}


def make(text, wire, seed, rows, most, even, *, big=False):
    """Message type, payloads, and rosbags' decoder."""
    store = oracle("pkg/msg/T0", text)
    # rosbags makes an object for each of the elements without bytes that garbage claims.
    store.max_sequence_length = 1000
    values = Values(store, seed, most, even=even)
    messages = [values.message("pkg/msg/T0") for _ in range(rows)]
    if wire == "ros1":
        payloads = [bytes(store.serialize_ros1(m, "pkg/msg/T0")) for m in messages]
        decode = store.deserialize_ros1
        encoding = "ros1msg"
    else:
        orders = values.random.integers(0, 2, rows) if big else np.ones(rows)
        payloads = [
            bytes(store.serialize_cdr(m, "pkg/msg/T0", little_endian=bool(order)))
            for m, order in zip(messages, orders, strict=True)
        ]
        decode = store.deserialize_cdr
        encoding = "ros2msg"
    message_type = parse_definition(Schema("pkg/msg/T0", encoding, text.encode()))
    return message_type, payloads, lambda raw: decode(raw, "pkg/msg/T0")


def supported(text: str, wire: str) -> bool:
    """False for the types that are refused: arrays within elements without bytes."""
    encoding = "ros1msg" if wire == "ros1" else "ros2msg"
    message_type = parse_definition(Schema("pkg/T0", encoding, text.encode()))
    try:
        WireReader(message_type, wire)
    except DefinitionError:
        return wire != "ros1"
    return True


@given(text=definitions("ros1"), **SHAPES)
def test_random_types_in_ros1(text, seed, rows, most, even):
    if supported(text, "ros1"):
        check_batch(*_three(make(text, "ros1", seed, rows, most, even), "ros1"))


@given(text=definitions("cdr"), big=st.booleans(), **SHAPES)
def test_random_types_in_cdr_of_both_byte_orders(text, big, seed, rows, most, even):
    check_batch(*_three(make(text, "cdr", seed, rows, most, even, big=big), "cdr"))


def _three(made, wire):
    message_type, payloads, decode = made
    return message_type, wire, payloads, decode


def pick(records, message_type, chosen, prefix=""):
    """The part of full columns that a choice of fields must give, None for nothing."""
    fields = {}
    for name, kind in message_type.fields:
        path = f"{prefix}{name}"
        column = records.fields[name]
        if path in chosen:
            fields[name] = column
            continue
        inner, bare = kind, column
        if isinstance(kind, ArrayOf):
            inner, bare = kind.element, column.values
        if not isinstance(inner, MessageType):
            continue
        below = pick(bare, inner, chosen, f"{path}.")
        if below is not None:
            array = isinstance(kind, ArrayOf)
            fields[name] = Arrays(below, column.offset, column.width) if array else below
    return Records(fields, records.rows) if fields else None


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
@given(data=st.data(), **SHAPES)
def test_a_choice_of_fields_is_a_part_of_all_fields(wire, data, seed, rows, most, even):
    text = data.draw(definitions(wire))
    if not supported(text, wire):
        return
    message_type, payloads, _ = make(text, wire, seed, rows, most, even)
    every = [p.path for p in paths(message_type)]
    chosen = data.draw(st.lists(st.sampled_from(every), max_size=4)) if every else []
    buffer, offset, length = pack(payloads)
    full = WireReader(message_type, wire).read(buffer, offset, length)
    part = WireReader(message_type, wire, [*chosen, "nowhere.at.all"]).read(buffer, offset, length)
    bare = {path.replace("[]", "") for path in chosen}
    expected = pick(full.records, message_type, bare) or Records({}, rows)
    assert_equal_columns(part.records, expected)


# --- payloads that do not fit


def garble(payload: bytes, random) -> bytes:
    kind = int(random.integers(0, 6))
    body = bytearray(payload)
    if kind == 0:
        return payload
    if kind == 1:
        return payload[: int(random.integers(0, len(payload) + 1))]
    if kind == 2:
        return payload + random.bytes(int(random.integers(0, 12)))
    if len(body) < 5:
        return random.bytes(int(random.integers(0, 40)))
    if kind == 3:
        body[int(random.integers(0, len(body)))] = int(random.integers(0, 256))
        return bytes(body)
    at = int(random.integers(0, len(body) - 3))
    huge = [b"\xff\xff\xff\xff", b"\x00\x00\x00\x7f", b"\x05\x00\x00\x00", b"\x00\x00\x01\x00"]
    body[at : at + 4] = huge[int(random.integers(0, 4))]
    return bytes(body)


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
@given(data=st.data(), **SHAPES)
def test_garbled_payloads_are_sorted_out_and_never_read_beyond(wire, data, seed, rows, most, even):
    text = data.draw(definitions(wire))
    if not supported(text, wire):
        return
    message_type, payloads, decode = make(text, wire, seed, rows, most, even, big=wire == "cdr")
    random = np.random.default_rng(seed + 1)
    payloads = [garble(p, random) for p in payloads]
    reader = WireReader(message_type, wire)
    results = [
        reader.read(*pack(payloads, poison)) for poison in (b"\x00", b"\xff", b"\x01\x00\x00\x00")
    ]
    decoded = results[0]
    for other in results[1:]:
        assert other.rows.tolist() == decoded.rows.tolist()
        assert_equal_columns(other.records, decoded.records)
    refused = [row for u in decoded.unreadable for row in u.rows.tolist()]
    assert sorted([*decoded.rows.tolist(), *refused]) == list(range(rows))
    assert len(decoded.records) == len(decoded.rows)
    for row, payload in enumerate(payloads):
        try:
            expected = decode(payload)
        except (SerdeError, UnicodeDecodeError):
            continue
        # What rosbags accepts is accepted, and reads the same.
        index = np.flatnonzero(decoded.rows == row)
        assert len(index) == 1
        assert_same(take(decoded.records, index), message_type, [expected], wire)
    for index, row in enumerate(decoded.rows.tolist()):
        alone = reader.read(*pack([payloads[row]]))
        assert_equal_columns(alone.records, take(decoded.records, np.array([index])))


def read(text: str, payloads, wire="ros1", **options):
    encoding = "ros1msg" if wire == "ros1" else "ros2msg"
    message_type = parse_definition(Schema("pkg/msg/T", encoding, text.encode()))
    return WireReader(message_type, wire, **options).read(*pack(payloads))


def reasons(decoded):
    return {u.reason: u.rows.tolist() for u in decoded.unreadable}


def u4(*values: int) -> bytes:
    return np.array(values, "<u4").tobytes()


HEADER = b"\x00\x01\x00\x00"


def test_reasons_name_the_field_and_the_numbers():
    text = (
        "uint32 a\nfloat32[] ranges\nstring s\nP[] ps\n"
        + "=" * 80
        + "\nMSG: pkg/P\nuint8 x\nstring y\n"
    )
    good = u4(1, 0, 0, 0)
    decoded = read(
        text,
        [
            good,
            b"\x01\x02",
            u4(1, 0xFFFFFFFF, 0),
            good + b"123456789012",
            u4(1, 0, 7),
            good,
            u4(1, 0, 0, 50),
            u4(1, 0, 0, 1) + b"x" + u4(4) + b"no",
            u4(1, 0, 0, 1)[:-1],
        ],
    )
    assert decoded.rows.tolist() == [0, 3, 5]
    assert decoded.surplus.tolist() == [3]
    assert decoded.records.fields["a"].values.tolist() == [1, 1, 1]
    assert reasons(decoded) == {
        "ends in the middle of field a": [1],
        "ranges claims 4294967295 elements, 4 bytes remain": [2],
        "s claims 7 bytes, 0 bytes remain": [4],
        "ps claims 50 elements, 0 bytes remain": [6],
        "ps[].y claims 4 bytes, 2 bytes remain": [7],
        "ends in the middle of field ps": [8],
    }


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\x00\x01", "is shorter than a CDR header"),
        (b"\x00\x03\x00\x00" + u4(1), "encapsulation 0x0003 is not read"),
        (b"\x00\x07\x00\x00" + u4(1), "encapsulation 0x0007 is not read"),
        (b"\x77\x01\x00\x00" + u4(1), "encapsulation 0x7701 is not read"),
    ],
)
def test_what_cdr_refuses(payload, reason):
    decoded = read("uint32 a\n", [HEADER + u4(7), payload], wire="cdr")
    assert reasons(decoded) == {reason: [1]}
    assert decoded.records.fields["a"].values.tolist() == [7]


def test_cdr_strings_end_with_nul_and_may_be_without_any_byte():
    decoded = read(
        "string s\n",
        [
            HEADER + u4(3) + b"ab\x00",
            HEADER + u4(3) + b"abc",
            HEADER + u4(0),
            HEADER + u4(1) + b"\x00",
        ],
        wire="cdr",
    )
    assert reasons(decoded) == {"s does not end with NUL": [1]}
    column = decoded.records.fields["s"]
    assert column.data.tobytes() == b"ab"
    assert column.offset.tolist() == [0, 2, 2, 2]


def test_any_nonzero_byte_is_true():
    decoded = read("bool a\nbool[2] b\nbool[] c\n", [b"\x02\x00\xff" + u4(2) + b"\x80\x00"])
    assert decoded.records.fields["a"].values.tolist() == [True]
    assert decoded.records.fields["b"].values.values.tolist() == [False, True]
    assert decoded.records.fields["c"].values.values.tolist() == [True, False]
    assert decoded.records.fields["c"].values.values.view(np.uint8).tolist() == [1, 0]


def test_elements_without_bytes_are_bounded():
    text = "E[] es\n" + "=" * 80 + "\nMSG: pkg/E\n"
    decoded = read(text, [u4(3), u4(0xFFFFFFFF), u4(0)])
    assert reasons(decoded) == {"es claims 4294967295 elements that take no bytes": [1]}
    column = decoded.records.fields["es"]
    assert column.offset.tolist() == [0, 3, 3]
    assert column.values == Records({}, 3)


def test_messages_without_fields():
    decoded = read("", [b"", b"", b"x"])
    assert decoded.records == Records({}, 2)
    assert reasons(decoded) == {"1 bytes left over: the definition has no fields": [2]}
    decoded = read("", [HEADER + b"\x00", HEADER], wire="cdr")
    assert decoded.records == Records({}, 1)


@pytest.mark.parametrize("count", [1, 5, 40])
def test_bytes_left_over_are_told_and_the_message_is_read(count):
    text = "uint32 a\nstring s\n"
    whole = u4(7, 2) + b"hi"
    for wire, head, padding in (("ros1", b"", 0), ("cdr", HEADER, 1)):
        body = head + (whole if wire == "ros1" else u4(7, 3) + b"hi\0")
        payloads = [body, body + bytes(padding), body + bytes(padding + 1), u4(1), body * 3]
        decoded = read(text, [payload for payload in payloads for _ in range(count)], wire=wire)
        rows = np.arange(5 * count)
        assert decoded.rows.tolist() == rows[rows // count != 3].tolist()
        assert decoded.surplus.tolist() == rows[np.isin(rows // count, [2, 4])].tolist()
        assert set(decoded.records.fields["a"].values.tolist()) == {7}
    big = b"\0\0\0\0" + struct.pack(">II", 7, 3) + b"hi\0"
    decoded = read(text, [body, big + bytes(8), body + bytes(8), big], wire="cdr")
    assert decoded.surplus.tolist() == [1, 2]
    assert decoded.records.fields["a"].values.tolist() == [7] * 4


def test_padding_of_cdr_fills_up_to_four_bytes():
    for size in range(1, 9):
        payloads = [HEADER + bytes(size + rest) for rest in range(9)]
        text = "".join(f"uint8 a{n}\n" for n in range(size))
        padding = {0, -size % 4}
        decoded = read(text, payloads, wire="cdr")
        assert decoded.rows.tolist() == list(range(9))
        assert decoded.surplus.tolist() == [rest for rest in range(9) if rest not in padding]


def test_arrays_within_elements_without_bytes_are_refused():
    text = f"A[] a\n{'=' * 80}\nMSG: pkg/A\nE[1000000] e\n{'=' * 80}\nMSG: pkg/E\n"
    with pytest.raises(DefinitionError, match="arrays of messages without fields"):
        read(text, [])


def test_rows_outside_of_the_buffer_are_refused():
    message_type = MessageType("T", (("a", Primitive("uint8", "u1")),))
    decoded = WireReader(message_type, "ros1").read(
        b"\x01\x02", np.array([0, -1, 2, 1]), np.array([1, 1, 1, 1])
    )
    assert decoded.rows.tolist() == [0, 3]
    assert reasons(decoded) == {"lies outside of the chunk": [1, 2]}


def test_long_arrays_of_one_row_are_aligned():
    values = np.arange(5000, dtype="<f8")
    for junk in range(8):
        buffer = bytes(junk) + u4(len(values)) + values.tobytes()
        message_type = MessageType("T", (("v", ArrayOf(Primitive("float64", "f8"))),))
        decoded = WireReader(message_type, "ros1").read(
            buffer, np.array([junk]), np.array([len(buffer) - junk])
        )
        found = decoded.records.fields["v"].values.values
        assert found.flags.aligned
        assert found.flags.c_contiguous
        np.testing.assert_array_equal(found, values)


def test_long_and_short_blocks_of_several_rows():
    message_type = MessageType("T", (("v", ArrayOf(Primitive("uint8", "u1"))),))
    for sizes in ([70_000] * 3, [70_000, 3, 0, 5], [5, 0] * 40, list(range(100))):
        payloads = [u4(size) + bytes([size % 251]) * size for size in sizes]
        decoded = WireReader(message_type, "ros1").read(*pack(payloads))
        column = decoded.records.fields["v"]
        assert np.diff(column.offset).tolist() == sizes
        assert column.values.values.tobytes() == b"".join(p[4:] for p in payloads)
