"""Zones: the least and the greatest number of each region of an array, by row group.

They tell in which row groups a predicate on elements of an array cannot hold, so these are
not read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.query.predicate.tree import And, Compare, Or
from hybridlog.schema.column import ranges

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.predicate.tree import Node

MAX_REGIONS: Final = 32
"""Most regions of an array."""
_MIN_WIDTH = 16
_SUMMARIES = frozenset({"min", "max", "mean"})


@dataclass(frozen=True, slots=True)
class Zone:
    """The numbers of an array in a row group.

    Attributes:
        width: Elements of a region.
        low: Least number of each region over all rows, without NaN; None without any.
        high: Greatest number of each region.
    """

    width: int
    low: tuple[float | None, ...]
    high: tuple[float | None, ...]

    @classmethod
    def of(cls, values: NDArray[Any], bounds: NDArray[np.int64]) -> Zone:
        """The zone of some arrays.

        Args:
            values: All elements, one array after the other.
            bounds: int64[n + 1], bounds of each array.
        """
        counts = np.diff(bounds)
        longest = int(counts.max(initial=0))
        width = max(_MIN_WIDTH, -(-longest // MAX_REGIONS))
        region = ranges(np.zeros_like(counts), counts) // width
        order = np.argsort(region, kind="stable")
        starts = np.searchsorted(region[order], np.arange(-(-longest // width)))
        chosen = values[order]
        if not len(starts):
            return cls(width, (), ())
        with np.errstate(invalid="ignore"):
            low = np.fmin.reduceat(chosen, starts).tolist()
            high = np.fmax.reduceat(chosen, starts).tolist()
        return cls(width, tuple(map(_or_none, low)), tuple(map(_or_none, high)))

    def to_json(self) -> list[Any]:
        """As values for JSON, which has no infinity."""
        return [self.width, list(map(_spelled, self.low)), list(map(_spelled, self.high))]

    @classmethod
    def from_json(cls, value: Sequence[Any]) -> Zone:
        """The opposite of `to_json`.

        Raises:
            TypeError, ValueError: The value is invalid.
        """
        width, low, high = value
        found = cls(int(width), tuple(map(_read, low)), tuple(map(_read, high)))
        if found.width < 1 or len(found.low) != len(found.high):
            raise ValueError("a zone contradicts itself")
        return found

    def may_hold(self, order: str, wanted: float, element: int | None) -> bool:
        """False if no element can satisfy a comparison.

        Args:
            order: The comparison.
            wanted: The number to compare with.
            element: Number of the element; None for any.
        """
        if element is None:
            pairs = list(zip(self.low, self.high, strict=True))
        else:
            place = element // self.width
            pairs = [(self.low[place], self.high[place])] if place < len(self.low) else []
        return any(
            low is not None and high is not None and _may(order, low, high, wanted)
            for low, high in pairs
        )


def _may(order: str, low: float, high: float, wanted: float) -> bool:
    return {
        "<": low < wanted,
        "<=": low <= wanted,
        ">": high > wanted,
        ">=": high >= wanted,
        "==": low <= wanted <= high,
    }.get(order, True)


def may_hold(node: Node, zones: Mapping[str, Zone]) -> bool:
    """False if a predicate holds for no row of a row group.

    Args:
        node: The predicate.
        zones: The arrays with zones, by the path of their field.
    """
    if isinstance(node, And | Or):
        together = all if isinstance(node, And) else any
        return together(may_hold(item, zones) for item in node.items)
    return not isinstance(node, Compare) or _may_compare(node, zones)


def _may_compare(node: Compare, zones: Mapping[str, Zone]) -> bool:
    value = node.value
    zone, rest = _zone_of(node.field.parts, zones)
    if zone is None or isinstance(value, bool) or not isinstance(value, int | float):
        return True
    if rest == () or (len(rest) == 1 and rest[0] in _SUMMARIES):
        return zone.may_hold(node.order, value, None)
    element = rest[0] if len(rest) == 1 else None
    if isinstance(element, int) and element >= 0:
        return zone.may_hold(node.order, value, element)
    return True


def _zone_of(
    parts: tuple[str | int, ...], zones: Mapping[str, Zone]
) -> tuple[Zone | None, tuple[str | int, ...]]:
    """The zone of the array that a path leads to, and the rest of the path."""
    for count in range(len(parts), 0, -1):
        names = parts[:count]
        if all(isinstance(name, str) for name in names):
            zone = zones.get(".".join(map(str, names)))
            if zone is not None:
                return zone, parts[count:]
    return None, ()


def _or_none(value: float) -> float | None:
    return None if value != value else value  # noqa: PLR0124 - NaN


def _spelled(value: float | None) -> float | str | None:
    return str(value) if value in {float("inf"), float("-inf")} else value


def _read(value: object) -> float | None:
    if value is None or isinstance(value, int | float):
        return value
    if value in {"inf", "-inf"}:
        return float(str(value))
    raise ValueError("a zone has something else than numbers")
