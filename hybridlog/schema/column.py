"""Columns: the fields of many messages, one array a field.

The wire reader (`wire.py`) turns payloads into these; BSON documents, Arrow tables
and pandas frames are made from them. A column never holds a Python object a row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(slots=True)
class Scalars:
    """Numbers, booleans or times.

    Attributes:
        values: shape (n,), native byte order, dtype as on the wire (bool, int8 to
            uint64, float32, float64). Times and durations are int64 nanoseconds.
        kind: What the numbers mean.
    """

    values: NDArray[Any]
    kind: Literal["number", "time", "duration"] = "number"

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.values)


@dataclass(slots=True)
class Strings:
    """Strings, as their bytes came (UTF-8 is not checked here), without terminating NUL.

    Attributes:
        data: uint8, all strings one after the other, from `offset[0]` to `offset[n]`.
        offset: int64[n + 1].
    """

    data: NDArray[np.uint8]
    offset: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.offset) - 1


@dataclass(slots=True)
class Arrays:
    """Arrays and sequences: row i holds elements `offset[i]:offset[i + 1]` of `values`.

    Attributes:
        values: All elements one after the other.
        offset: int64[n + 1]; offset[0] is 0.
        width: Elements a row when the definition fixes that number, else None.
    """

    values: Column
    offset: NDArray[np.int64]
    width: int | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.offset) - 1


@dataclass(slots=True)
class Records:
    """Messages within messages, and the top level itself.

    Attributes:
        fields: Column of each field, in the order of the definition.
        rows: Number of rows (a message without fields has rows all the same).
    """

    fields: dict[str, Column]
    rows: int

    def __len__(self) -> int:
        """Number of rows."""
        return self.rows


Column: TypeAlias = Scalars | Strings | Arrays | Records


def header_stamps(records: Records) -> NDArray[np.int64] | None:
    """The header stamps of decoded messages, ns; None when they have no header."""
    header = records.fields.get("header")
    stamp = header.fields.get("stamp") if isinstance(header, Records) else None
    return stamp.values if isinstance(stamp, Scalars) and stamp.kind == "time" else None
