"""The fields of a topic that can be drawn over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from hybridlog.frames.names import is_summary
from hybridlog.query.answers.infer_fields import infer_fields
from hybridlog.schema.kinds import NUMERIC, element_of, width_of
from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hybridlog.message import Message


MAX_FIELDS: Final = 5000
"""Most fields of a topic that are listed."""
MAX_ELEMENTS: Final = 36
"""Most elements of an array that are listed one by one: those of a covariance."""

_SUMMARIES: Final = ("min", "max", "mean", "n")
_IN_JSON: Final = ("bool", "integer", "number")


class Field(NamedTuple):
    """A field, as `series` takes it, and its type."""

    path: str
    type: str


def fields_of(known: Mapping[str, str] | None, messages: Iterator[Message]) -> list[Field]:
    """Numbers, elements of short arrays and summaries of arrays, in the order of the definition.

    Args:
        known: Types of all fields by path; None where no definition fixes them, and those of
            the first messages count.
        messages: The messages; only the first ones are read.
    """
    found = _observed(messages) if known is None else _defined(known, messages)
    return list(islice(found, MAX_FIELDS))


def _defined(known: Mapping[str, str], messages: Iterator[Message]) -> Iterator[Field]:
    first = None
    with suppress(SegmentError):  # damage hides how long arrays are, and no field
        first = next(messages, None)
    values = {} if first is None else first.fields
    for path, kind in known.items():
        if "[" in path:
            continue  # within the elements of an array
        if kind in NUMERIC:
            yield Field(path, kind)
            continue
        summaries = (f"{path}.{name}" for name in _SUMMARIES)
        yield from (Field(name, "summary") for name in summaries if is_summary(name, known))
        element = element_of(kind)
        if element in NUMERIC:
            width = _width(kind, path, values)
            yield from (Field(f"{path}[{n}]", element) for n in range(width))


def _width(kind: str, path: str, values: Mapping[str, Any]) -> int:
    """Number of elements that are listed: of a fixed array, or of the first message."""
    width = width_of(kind)
    if width is None:
        value: Any = values
        for name in path.split("."):
            value = value.get(name) if isinstance(value, Mapping) else None
        width = len(value) if isinstance(value, list) else 0
    return width if width <= MAX_ELEMENTS else 0


def _observed(messages: Iterator[Message]) -> Iterator[Field]:
    for found in infer_fields(messages):
        path, kinds = str(found["path"]), str(found["type"]).split("|")
        # A name within backquotes may have dots, which a path cannot tell from its own.
        if not found["array"] and "`" not in path and any(kind in _IN_JSON for kind in kinds):
            yield Field(path, "|".join(kinds))
