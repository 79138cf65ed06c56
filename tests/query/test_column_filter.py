"""Filters on columns, against exact arithmetic on each value."""

from __future__ import annotations

import operator
from fractions import Fraction

import numpy as np
import pytest
from hybridlog.query.column_filter import column_filter

from hybridlog.schema.column import Scalars

ORDERS = {
    "$eq": operator.eq,
    "$lt": operator.lt,
    "$lte": operator.le,
    "$gt": operator.gt,
    "$gte": operator.ge,
}


@pytest.mark.parametrize("name", ["int8", "uint32", "int64", "float32", "float64"])
@pytest.mark.parametrize("order", ORDERS)
def test_numbers_are_compared_by_value(name: str, order: str) -> None:
    """Also with what lies between two integers, or is no value of the type."""
    dtype = np.dtype(name)
    values = np.array([0, 1, 2, 100], dtype)
    if dtype.kind == "i":
        values = np.append(values, [np.iinfo(dtype).min, np.iinfo(dtype).max, -1])
    elif dtype.kind == "f":
        values = np.append(values, np.array([0.1, 0.5, -1.5], dtype))
    bounds = [-1.5, -1, -0.5, 0, 0.1, 0.5, 1, 1.5, 2, 2.5, 99.5, 127.5, 2**40, 2**53 - 1, 1e300]
    if dtype.kind != "f":
        bounds += [2**53 + 1, 2**63 - 1, 2.0**63, -(2**63), -1e300]
    for bound in bounds:
        compiled = column_filter({"x": {order: bound}}, {"x": name})
        assert compiled is not None
        found = compiled.mask({"x": Scalars(values)}, len(values)).tolist()
        expected = [ORDERS[order](Fraction(v), Fraction(bound)) for v in values.tolist()]
        assert found == expected, bound
