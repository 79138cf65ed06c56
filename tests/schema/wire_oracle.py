"""What rosbags reads, compared with columns."""

from __future__ import annotations

import itertools

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from hybridlog.schema.column import Arrays, Records, Scalars, Strings
from hybridlog.schema.definition import ArrayOf, Instant, MessageType, Primitive, Text

DUMMY = "structure_needs_at_least_one_member"


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
    assert found.dtype == kind.dtype, path
    assert found.dtype.isnative
    assert found.flags.c_contiguous
    assert found.flags.aligned
    if kind.name == "bool":
        # rosbags does not normalise the bytes of bool arrays.
        expected = np.asarray(values, np.bool_).view(np.uint8) != 0
    elif kind.name in {"byte", "char"}:
        # rosbags has one signedness for both versions of ROS.
        expected = (np.asarray(values, np.int64) & 0xFF).astype(np.uint8).view(kind.dtype)
    else:
        expected = np.asarray(values, kind.dtype)
    np.testing.assert_array_equal(found, expected, err_msg=path, strict=True)
