"""Index bodies and columns of messages that are decoded to Python objects.

JSON and protobuf have no fixed layout, so their payloads cannot be read by columns. Each
becomes a plain object (dict, list, str, bool, int, float, None), and this module applies
the rules of `document.py` to it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import bson
import numpy as np
from bson.errors import BSONError
from bson.int64 import Int64

from hybridlog.schema.codec import (
    BodyGroup,
    DecodedArrow,
    DecodedObjects,
    error_group,
)
from hybridlog.schema.document import top_level_names
from hybridlog.schema.summary import nearest_double, summary_of
from hybridlog.schema.utf8 import repaired_text
from hybridlog.schema.wire import Unreadable
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Buffer

_T = TypeVar("_T")
Plain: TypeAlias = "dict[str, Plain] | list[Plain] | str | bytes | bool | int | float | None"
"""What a payload is made of. An `Int64` is stored as int64 whatever its value."""

MAX_BYTES = 8 << 20
MAX_DEPTH = 100
"""Deepest nesting that MongoDB surely accepts."""

_INT64_MIN, _INT64_MAX = -(1 << 63), (1 << 63) - 1


class Nanoseconds(Int64):
    """A time or a duration.

    Attributes:
        kind: Time or duration.
    """

    kind: str = "time"


class Duration(Nanoseconds):
    """A duration."""

    kind = "duration"


def body_of(value: Plain, array_limit: int) -> bytes:
    """The BSON elements of the index document of one message.

    Raises:
        PayloadError: It cannot be a document; the message names the reason.
    """
    try:
        fields = {_key(k): _indexed(v, array_limit, 2) for k, v in top(value).items()}
        document = bson.encode(fields)
    except (BSONError, OverflowError, ValueError, RecursionError) as error:
        raise PayloadError(f"it cannot be a document: {error}") from error
    if len(document) - 5 > MAX_BYTES:
        raise PayloadError(f"its fields take more than {MAX_BYTES >> 20} MiB")
    return document[4:-1]


def top(value: Plain) -> dict[str, Plain]:
    """The top level of the document that a value becomes."""
    if not isinstance(value, dict):
        return {"value": value}
    if "_id" in value or "_meta" in value:
        return dict(zip(top_level_names(value), value.values(), strict=True))
    return value


def _indexed(value: Plain, limit: int, depth: int) -> object:
    if isinstance(value, dict | list) and depth > MAX_DEPTH:
        raise PayloadError(f"it is nested deeper than {MAX_DEPTH}")
    if isinstance(value, dict):
        return {_key(k): _indexed(v, limit, depth + 1) for k, v in value.items()}
    if isinstance(value, list):
        if len(value) > limit:
            return _summary(value)
        return [_indexed(v, limit, depth + 1) for v in value]
    if isinstance(value, str):
        return repaired_text(value)
    if isinstance(value, int) and not _INT64_MIN <= value <= _INT64_MAX:
        return nearest_double(value)
    return value


def _key(key: str) -> str:
    return repaired_text(key).replace("\0", "\N{REPLACEMENT CHARACTER}")


def _summary(values: list[Plain]) -> dict[str, object]:
    found: dict[str, object] = {"n": Int64(len(values))}
    summary = summary_of(values)
    if summary is None:
        return found
    if not summary.has[0]:
        return found | {"min": None, "max": None, "mean": None}
    low, high = _element(summary.min[0].item()), _element(summary.max[0].item())
    return found | {"min": low, "max": high, "mean": summary.mean[0].item()}


def _element(value: float) -> float:
    if isinstance(value, int):
        return Int64(value) if value <= _INT64_MAX else float(value)
    return value


def payloads_of(
    buffer: Buffer, offset: NDArray[np.int64], length: NDArray[np.int64]
) -> Iterator[memoryview]:
    """Each payload, without a copy."""
    view = memoryview(buffer)
    for start, size in zip(offset.tolist(), length.tolist(), strict=True):
        yield view[start : start + size]


def body_groups(bodies: Iterator[bytes | PayloadError]) -> Iterator[BodyGroup]:
    """Group the document bodies of messages by their length in bytes."""
    by_width: dict[int, tuple[list[int], list[bytes]]] = {}
    by_error: dict[str, list[int]] = {}
    for row, body in enumerate(bodies):
        if isinstance(body, PayloadError):
            by_error.setdefault(str(body), []).append(row)
            continue
        rows, parts = by_width.setdefault(len(body), ([], []))
        rows.append(row)
        parts.append(body)
    for width, (rows, parts) in by_width.items():
        table = np.frombuffer(b"".join(parts), np.uint8).reshape(len(rows), width)
        yield BodyGroup(np.array(rows, np.intp), table, None)
    for text, rows in by_error.items():
        yield error_group(np.array(rows, np.intp), text)


def arrow_of(
    read: Callable[[memoryview], _T],
    build: Callable[[Sequence[_T], Sequence[Sequence[str]] | None], pa.StructArray],
    payloads: Iterator[memoryview],
    fields: Collection[str] | None,
) -> DecodedArrow:
    """An Arrow struct array of payloads that become objects one by one.

    Args:
        read: Makes the object; raises PayloadError.
        build: Makes an array of objects, of the paths that are wanted.
        payloads: In the order of the rows.
        fields: Dotted paths of those wanted, each with all below it; None for all.
    """
    rows, objects, unreadable = _read(read, payloads)
    return DecodedArrow(rows, build(objects, _names(fields)), unreadable)


def objects_of(
    read: Callable[[memoryview], Mapping[str, Any]], payloads: Iterator[memoryview]
) -> DecodedObjects:
    """Payloads as the objects that they become one by one.

    Args:
        read: Makes the object; raises PayloadError.
        payloads: In the order of the rows.
    """
    return DecodedObjects(*_read(read, payloads))


def _read(
    read: Callable[[memoryview], _T], payloads: Iterator[memoryview]
) -> tuple[NDArray[np.intp], list[_T], list[Unreadable]]:
    """Rows that could be read, their objects, and the rows that could not."""
    rows: list[int] = []
    objects: list[_T] = []
    bad: dict[str, list[int]] = {}
    for row, payload in enumerate(payloads):
        try:
            objects.append(read(payload))
        except PayloadError as error:
            bad.setdefault(str(error), []).append(row)
            continue
        rows.append(row)
    unreadable = [Unreadable(np.array(r, np.intp), text) for text, r in bad.items()]
    return np.array(rows, np.intp), objects, unreadable


def _names(fields: Collection[str] | None) -> list[list[str]] | None:
    """Dotted paths as the names they consist of."""
    return None if fields is None else [f.replace("[]", "").split(".") for f in fields]
