"""Predicates as the index alone answers them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hybridlog.query.predicate.to_mongo import to_mongo
from hybridlog.query.predicate.tree import (
    And,
    Exists,
    Match,
    Node,
    Not,
    Opaque,
    Or,
    Predicate,
    frozen,
)


class IndexFilter:
    """A predicate as a MongoDB filter. It does not change, so that questions can share it.

    Args:
        predicate: What is asked.
        types: Types of the fields; None when each message decides.

    Attributes:
        query: The filter, to be read only; `to_filter` gives one to be changed.
        is_exact: Whether the index can tell.
    """

    def __init__(self, predicate: Predicate, types: Mapping[str, str] | None = None) -> None:
        found = to_mongo(_with_patterns(predicate.root), types)
        self.query = found.filter
        self.is_exact = found.is_exact
        self._predicate = predicate

    def __bool__(self) -> bool:
        """Whether it asks for anything."""
        return bool(self._predicate)

    def __repr__(self) -> str:
        return repr(self._predicate)

    def to_filter(self) -> dict[str, object]:
        """The filter as a copy that may be changed."""
        own: dict[str, object] = _copied(self.query)
        return own


def _with_patterns(node: Node) -> Node:
    """The tree with patterns that MongoDB matches."""
    match node:
        case Match(asked, pattern, negated):
            found = Opaque(frozen({asked.path: {"$regex": pattern}}))
            return And((Exists(asked, present=True), Not(found))) if negated else found
        case And(items):
            return And(tuple(map(_with_patterns, items)))
        case Or(items):
            return Or(tuple(map(_with_patterns, items)))
        case Not(item):
            return Not(_with_patterns(item))
        case _:
            return node


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _copied(inner) for name, inner in value.items()}
    return [_copied(inner) for inner in value] if isinstance(value, list) else value
