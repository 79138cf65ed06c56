"""Messages that are decoded to Python objects one by one, such as those of JSON.

JSON and protobuf have no fixed layout, so their payloads cannot be read by columns. Each
becomes a plain object (dict, list, str, bool, int, float, None); this module makes index
bodies by the rules of `document.py` from it.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import bson
import numpy as np
from bson.errors import BSONError
from bson.int64 import Int64

from hybridlog.schema.column import RESERVED, Wanted, names_of, summary_of, top_level_names
from hybridlog.schema.document import ARRAY_LIMIT, MAX_BYTES, BodyGroup
from hybridlog.schema.text import nearest, repaired_text
from hybridlog_storage.errors import PayloadError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    import pyarrow as pa

Plain: TypeAlias = "dict[str, Plain] | list[Plain] | str | bytes | bool | int | float | None"
"""What a payload is made of. An `Int64` is stored as int64 whatever its value."""

MAX_DEPTH = 100
"""Deepest nesting that MongoDB surely accepts."""

_INT64_MIN, _INT64_MAX = -(1 << 63), (1 << 63) - 1


_LONG = frozenset(("int64", "uint32", "uint64"))


def plain_cells(array: pa.Array[Any], *, typed: bool) -> list[Any] | None:
    """Cells of an array as plain values have them, for `plain_values`.

    With `typed`, a definition fixes the width of integers.
    """
    from hybridlog.schema.arrow_types import is_bytes, is_time

    if is_bytes(array.type):
        return cast("list[Any]", array.to_pylist())
    if is_time(array.type):
        array = array.view("int64")
    elif not (typed and str(array.type) in _LONG):
        return None
    return [None if value is None else Int64(value) for value in array.to_pylist()]


@dataclass(slots=True)
class Objects:
    """Some messages as Python objects.

    Attributes:
        values: The objects, as `Codec.decode` returns them.
        fields: Dotted paths of those wanted in `arrow`, each with all below it; None for all.
    """

    values: list[Any]
    fields: Collection[str] | None = None

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.values)

    @property
    def is_typed(self) -> bool:
        """True if a definition fixes the types of the fields."""
        return False

    def plain(self) -> list[dict[str, object]]:
        """The messages as plain values: dict, list, str, bytes, bool, int, float, None.

        A field that a message lacks is not there. Times and durations are integer nanoseconds.
        """
        return [cast("dict[str, object]", top(value)) for value in self.values]

    def arrow(self) -> pa.StructArray:
        """The messages as an Arrow array; see `Decoded.arrow`."""
        from hybridlog.schema.arrow_types import objects_array

        return objects_array(self.plain(), self.wanted())

    def wanted(self) -> Wanted:
        """The wanted paths as the names they consist of."""
        return None if self.fields is None else [*map(names_of, self.fields)]

    def bodies(self) -> Iterator[BodyGroup]:
        """As of `document.bodies`."""
        found = defaultdict[tuple[int, str | None], list[tuple[int, bytes]]](list)
        for row, value in enumerate(self.plain()):
            body, error = _body_of(value)
            found[len(body), error].append((row, body))
        for (width, error), own in found.items():
            table = np.frombuffer(b"".join(body for _, body in own), np.uint8)
            rows = np.array([row for row, _ in own], np.intp)
            yield BodyGroup(rows, table.reshape(len(own), width), error)


def _body_of(value: dict[str, Any]) -> tuple[bytes, str | None]:
    """The BSON elements of the index document of one message, or why there are none."""
    try:
        document = bson.encode({_key(k): _indexed(v, 2) for k, v in value.items()})
        if len(document) - 5 > MAX_BYTES:
            raise PayloadError(f"its fields take more than {MAX_BYTES >> 20} MiB")
    except (PayloadError, BSONError, OverflowError, ValueError, RecursionError) as error:
        return b"", f"it cannot be a document: {error}"
    return document[4:-1], None


def top(value: Plain) -> dict[str, Plain]:
    """The top level of the document that a value becomes."""
    if not isinstance(value, dict):
        return {"value": value}
    if not value.keys().isdisjoint(RESERVED):
        return dict(zip(top_level_names(value), value.values(), strict=True))
    return value


def _indexed(value: Plain, depth: int) -> object:
    if isinstance(value, dict | list) and depth > MAX_DEPTH:
        raise PayloadError(f"it is nested deeper than {MAX_DEPTH}")
    if isinstance(value, dict):
        return {_key(k): _indexed(v, depth + 1) for k, v in value.items()}
    if isinstance(value, bytes) or (isinstance(value, list) and len(value) > ARRAY_LIMIT):
        return _summary(value)
    if isinstance(value, list):
        return [_indexed(v, depth + 1) for v in value]
    if isinstance(value, str):
        return repaired_text(value)
    if isinstance(value, int) and not _INT64_MIN <= value <= _INT64_MAX:
        return nearest(value)
    return value


def _key(key: str) -> str:
    return repaired_text(key).replace("\0", "\N{REPLACEMENT CHARACTER}")


def _summary(values: list[Plain] | bytes) -> dict[str, object]:
    found: dict[str, object] = {"n": Int64(len(values))}
    summary = None if isinstance(values, bytes) else summary_of(values)
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
