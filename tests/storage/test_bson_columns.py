from __future__ import annotations

import struct
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import bson
import numpy as np
import pytest
from bson.int64 import Int64
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlog_storage.bson_columns import (
    BsonGroup,
    BsonStringArrays,
    BsonStrings,
    read_columns,
    split,
)
from hybridlog_storage.errors import StoreError
from tests.work import calls_in


def item(column: Any, row: int) -> Any:
    if column is None:
        return None
    if isinstance(column, list):
        return column[row]
    if isinstance(column, BsonStringArrays):
        first = row * column.width
        return [item(column.strings, first + place) for place in range(column.width)]
    if isinstance(column, BsonStrings):
        raw = column.data[column.offset[row] : column.offset[row + 1]].tobytes()
        return raw.decode() if column.subtype is None else bson.Binary(raw, column.subtype)
    if column.dtype.kind == "M":
        return column[row].astype(np.int64).tolist()
    return column[row].tolist()


def plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return round(value.replace(tzinfo=UTC).timestamp() * 1000)
    return value


def flat(document: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in document.items():
        if isinstance(value, dict) and value:
            out.update(flat(value, f"{prefix}{name}."))
        elif isinstance(value, list) and all(isinstance(each, datetime) for each in value):
            out[prefix + name] = [plain(each) for each in value]
        elif isinstance(value, bytes) and not isinstance(value, bson.Binary):
            out[prefix + name] = bson.Binary(value, 0)
        else:
            out[prefix + name] = plain(value)
    return out


def rebuilt(groups: list[BsonGroup], count: int) -> list[dict[str, Any]]:
    out: list[dict[str, Any] | None] = [None] * count
    for group in groups:
        assert (np.diff(group.rows) > 0).all()
        for place, row in enumerate(group.rows.tolist()):
            assert out[row] is None
            if group.documents is not None:
                out[row] = flat(group.documents[place])
            else:
                out[row] = {path: item(column, place) for path, column in group.columns.items()}
    assert None not in out
    return out  # type: ignore[return-value]


def check(documents: list[dict[str, Any]]) -> list[BsonGroup]:
    raw = [bson.encode(document) for document in documents]
    batch = b"".join(raw)
    starts = split(batch)
    assert starts.tolist() == np.cumsum([0, *map(len, raw)])[:-1].tolist()
    groups = read_columns(batch)
    # repr tells -0.0 from 0.0, 1 from 1.0 and True, and lets NaN equal NaN
    wanted = [flat(bson.decode(document)) for document in raw]
    assert repr(rebuilt(groups, len(raw))) == repr(wanted)
    return groups


names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=4)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.text(st.characters(codec="utf-8"), max_size=6),
    st.binary(max_size=6),
    st.builds(bson.Binary, st.binary(max_size=4), st.sampled_from([0, 2, 5, 128])),
    st.datetimes(datetime(1, 1, 1), datetime(9999, 1, 1)).map(
        lambda t: t.replace(microsecond=t.microsecond // 1000 * 1000)
    ),
    st.builds(bson.ObjectId, st.binary(min_size=12, max_size=12)),
    st.lists(st.integers(0, 9), max_size=3),
    st.lists(st.floats(), max_size=3),
    st.lists(st.text(st.sampled_from("aé"), max_size=2), max_size=3),
)
values = st.recursive(
    scalars,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(names, inner, max_size=3)),
    max_leaves=6,
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.dictionaries(names, values, max_size=5), max_size=6), st.integers(1, 12))
def test_agrees_with_bson(documents: list[dict[str, Any]], times: int) -> None:
    check(documents * times)


