"""Bodies of index documents against `bson.encode` of the dictionary of a row; summaries."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import bson
import numpy as np
import pytest
from bson.int64 import Int64
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.schema.column import (
    Arrays,
    Column,
    Records,
    Scalars,
    Strings,
    Summary,
    summarise,
    take,
)
from hybridlog.schema.document import bodies
from tests.limits import Limit

LIMIT = 4
DTYPES = ["?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"]


# A type here is a tuple: ("number", dtype), ("string",), ("list", type) or
# ("message", {name: type}). Values are plain Python.


def value_of(kind: tuple[Any, ...]) -> st.SearchStrategy[Any]:
    if kind[0] == "number":
        dtype = np.dtype(kind[1])
        if dtype.kind == "b":
            return st.booleans()
        if dtype.kind == "f":
            # Of all NaNs the plain one: float32 has no room for the bits of the others.
            return st.floats(width=8 * dtype.itemsize, allow_nan=False) | st.sampled_from(
                [math.nan, -0.0, math.inf]
            )
        info = np.iinfo(dtype)
        return st.integers(int(info.min), int(info.max))
    if kind[0] == "string":
        text = st.text(max_size=4).map(str.encode)
        return st.sampled_from([b"base_link", b"a\0b"]) | text | st.binary(max_size=6)
    if kind[0] == "list":
        return st.lists(value_of(kind[1]), max_size=LIMIT + 2)
    return st.fixed_dictionaries({k: value_of(v) for k, v in kind[1].items()})


types = st.recursive(
    st.sampled_from([("number", d) for d in DTYPES] + [("string",)] * 4),
    lambda inner: st.one_of(
        inner.filter(lambda kind: kind[0] != "list").map(lambda kind: ("list", kind)),
        st.dictionaries(st.sampled_from("abcdefg"), inner, max_size=4).map(
            lambda fields: ("message", fields)
        ),
    ),
    max_leaves=8,
)


def column_of(kind: tuple[Any, ...], values: list[Any]) -> Column:
    if kind[0] == "number":
        return Scalars(np.array(values, kind[1]))
    if kind[0] == "string":
        offset = np.cumsum([0] + [len(v) for v in values])
        return Strings(np.frombuffer(b"".join(values), np.uint8), offset)
    if kind[0] == "list":
        offset = np.cumsum([0] + [len(v) for v in values])
        return Arrays(column_of(kind[1], [e for v in values for e in v]), offset)
    fields = {k: column_of(t, [v[k] for v in values]) for k, t in kind[1].items()}
    return Records(fields, len(values))


def summary_of(kind: tuple[Any, ...], values: list[Any]) -> dict[str, Any]:
    found: dict[str, Any] = {"n": Int64(len(values))}
    if kind[0] != "number":
        return found
    real = np.dtype(kind[1]).kind == "f"
    finite = [float(v) if real else int(v) for v in values if math.isfinite(v)]
    if not finite:
        return found | {"min": None, "max": None, "mean": None}
    scalar = ("number", "f8" if real else "u8" if kind[1] == "u8" else "i8")
    for name, value in (("min", min(finite)), ("max", max(finite))):
        found[name] = reference(scalar, value + 0.0 if real else value)
    # The mean of a few numbers: any order gives the same up to rounding; compared apart.
    found["mean"] = math.fsum(v / len(finite) for v in finite)
    return found


def reference(kind: tuple[Any, ...], value: Any) -> Any:
    if kind[0] == "number":
        if kind[1] in {"u4", "i8"}:
            return Int64(value)
        if kind[1] == "u8":
            return Int64(value) if value < 1 << 63 else float(value)
        return value
    if kind[0] == "string":
        return value.decode(errors="replace")
    if kind[0] == "list":
        if len(value) > LIMIT:
            return summary_of(kind[1], value)
        return [reference(kind[1], v) for v in value]
    return {k: reference(t, value[k]) for k, t in kind[1].items()}


def made(records: Records, **options: int) -> list[bytes]:
    """The body of each row; every row must be there exactly once."""
    found: list[bytes | None] = [None] * len(records)
    for group in bodies(records, **{"array_limit": LIMIT} | options):
        assert group.error is None
        assert group.body.dtype == np.uint8
        assert len(group.body) == len(group.rows)
        for row, body in zip(group.rows.tolist(), group.body, strict=True):
            assert found[row] is None
            found[row] = body.tobytes()
    assert None not in found
    return found  # type: ignore[return-value]


def document_of(body: bytes) -> bytes:
    return (len(body) + 5).to_bytes(4, "little") + body + b"\0"


def without_means(value: Any) -> tuple[Any, list[tuple[float, float]]]:
    """The value without the means of its summaries, and each mean with its precision."""
    means: list[tuple[float, float]] = []
    if isinstance(value, dict):
        out = {}
        for k, v in value.items():
            if k == "mean" and v is not None and "n" in value:
                # A sum is rounded relative to its largest parts.
                means.append((v, 1e-300 + 1e-9 * max(abs(value["min"]), abs(value["max"]))))
                continue
            out[k], more = without_means(v)
            means += more
        return out, means
    if isinstance(value, list):
        parts = [without_means(v) for v in value]
        return [p[0] for p in parts], [m for p in parts for m in p[1]]
    return value, means


def assert_same_but_for_rounded_means(document: bytes, expected: dict[str, Any]) -> None:
    if document == bson.encode(expected):
        return
    # Decoding and encoding again loses no type: int64 decodes as Int64.
    theirs, their_means = without_means(expected)
    ours, our_means = without_means(bson.decode(document))
    assert bson.encode(ours) == bson.encode(theirs)
    for (mine, _), (other, precision) in zip(our_means, their_means, strict=True):
        assert mine == pytest.approx(other, rel=1e-9, abs=precision)


def check(kind: tuple[Any, ...], rows: list[Any], **options: int) -> None:
    records = column_of(kind, rows)
    assert isinstance(records, Records)
    for row, body in zip(rows, made(records, **options), strict=True):
        assert_same_but_for_rounded_means(document_of(body), reference(kind, row))


@given(st.data())
def test_any_type_any_values(data: st.DataObject) -> None:
    fields = data.draw(st.dictionaries(st.sampled_from("stuvwxyz"), types, max_size=5))
    kind = ("message", fields)
    check(kind, data.draw(st.lists(value_of(kind), min_size=1, max_size=8)))


@given(st.data())
def test_a_body_does_not_depend_on_the_batch(data: st.DataObject) -> None:
    kind = ("message", data.draw(st.dictionaries(st.sampled_from("stuvwxyz"), types, max_size=5)))
    rows = data.draw(st.lists(value_of(kind), min_size=1, max_size=8))
    records = column_of(kind, rows * 20)
    assert isinstance(records, Records)
    together = made(records)
    for i in range(len(rows)):
        assert made(take(records, np.array([i]))) == [together[i]]
        assert together[i :: len(rows)] == [together[i]] * 20


def test_signalling_nan_is_no_warning() -> None:
    snan = np.array([0x7FA00001], np.uint32).view(np.float32)
    body = made(Records({"v": Scalars(snan)}, 1))[0]
    assert math.isnan(bson.decode(document_of(body))["v"])


@pytest.mark.parametrize("limit", [0, 1, 9, 10, 11, 32, 99, 100, 101, 1001])
@pytest.mark.parametrize("regular", [True, False])
def test_keys_of_long_lists(limit: int, regular: bool) -> None:
    counts = [limit, limit] if regular else [limit, limit - 1 if limit else 0, 0, 1]
    for kind, value in ((("number", "i2"), -7), (("string",), b"xy"), (("message", {}), {})):
        whole = ("message", {"l": ("list", kind)})
        rows = [{"l": [value] * min(n, limit)} for n in counts]
        records = column_of(whole, rows)
        assert isinstance(records, Records)
        for row, body in zip(rows, made(records, array_limit=limit), strict=True):
            listed = [reference(kind, v) for v in row["l"]]
            assert document_of(body) == bson.encode({"l": listed})


def test_too_large_rows_are_named_and_the_others_are_made() -> None:
    kind = ("message", {"s": ("string",), "z": ("number", "i4")})
    texts = [b"a", b"b" * 2000, b"c", b"d" * 1000, b"e" * 5000]
    records = column_of(kind, [{"s": s, "z": 1} for s in texts])
    assert isinstance(records, Records)
    width = {len(s): len(bson.encode({"s": s.decode(), "z": 1})) - 5 for s in texts}
    groups = list(bodies(records, max_bytes=width[1000]))
    large = [g.rows.tolist() for g in groups if g.error is not None]
    assert large == [[1, 4]]
    kept = [
        (row, body.tobytes())
        for g in groups
        if g.error is None
        for row, body in zip(g.rows, g.body, strict=True)
    ]
    assert sorted(r for r, _ in kept) == [0, 2, 3]
    for row, body in kept:
        assert document_of(body) == bson.encode({"s": texts[row].decode(), "z": 1})
    only = list(bodies(records, max_bytes=4))
    assert [g.error for g in only] == ["its fields take more than 0 MiB"]


@pytest.mark.parametrize("regular", [True, False])
def test_bodies_are_made_in_slabs(limit: Limit, regular: bool) -> None:
    limit(document_slab_bytes=1000)
    kind = (
        "message",
        {"s": ("string",), "u": ("list", ("number", "u1")), "m": ("list", ("message", {}))},
    )
    rows = [
        {"s": b"x" * (5 if regular else i % 7), "u": [1] * (i % 8), "m": [{}] * (i % 3)}
        for i in range(200)
    ]
    check(kind, rows)
    sizes = [
        g.body.size
        for g in bodies(column_of(kind, rows), array_limit=LIMIT)  # type: ignore[arg-type]
    ]
    assert max(sizes) <= 1200


def test_columns_may_be_parts_of_larger_ones() -> None:
    data = np.frombuffer(b"....onetwo!!!!", np.uint8)
    strings = Strings(data, np.array([4, 7, 10]))
    numbers = Scalars(np.arange(10, dtype=np.float64)[::5])
    found = made(Records({"s": strings, "v": numbers}, 2))
    assert [bson.decode(document_of(b)) for b in found] == [
        {"s": "one", "v": 0.0},
        {"s": "two", "v": 5.0},
    ]


# --- summaries of arrays against exact arithmetic, and against themselves one at a time


@st.composite
def ragged(draw: st.DrawFn) -> tuple[str, list[list[Any]]]:
    dtype = draw(st.sampled_from(DTYPES))
    rows = draw(st.lists(st.lists(value_of(("number", dtype)), max_size=12), max_size=8))
    # Long rows, too, whose sums numpy makes in blocks.
    times = draw(
        st.lists(st.sampled_from([1, 1, 30, 1500]), min_size=len(rows), max_size=len(rows))
    )
    return dtype, [row * n for row, n in zip(rows, times, strict=True)]


def of(dtype: str, rows: list[list[Any]]) -> Summary:
    offset = np.cumsum([0] + [len(row) for row in rows])
    return summarise(Scalars(np.array([v for row in rows for v in row], dtype)), offset)


def bits(summary: Summary) -> list[bytes]:
    columns = (summary.n, summary.min, summary.max, summary.mean, summary.has)
    return [b"".join(c[i].tobytes() for c in columns) for i in range(len(summary.n))]


@given(ragged())
def test_against_exact_arithmetic(case: tuple[str, list[list[Any]]]) -> None:
    dtype, rows = case
    found = of(dtype, rows)
    assert found.n.tolist() == [len(row) for row in rows]
    for i, row in enumerate(rows):
        finite = [np.dtype(dtype).type(v).item() for v in row if math.isfinite(v)]
        assert found.has[i] == bool(finite)
        if not finite:
            continue
        assert found.min[i] == min(finite)
        assert found.max[i] == max(finite)
        mean = sum(map(Fraction, finite)) / len(finite)
        size = max(abs(Fraction(v)) for v in finite)
        assert math.isfinite(found.mean[i])
        # Rounding of a sum is relative to its largest parts, not to the sum; below the
        # least of all doubles there is nothing to round to.
        bound = size * Fraction(1, 10**9) + Fraction(math.ulp(0.0))
        assert abs(Fraction(found.mean[i].item()) - mean) <= bound


@given(ragged())
def test_a_row_does_not_depend_on_the_others(case: tuple[str, list[list[Any]]]) -> None:
    dtype, rows = case
    alone = [bits(of(dtype, [row]))[0] for row in rows]
    assert bits(of(dtype, rows)) == alone
    assert bits(of(dtype, rows[::-1] + rows)) == alone[::-1] + alone


def test_zero_has_one_sign() -> None:
    for row in ([0.0, -0.0], [-0.0, 0.0], [-0.0] * 40):
        found = of("f8", [row])
        assert not np.signbit([found.min[0], found.max[0], found.mean[0]]).any()


def test_a_sum_past_the_largest_double_has_a_mean() -> None:
    assert of("f8", [[1e308] * 40]).mean[0] == pytest.approx(1e308)
    assert of("f8", [[1e308, -1e308] * 40, [1.0]]).mean.tolist() == [0.0, 1.0]
