"""Summaries of arrays against exact arithmetic, and against themselves one at a time."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.schema.column import Scalars, Summary, summarise

DTYPES = ["?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"]


def elements(dtype: str) -> st.SearchStrategy[Any]:
    kind = np.dtype(dtype)
    if kind.kind == "b":
        return st.booleans()
    if kind.kind == "f":
        special = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.0])
        return st.floats(width=8 * kind.itemsize) | special
    info = np.iinfo(kind)
    return st.integers(int(info.min), int(info.max))


@st.composite
def ragged(draw: st.DrawFn) -> tuple[str, list[list[Any]]]:
    dtype = draw(st.sampled_from(DTYPES))
    rows = draw(st.lists(st.lists(elements(dtype), max_size=12), max_size=8))
    # Long rows, too, whose sums numpy makes in blocks.
    times = draw(st.lists(st.sampled_from([1, 1, 30, 400]), min_size=len(rows), max_size=len(rows)))
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


@pytest.mark.parametrize("dtype", ["f4", "u1", "i1", "u2", "i2", "u4"])
@pytest.mark.parametrize("width", [4095, 4096, 5001, 40_000])
def test_rows_of_one_length_are_as_among_others(dtype: str, width: int) -> None:
    rng = np.random.default_rng(width)
    rows = (rng.normal(size=(23, width)) * 1e6).astype(np.int64).astype(dtype)
    offset = np.arange(24) * width
    together = bits(summarise(Scalars(rows.ravel()), offset))
    other = np.ones(7000, dtype)
    among = summarise(Scalars(np.append(rows.ravel(), other)), np.append(offset, 23 * width + 7000))
    assert together == bits(among)[:-1]
    assert len(set(together)) > 1


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2"])
@pytest.mark.parametrize("extreme", ["min", "max"])
def test_long_rows_of_extreme_integers(dtype: str, extreme: str) -> None:
    value = int(getattr(np.iinfo(dtype), extreme))
    for count in (4096, 4097, 70_001):
        found = of(dtype, [[value] * count])
        assert found.min[0] == found.max[0] == value
        assert found.mean[0] == value


def test_zero_has_one_sign() -> None:
    for row in ([0.0, -0.0], [-0.0, 0.0], [-0.0] * 40):
        found = of("f8", [row])
        assert not np.signbit([found.min[0], found.max[0], found.mean[0]]).any()


def test_a_sum_past_the_largest_double_has_a_mean() -> None:
    assert of("f8", [[1e308] * 40]).mean[0] == pytest.approx(1e308)
    assert of("f8", [[1e308, -1e308] * 40, [1.0]]).mean.tolist() == [0.0, 1.0]
