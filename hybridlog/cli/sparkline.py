"""Numbers as small bars of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCKS = "▁▂▃▄▅▆▇█"


def sparkline(values: NDArray[np.float64]) -> str:
    """A letter for each number, from the least to the greatest; a space for NaN."""
    letters = np.array(list(_BLOCKS))
    is_known = np.isfinite(values)
    found = np.full(len(values), " ")
    if is_known.any():
        # Halved, so that the range of the greatest numbers is finite, too.
        known = values[is_known] / 2
        low, high = known.min(), known.max()
        share = (known - low) / (high - low) if high > low else np.full(len(known), 0.5)
        found[is_known] = letters[
            np.minimum(share * len(letters), len(letters) - 1).astype(np.intp)
        ]
    return "".join(found.tolist())


def densities(counts: NDArray[np.int64]) -> str:
    """A letter for each count, from 0 to the greatest; a space for 0."""
    letters = np.array([" ", *_BLOCKS])
    steps = len(letters) - 1
    most = max(int(counts.max(initial=0)), 1)
    return "".join(letters[-(-counts * steps // most)].tolist())
