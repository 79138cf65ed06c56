"""The order of rows by several keys."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def order_of(*keys: NDArray[Any]) -> NDArray[np.intp] | None:
    """The order of rows; None if they are in order.

    Args:
        keys: The keys of each row, the most significant first.
    """
    is_tie = np.ones(max(len(keys[0]) - 1, 0), np.bool_)
    for key in keys:
        if (is_tie & (key[1:] < key[:-1])).any():
            return np.lexsort(keys[::-1])
        is_tie &= key[1:] == key[:-1]
        if not is_tie.any():
            break
    return None
