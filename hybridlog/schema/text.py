"""Plain Python values as JSON text, text that UTF-8 can encode, and numbers as doubles."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

MAX_DEPTH = 32
"""Values with deeper nesting are JSON text in columns.

A list is two levels of a Parquet schema, and readers of Parquet take at most 100 levels.
"""


def json_text(value: object) -> str:
    """A value as compact JSON, with NaN and infinities as strings, as protobuf writes them."""
    try:
        text = json.dumps(
            value, ensure_ascii=False, allow_nan=False, separators=(",", ":"), default=str
        )
    except ValueError:
        return json_text(without_nan(value))
    except RecursionError:
        text = json.dumps("nested too deep")
    return repaired_text(text)


def without_nan(value: object, default: Callable[[Any], object] = str) -> Any:
    """The value with `"NaN"`, `"Infinity"` and `"-Infinity"` for numbers that JSON lacks."""
    return json.loads(json.dumps(value, default=default), parse_constant=str)


def repaired_text(text: str) -> str:
    """The text, with U+FFFD for unpaired surrogates, which UTF-8 cannot encode."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return text.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")
    return text


def nearest(value: float) -> float:
    """The nearest double; an infinity beyond the largest."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf
