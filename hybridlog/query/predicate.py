"""What a question asks of fields, as MongoDB understands it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class Predicate:
    """A predicate that was checked. It does not change, so that questions can share it.

    Args:
        query: It as a MongoDB filter; nobody else may hold it.

    Attributes:
        query: The same, to be read only; `to_filter` gives one to be changed.
    """

    def __init__(self, query: Mapping[str, object]) -> None:
        self.query = query

    def __bool__(self) -> bool:
        """Whether it asks for anything."""
        return bool(self.query)

    def __repr__(self) -> str:
        return f"<Predicate {self.query}>"

    def to_filter(self) -> dict[str, object]:
        """It as a MongoDB filter, which whoever gets it may change."""
        own: dict[str, object] = _copied(self.query)
        return own


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _copied(inner) for name, inner in value.items()}
    return [_copied(inner) for inner in value] if isinstance(value, list) else value
