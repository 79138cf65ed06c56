"""Names of the primitive types of fields: `float64`, `time`, `string`.

A new type of number is added here. Its bytes on the wire follow from its numpy type, its
column from `pa.from_numpy_dtype`.
"""

from __future__ import annotations

import re
from typing import Final

DTYPES: Final = {
    "bool": "?",
    "byte": "u1",  # signed in ROS 1
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
"""Numpy type of each primitive type."""
FLOATS: Final = frozenset(name for name, dtype in DTYPES.items() if dtype[0] == "f")
INTEGERS: Final = frozenset(name for name, dtype in DTYPES.items() if dtype[0] in "iu")
NUMBERS: Final = FLOATS | INTEGERS
TIMES: Final = frozenset({"time", "duration"})
NUMERIC: Final = NUMBERS | TIMES | {"bool"}
"""Types whose values can be drawn as numbers."""

_ARRAY = re.compile(r"(?P<element>.*)\[(?P<bound><=)?(?P<width>\d*)\]", re.DOTALL)


def element_of(kind: str) -> str | None:
    """Type of the elements of an array type; None if it is no array."""
    found = _ARRAY.fullmatch(kind)
    return None if found is None else found["element"]


def width_of(kind: str) -> int | None:
    """Number of elements of an array type whose length is fixed: 9 for `float64[9]`."""
    found = _ARRAY.fullmatch(kind)
    return int(found["width"]) if found and found["width"] and not found["bound"] else None
