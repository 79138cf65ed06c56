"""The parts of a predicate that only index documents can answer, as MongoDB filters.

These are pieces of MongoDB filters that the language does not have, and conditions on what
only documents hold, such as `_meta.error`. Everything else is decided on columns and messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

from hybridlog.query.predicate.numbers import HIGH, LOW, is_number
from hybridlog.query.predicate.regex import is_literal
from hybridlog.query.predicate.tree import (
    And,
    Compare,
    Exists,
    Match,
    Member,
    Node,
    Not,
    Opaque,
    Or,
    Value,
    is_meta,
    needs_index,
    nodes,
)
from hybridlog_storage.errors import WhereError

Filter: TypeAlias = dict[str, object]

_OPERATORS = {"==": "$eq", "!=": "$ne", "<": "$lt", "<=": "$lte", ">": "$gt", ">=": "$gte"}


def replaced(node: Node, answer: Callable[[Node], Node]) -> Node:
    """The tree with another node for each of its largest parts that only documents answer."""
    if not needs_index(node):
        return node
    if _is_of_documents(node):
        return answer(node)
    match node:
        case And(items):
            return And(_replaced_among(items, And, answer))
        case Or(items):
            return Or(_replaced_among(items, Or, answer))
        case Not(item):
            return Not(replaced(item, answer))
    raise AssertionError(node)


def _replaced_among(
    items: Sequence[Node],
    join: Callable[[tuple[Node, ...]], Node],
    answer: Callable[[Node], Node],
) -> tuple[Node, ...]:
    own = tuple(item for item in items if needs_index(item) and _is_of_documents(item))
    rest = (replaced(item, answer) for item in items if item not in own)
    if len(own) > 1:
        own = (join(own),)
    return *map(answer, own), *rest


def _is_of_documents(node: Node) -> bool:
    """True if documents answer a whole tree: it is about nothing that columns know better."""
    return all(
        isinstance(each, And | Or | Not | Opaque)
        or (is_meta(each.field.path) and not each.field.is_sliced)
        for each in nodes(node)
    )


def to_mongo(node: Node) -> Filter:
    """A tree about documents as a MongoDB filter.

    Raises:
        WhereError: a pattern that MongoDB may understand in another way.
    """
    match node:
        case And(items):
            return {"$and": [to_mongo(item) for item in items]}
        case Or(items):
            return {"$or": [to_mongo(item) for item in items]}
        case Not(item):
            return {"$nor": [to_mongo(item)]}
        case Opaque():
            return node.to_filter()
        case _:
            return {node.field.path: _test_of(node)}


def _test_of(node: Compare | Member | Match | Exists) -> Filter:
    """The operators for a field that has one value, or none."""
    match node:
        case Exists():
            return {"$exists": node.present}
        case Compare(value=None):
            return {"$type": "null"} if node.order == "==" else {"$exists": True}
        case Compare():
            return {"$exists": True, _OPERATORS[node.order]: _limited(node.value)}
        case Member():
            known = [_limited(value) for value in node.values if value is not None]
            return {"$exists": True, "$nin" if node.negated else "$in": known}
        case Match():
            if not is_literal(node.pattern):
                raise WhereError(
                    f"Only MongoDB has {node.field.path}, and searches it for plain text only: "
                    f"{node.pattern!r} is a pattern."
                )
            found: Filter = {"$regex": node.pattern}
            return {"$exists": True, **({"$not": found} if node.negated else found)}


def _limited(value: Value) -> Value:
    """The value, or an infinity for an int beyond int64."""
    if is_number(value) and isinstance(value, int) and not LOW <= value <= HIGH:
        return math.inf if value > 0 else -math.inf
    return value
