"""Numbers as small bars of text."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCKS = "▁▂▃▄▅▆▇█"
_PLAIN = "_.-:=+*#"
"""For terminals whose encoding lacks blocks."""


def sparkline(values: NDArray[np.float64]) -> str:
    """A letter for each number, from the least to the greatest; a space for NaN."""
    letters = np.array(list(_letters()))
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
    letters = np.array([" ", *_letters()])
    steps = len(letters) - 1
    most = max(int(counts.max(initial=0)), 1)
    return "".join(letters[-(-counts * steps // most)].tolist())


def bar(is_lost: NDArray[np.bool_]) -> str:
    """A bar of what is there, with holes where something is lost."""
    full, hole = "█░" if _letters() is _BLOCKS else "#."
    return "".join(hole if lost else full for lost in is_lost.tolist())


def _letters() -> str:
    try:
        (_BLOCKS + "░").encode(sys.stdout.encoding or "ascii")
    except UnicodeEncodeError:
        return _PLAIN
    return _BLOCKS
