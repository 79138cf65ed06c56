"""Generated messages of ROS types with extreme values, and their comparison."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_KILTED)

TEXTS = (
    "",
    "base_link",
    "é ß 漢字 🤖",
    'quote " comma , \\ line\nbreak',
    "null",
    "  ",
    "-1",
    "NaN",
)
FLOATS = (0.0, -0.0, 1.5, -math.pi, math.nan, math.inf, -math.inf, 1e-300, 5e-324, 1.8e308 / 10)


def message_of(store: Typestore, name: str, rng: np.random.Generator) -> Any:
    """A message of a type: extremes, numbers that are none, and arrays of 0 to 40 elements."""
    values = {key: _value(store, desc, rng) for key, desc in store.fielddefs[name][1]}
    if name.startswith("builtin_interfaces/"):
        values = {
            "sec": int(rng.choice([0, 1, 2**31 - 1])),
            "nanosec": int(rng.choice([0, 999999999])),
        }
    return store.types[name](**values)


def _value(store: Typestore, desc: Any, rng: np.random.Generator) -> Any:
    node, detail = desc
    if node == Nodetype.BASE:
        return _base(detail[0], rng)
    if node == Nodetype.NAME:
        return message_of(store, detail, rng)
    inner, size = detail
    if node == Nodetype.SEQUENCE:
        most = min(size or 40, 3 if inner[0] == Nodetype.NAME else 40)
        size = int(rng.choice([0, 1, rng.integers(0, most + 1), most]))
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        kind = _dtype(inner[1][0])
        return np.array([_base(inner[1][0], rng) for _ in range(size)], kind)
    return [_value(store, inner, rng) for _ in range(size)]


def _dtype(kind: str) -> np.dtype[Any]:
    return np.dtype({"byte": "uint8", "char": "uint8", "octet": "uint8"}.get(kind, kind))


def _base(kind: str, rng: np.random.Generator) -> Any:
    if kind == "string":
        return str(rng.choice(TEXTS))
    if kind == "bool":
        return bool(rng.integers(2))
    if kind == "byte":  # whose sign rosbags and the versions of ROS do not agree on
        return int(rng.integers(128))
    dtype = _dtype(kind)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return float(dtype.type(rng.choice(FLOATS) if rng.integers(3) else rng.normal()))
    low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    return int(rng.choice(np.array([low, high, 0, 1, low // 3, high // 3], object)))


def names_of(message: Any) -> list[str]:
    """The fields of a message, without constants."""
    return [f.name for f in fields(message) if not str(f.type).startswith("ClassVar")]


def same(found: Any, wanted: Any) -> None:
    """Check that two messages of rosbags are equal, value by value; NaN equals NaN."""
    if isinstance(wanted, np.ndarray):
        np.testing.assert_array_equal(found, wanted)
        assert found.dtype == wanted.dtype
    elif isinstance(wanted, list):
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            same(one, other)
    elif hasattr(wanted, "__msgtype__"):
        assert names_of(found) == names_of(wanted)
        for name in names_of(wanted):
            same(getattr(found, name), getattr(wanted, name))
    elif isinstance(wanted, float) and math.isnan(wanted):
        assert math.isnan(found)
    else:
        assert found == wanted


class Time(int):
    """Nanoseconds since the epoch."""


class Duration(int):
    """A length of time, ns."""


def plain_of(store: Typestore, name: str, message: Any) -> Any:
    """A message as dicts and lists; times are `Time` and `Duration`, floats keep their width.

    Arrays of numbers are numpy arrays.
    """
    if name in {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}:
        kind = Time if name.endswith("Time") else Duration
        return kind(int(message.sec) * 10**9 + int(message.nanosec))
    names = names_of(message)
    descs = [desc for _, desc in store.fielddefs[name][1]]
    return {
        key: _plain(store, desc, getattr(message, key))
        for key, desc in zip(names, descs, strict=True)
        if key != "structure_needs_at_least_one_member"  # what rosbags has of an empty message
    }


def _plain(store: Typestore, desc: Any, value: Any) -> Any:
    node, detail = desc
    if node == Nodetype.NAME:
        return plain_of(store, detail, value)
    if node == Nodetype.BASE:
        if detail[0] == "float32":
            return np.float32(value)
        return value if detail[0] == "string" else np.dtype(_dtype(detail[0])).type(value).item()
    inner, _ = detail
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        numbers = np.asarray(value)
        return numbers.view(np.uint8) != 0 if inner[1][0] == "bool" else numbers
    return [_plain(store, inner, item) for item in value]
