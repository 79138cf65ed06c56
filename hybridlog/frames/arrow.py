"""Strings of columns, compared by Arrow."""

from __future__ import annotations

from operator import eq, ge, gt, le, lt
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog.schema.column import Strings


def compared(column: Strings, order: Callable[[Any, Any], Any], value: str) -> Any:
    """Which strings stand in an order to a value, byte by byte.

    Args:
        column: Valid UTF-8.
        order: One of the five of the module `operator`, `ne` apart.
        value: What they are compared with.

    Returns:
        bool[n].
    """
    compare = {
        eq: pc.equal,
        lt: pc.less,
        le: pc.less_equal,
        gt: pc.greater,
        ge: pc.greater_equal,
    }[order]
    data, offset = np.ascontiguousarray(column.data), np.ascontiguousarray(column.offset)
    buffers = [None, pa.py_buffer(offset), pa.py_buffer(data)]
    text = pa.Array.from_buffers(pa.large_string(), len(column), buffers)
    return compare(text, pa.scalar(value, pa.large_string())).to_numpy(zero_copy_only=False)
