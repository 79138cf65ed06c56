"""JSON lines with one value in them that nobody expects."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from typing import Any

from hypothesis import strategies as st

Path = tuple[str | int, ...]

ODD = (
    None, True, -1, 0, 7, 2**48, 2**62, 2**63 - 1, -(2**63), 2**64, 10**40, 1.5, 1e308,
    float("nan"), float("inf"), "", "x", "../x", ".x", "a/b", "x\0y", "\ud800", "y" * 300,
    "\x1b[31m\n", "open", "9", [], [None], [[[]]], {}, {"x": 1}, {"x\0": 1},
)  # fmt: skip

VALUES = st.sampled_from(ODD) | st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


def places(lines: Sequence[dict[str, Any]]) -> list[tuple[int, Path]]:
    """Every value in some lines: number of the line, from 0, and names on the way to it."""
    return [(number, path) for number, line in enumerate(lines) for path in _paths(line) if path]


def _paths(value: Any, at: Path = ()) -> Iterator[Path]:
    yield at
    items = value.items() if isinstance(value, dict) else ()
    for name, inner in enumerate(value[:2]) if isinstance(value, list) else items:
        yield from _paths(inner, (*at, name))


def with_value(line: Any, path: Path, value: Any) -> Any:
    """A line with another value at a place."""
    if not path:
        return value
    changed = copy.copy(line)
    changed[path[0]] = with_value(line[path[0]], path[1:], value)
    return changed


def without(line: Any, path: Path) -> Any:
    """A line without the value at a place."""
    changed = copy.copy(line)
    if len(path) == 1:
        del changed[path[0]]
    else:
        changed[path[0]] = without(line[path[0]], path[1:])
    return changed
