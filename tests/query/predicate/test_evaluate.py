"""Predicates on Arrow columns, against exact arithmetic on each value."""

from __future__ import annotations

import itertools
import math
import operator
import struct
from fractions import Fraction

import numpy as np
import pyarrow as pa
import pytest

from hybridlog.query.predicate.evaluate import on_columns
from hybridlog.query.predicate.mongo_filter import mongo_filter
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.tree import Condition, Field, Predicate
from hybridlog.schema.arrow_types import objects_array

ORDERS = {
    "==": operator.eq,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


def as_single(bound: float) -> float:
    """A decimal literal as float32 holds it, if it is one and does."""
    try:
        return bound if isinstance(bound, int) else struct.unpack("<f", struct.pack("<f", bound))[0]  # type: ignore[no-any-return]
    except OverflowError:
        return bound


@pytest.mark.parametrize(
    "name", ["int8", "uint32", "int64", "uint64", "float16", "float32", "float64"]
)
@pytest.mark.parametrize("order", ORDERS)
def test_numbers_are_compared_by_value(name: str, order: str) -> None:
    """Also with what lies between two integers, or is no value of the type."""
    dtype = np.dtype(name)
    values = np.array([0, 1, 2, 100], dtype)
    if dtype.kind in "iu":
        values = np.append(values, [np.iinfo(dtype).min, np.iinfo(dtype).max])
        values = np.append(values, np.array([np.iinfo(dtype).max - 1], dtype))
    else:
        values = np.append(values, np.array([0.1, 0.5, -1.5, np.finfo(dtype).max], dtype))
        values = np.append(
            values, np.array([2.0**53, 2.0**63, 2.0**64][: dtype.itemsize // 2 - 1], dtype)
        )
    bounds: list[float] = [-1.5, -1, -0.5, 0, -0.0, 0.1, 0.5, 1, 1.5, 2, 2.5, 99.5, 127.5, 2**40]
    bounds += [2**53 - 1, 2**53 + 1, 2**63 - 1, 2**63, 2**63 + 1, 2**64 - 1, 2**64, 10**400]
    bounds += [1e300, -1e300, 2.0**63, 2.0**64, -(2**63), -(2**63) - 1, -(10**400)]
    for bound in bounds:
        asked = Condition(Field(("x",)), order, (bound,))  # type: ignore[arg-type]
        records = pa.StructArray.from_arrays([pa.array(values)], ["x"])
        mask = on_columns(Predicate(asked), {"x": name}, records).holds
        given = Fraction(as_single(bound) if name == "float32" else bound)
        expected = [ORDERS[order](Fraction(v), given) for v in values.tolist()]
        assert mask.tolist() == expected, bound


def mask_of(
    text: str, records: pa.RecordBatch, types: dict[str, str] | None = None
) -> list[bool] | None:
    found = on_columns(parse(text), types, records.to_struct_array())
    return None if found.open.any() else found.holds.tolist()


def test_decimal_literals_are_those_of_float32() -> None:
    """Beside fields, elements and ends of float32; not beside means, which are doubles."""
    types = {"v": "float32", "list[]": "float32", "a": "float32[]", "d": "float64"}
    values = np.array([15.8, 15.7, 0.1], np.float32)
    rows: list[dict[str, object]] = [
        {"v": v, "a": [v], "d": v, "list": [v]} for v in values.tolist()
    ]
    kind = pa.list_(pa.float32())
    fields = [("v", pa.float32()), ("a", kind), ("d", pa.float64()), ("list", kind)]
    records = pa.array(rows, pa.struct(fields))
    for text, wanted in (
        ("v <= 15.8", [True, True, True]),
        ("v == 15.8 or v in [0.1]", [True, False, True]),
        ("v > 15.8", [False] * 3),
        ("a.max == 15.8", [True, False, False]),
        ("a[0] >= 15.8", [True, False, False]),
        ("list == 0.1", [False, False, True]),
        ("a.mean == 15.8", [False] * 3),
        ("d == 15.8", [False] * 3),
        ("v < 1e300", [True] * 3),
        ("v < 16777217", [True] * 3),
    ):
        found = on_columns(parse(text), types, records)
        assert found.holds.tolist() == wanted, text
        assert found.fails.tolist() == [not one for one in wanted], text


def test_a_literal_beyond_float32_is_no_infinity() -> None:
    records = pa.array([{"v": np.inf}], pa.struct([("v", pa.float32())]))
    assert on_columns(parse("v == 1e300"), {"v": "float32"}, records).fails.all()


def test_an_order_is_of_finite_elements() -> None:
    table = pa.record_batch({"a": [[np.inf], [np.inf, 2.0], [-np.inf, np.nan]]})
    assert mask_of("a > 1", table, {"a": "float64[]"}) == [False, True, False]
    assert mask_of("a == inf", table, {"a": "float64[]"}) == [True, True, False]


def test_times_are_nanoseconds() -> None:
    table = pa.record_batch(
        {
            "t": pa.array([5, 10**18 + 1], pa.timestamp("ns", "UTC")),
            "d": pa.array([5, -6], pa.duration("ns")),
        }
    )
    assert mask_of("t == 1000000000000000001", table) == [False, True]
    assert mask_of("d < 0ms", table) == [False, True]


def test_json_text_is_decoded() -> None:
    text = pa.array(['{"a": 1}', "1", '"1"', None, "[1, 18446744073709551616]"], pa.json_())
    table = pa.record_batch({"x": text})
    for where, wanted in (
        ("x == 1", [1, 4]),
        ("x.a == 1", [0]),
        ("x == '1'", [2]),
        ("x == null", [3]),
        ("x > 18446744073709551615", [4]),
        ("x.max exists", [4]),
    ):
        mask = mask_of(where, table)
        assert mask is not None
        assert np.flatnonzero(mask).tolist() == wanted, where


def test_what_columns_cannot_tell() -> None:
    table = pa.record_batch({"x": [1]})
    assert on_columns(mongo_filter({"x": 1}, None), None, table.to_struct_array()).open.all()
    assert mask_of("_meta.seq > 1", table) == [False]
    assert on_columns(mongo_filter({}, None), None, table.to_struct_array()).holds.all()
    assert mask_of("x == 1", table.slice(0, 0)) == []


@pytest.mark.parametrize("order", ["==", "!=", "<", "<=", ">", ">="])
def test_two_fields_are_compared_by_value(order: str) -> None:
    big = [2**53 + 1, 2**63 - 1, 0, 5]
    kinds = {
        "int64": [*big, -(2**63), None, 7],
        "uint64": [2**53, 2**63, 2**64 - 1, 5, 1, 2, None],
        "float64": [2.0**53, 2.0**63, math.nan, 5.0, -(2.0**63), 0.5, math.inf],
    }
    records = pa.StructArray.from_arrays(
        [pa.array(values, kind) for kind, values in kinds.items()], [*kinds]
    )
    compare = operator.ne if order == "!=" else ORDERS[order]
    for one, other in itertools.permutations(kinds, 2):
        predicate = parse(f"{one} {order} {other}")
        pairs = [*zip(kinds[one], kinds[other], strict=True)]  # Python compares exactly
        want = [a is not None and b is not None and compare(a, b) for a, b in pairs]
        found = on_columns(predicate, {}, records)
        assert found.holds.tolist() == want
        assert not found.open.any()


def test_strings_that_are_no_unicode() -> None:
    for where in ("s ~ '^.$'", "s == '\N{REPLACEMENT CHARACTER}'"):
        assert on_columns(parse(where), None, objects_array([{"s": "\ud800"}], None)).holds.all()
