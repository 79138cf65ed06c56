"""Zones: the least and the greatest number of each region of an array, by row group.

They tell in which row groups a predicate on elements of an array cannot hold, so these are
not read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.query.predicate.numbers import is_nan, is_number
from hybridlog.query.predicate.tree import And, Compare, Member, Or, Slice
from hybridlog.schema.column import ranges

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.predicate.tree import Node, Parts

MAX_REGIONS: Final = 32
"""Most regions of an array."""
_MIN_WIDTH = 16
_ROUNDED = 1e-6  # most relative error of a mean
_MAY: Final[Mapping[str, Callable[[float, float, float], bool]]] = {
    "<": lambda low, _, wanted: low < wanted,
    "<=": lambda low, _, wanted: low <= wanted,
    ">": lambda _, high, wanted: high > wanted,
    ">=": lambda _, high, wanted: high >= wanted,
    "==": lambda low, high, wanted: low <= wanted <= high,
}
"""Whether a number between two ends may satisfy a comparison."""
ALL: Final = Slice(0, None)
"""All elements."""


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

    def may_hold(self, order: str, wanted: float, elements: Slice = ALL) -> bool:
        """False if no element can satisfy a comparison.

        Args:
            order: The comparison: `<`, `<=`, `>`, `>=` or `==`.
            wanted: The number to compare with, not NaN.
            elements: The elements.
        """
        return any(_MAY[order](low, high, wanted) for low, high in self._ends(elements))

    def mean_may_hold(self, order: str, wanted: float, elements: Slice = ALL) -> bool:
        """False if no mean of elements can satisfy a comparison, as for `may_hold`."""
        ends = self._ends(elements)
        if not ends:
            return False
        low, high = min(low for low, _ in ends), max(high for _, high in ends)
        slack = _ROUNDED * max(abs(low), abs(high))  # a sum of floats is rounded
        return _MAY[order](low - slack, high + slack, wanted)

    def _ends(self, elements: Slice) -> list[tuple[float, float]]:
        """Least and greatest number of each region of some elements."""
        last = None if elements.end is None else -(-elements.end // self.width)
        regions = slice(elements.begin // self.width, last)
        pairs = zip(self.low[regions], self.high[regions], strict=True)
        return [(low, high) for low, high in pairs if low is not None and high is not None]


def may_hold(node: Node, zones: Mapping[str, Zone]) -> bool:
    """False if a predicate holds for no row of a row group.

    Args:
        node: The predicate.
        zones: The arrays with zones, by the path of their field.
    """
    if isinstance(node, And | Or):
        combine = all if isinstance(node, And) else any
        return combine(may_hold(item, zones) for item in node.items)
    if isinstance(node, Member) and not node.negated:
        return any(_may_compare(Compare(node.field, "==", value), zones) for value in node.values)
    return not isinstance(node, Compare) or _may_compare(node, zones)


def _may_compare(node: Compare, zones: Mapping[str, Zone]) -> bool:
    zone, rest = _zone_of(node.field.parts, zones)
    if zone is None or not is_number(node.value) or is_nan(node.value) or node.order not in _MAY:
        return True
    elements = ALL
    if rest and isinstance(rest[0], int):
        elements, rest = Slice(rest[0], rest[0] + 1), rest[1:]
    elif rest and isinstance(rest[0], Slice):
        elements, rest = rest[0], rest[1:]
    if rest in {(), ("min",), ("max",)}:
        return zone.may_hold(node.order, node.value, elements)
    if rest == ("mean",):
        return zone.mean_may_hold(node.order, node.value, elements)
    return True


def _zone_of(parts: Parts, zones: Mapping[str, Zone]) -> tuple[Zone | None, Parts]:
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
