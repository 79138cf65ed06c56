"""A part of many cases by default, and all of them by `-m exhaustive`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

EXHAUSTIVE = pytest.mark.exhaustive


def each(*cases: Any) -> list[Any]:
    """Cases that are tried by `-m exhaustive` alone."""
    return [pytest.param(case, marks=EXHAUSTIVE) for case in cases]


def in_turn(ones: Sequence[Any], others: Sequence[Any], every: int = 1) -> list[Any]:
    """All pairs, by the others; by default each of the ones, or every n-th, is in one of them."""
    return [
        pytest.param(
            one,
            other,
            marks=EXHAUSTIVE if number % every or place != number // every % len(others) else [],
        )
        for place, other in enumerate(others)
        for number, one in enumerate(ones)
    ]
