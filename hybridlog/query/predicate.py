"""What a question asks of fields, as MongoDB understands it and as columns do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hybridlog.query.column_filter import ColumnFilter, column_filter

_MOST_KINDS = 64  # sets of types for which it is remembered what a predicate is on columns


class Predicate:
    """A predicate that was checked. It does not change, so that questions can share it.

    Args:
        query: It as a MongoDB filter; nobody else may hold it.

    Attributes:
        query: The same, to be read only; `to_filter` gives one to be changed.
    """

    def __init__(self, query: Mapping[str, object]) -> None:
        self.query = query
        self._of_types: dict[int, tuple[Mapping[str, str], ColumnFilter | None]] = {}

    def __eq__(self, other: object) -> bool:
        """Whether they are the same filter."""
        return isinstance(other, Predicate) and self.query == other.query

    __hash__ = None  # type: ignore[assignment]

    def __bool__(self) -> bool:
        """Whether it asks for anything."""
        return bool(self.query)

    def __repr__(self) -> str:
        return f"<Predicate {self.query}>"

    def to_filter(self) -> dict[str, object]:
        """It as a MongoDB filter, which whoever gets it may change."""
        own: dict[str, object] = _copied(self.query)
        return own

    def on_columns(self, types: Mapping[str, str]) -> ColumnFilter | None:
        """It as a filter of columns; None if only MongoDB can answer.

        Args:
            types: Type of each path that has one value in every message. The same object
                is not looked at again.
        """
        known = self._of_types.get(id(types))
        if known is None:
            if len(self._of_types) >= _MOST_KINDS:
                self._of_types.clear()
            # With the types, or others might come to lie where they were.
            known = self._of_types[id(types)] = types, column_filter(self.query, types)
        return known[1]


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _copied(inner) for name, inner in value.items()}
    return [_copied(inner) for inner in value] if isinstance(value, list) else value