def shaped(
    a: float,
    b: int,
    text: str,
    row: list[float],
    words: list[str],
    k: bool,
    m: float | None,
) -> dict[str, Any]:
    return {"a": a, "n": {"b": Int64(b), "s": text}, "v": row, "t": words, "k": k, "m": m}


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.builds(
            shaped,
            st.floats(),
            st.integers(-5, 5),
            st.sampled_from(["x", "yz", "\u00fc"]),
            st.lists(st.floats(), min_size=3, max_size=3),
            st.lists(st.sampled_from(["p", "q"]), min_size=2, max_size=2),
            st.booleans(),
            st.one_of(st.none(), st.floats()),
        ),
        min_size=1,
        max_size=60,
    )
)
def test_documents_that_differ_in_values_form_groups(documents: list[dict[str, Any]]) -> None:
    groups = check(documents)
    # One group for each combination of string length and null.
    lengths = {len(bson.encode(document)) for document in documents}
    assert len(groups) == len(lengths)
    assert all(group.documents is None for group in groups)
    assert all(
        isinstance(group.columns["t"], BsonStringArrays)
        and group.columns["v"].shape == (len(group.rows), 3)  # type: ignore[union-attr]
        for group in groups
    )


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_malformed_bytes_are_refused_or_read_as_bson_does(data: st.DataObject) -> None:
    documents = [
        bson.encode(
            {
                "_id": b"k" * 20,
                "d": 1.5 * n,
                "i": n,
                "s": "frame",
                "o": {"b": True, "z": None, "e": {}},
                "l": [1, 2, 3],
                "w": ["a", "bc"],
                "m": [{"x": 1}, {"x": 2}],
            }
        )
        for n in range(12)
    ]
    raw = bytearray(b"".join(documents))
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    batch = bytes(raw[: data.draw(st.sampled_from([len(raw), len(raw) - 1, len(raw) // 2]))])
    try:
        groups = read_columns(batch)
    except StoreError:
        return
    starts = [*split(batch).tolist(), len(batch)]
    try:
        wanted = [flat(bson.decode(batch[a:b])) for a, b in pairwise(starts)]
        assert repr(rebuilt(groups, len(wanted))) == repr(wanted)
    except (bson.errors.InvalidBSON, UnicodeDecodeError, ValueError):
        # UTF-8 within strings is not checked here; everything else is.
        assert any(byte >= 0x80 for byte in batch)


@pytest.mark.parametrize(
    "batch",
    [
        b"\x00",
        b"\x05\x00\x00\x00",
        b"\x04\x00\x00\x00\x00",
        b"\xff\xff\xff\xff\x00",
        b"\xff\xff\xff\x7f\x00",
        b"\x05\x00\x00\x00\x01",
        bson.encode({"a": 1}) * 20 + b"\x05\x00\x00",
        bson.encode({"a": 1}) * 20 + b"\x09\x00\x00\x00\x00",
    ],
)
def test_split_refuses_lengths_that_do_not_add_up(batch: bytes) -> None:
    with pytest.raises(StoreError, match=r"malformed at byte \d+"):
        split(batch)


def test_an_array_that_is_damaged_in_one_document() -> None:
    good = bson.encode({"m": [{"x": 1}]})
    bad = bytearray(good)
    bad[7] = 200  # the array's own length
    with pytest.raises(StoreError):
        read_columns(good * 9 + bytes(bad))


def test_deep_nesting_is_refused() -> None:
    document = b"\x05\x00\x00\x00\x00"
    for _ in range(3000):
        document = struct.pack("<i", len(document) + 8) + b"\x03a\x00" + document + b"\x00"
    with pytest.raises(StoreError, match="deeper"):
        read_columns(document * 10)


def test_very_many_shapes_stay_cheap() -> None:
    documents = [{f"f{n % 997:03}": n, f"g{n % 31:03}": 1.0} for n in range(4000)]
    check(documents)
    batch = b"".join(map(bson.encode, documents))
    assert calls_in(lambda: read_columns(batch)) < 100 * len(documents)


def test_unequal_lengths_split() -> None:
    documents = [{"s": "x" * (n % 7)} for n in range(50)] + [{"s": "y"}] * 500 + [{"s": "zz"}]
    check(documents)


def test_no_documents() -> None:
    assert read_columns(b"") == []
    assert len(split(b"")) == 0


def test_nothing_is_done_for_each_document() -> None:
    def batch_of(count: int) -> bytes:
        return b"".join(
            bson.encode(
                {
                    "header": {"seq": n, "stamp": Int64(n), "frame_id": "imu"},
                    **{f"f{k}": n * 0.5 for k in range(12)},
                    "_meta": {"t": Int64(n), "seq": Int64(n), "topic": "/imu"},
                }
            )
            for n in range(count)
        )

    few, many = (batch_of(count) for count in (500, 5000))
    assert calls_in(lambda: read_columns(many)) < 2 * calls_in(lambda: read_columns(few))
