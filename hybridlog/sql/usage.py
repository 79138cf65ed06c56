"""Finds the parts of columns that a query names.

DuckDB asks for whole columns, also where a query names one field of a struct. Its syntax tree
tells the paths that are named. Wherever a struct may be used as a whole (`*`, a bare name, a
row as a value), all of it is read.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from operator import eq
from typing import Any, Final

Path = tuple[str, ...]
"""Names on the way to a field, folded."""

_SOURCES: Final = frozenset(
    {"BASE_TABLE", "JOIN", "SUBQUERY", "EMPTY", "EXPRESSION_LIST", "TABLE_FUNCTION"}
)
_FUNCTIONS: Final = frozenset({"range", "generate_series", "unnest"})
"""Table functions that read no views."""


@dataclass(frozen=True, slots=True)
class Usage:
    """Paths named in a query, from wherever each begins: view, column or field."""

    chains: frozenset[Path] | None = None
    """None if anything may be used."""

    def uses(self, path: Path) -> bool:
        """True if the query may use a field: its column, and fields in it, folded."""
        if self.chains is None:
            return True
        named = (chain[start:] for chain in self.chains for start in range(len(chain)))
        # As far as both go, so above it and below it, too.
        return any(all(map(eq, rest, path)) for rest in named)


EVERYTHING: Final = Usage()


def usage_of(tree: str, views: Collection[str]) -> Usage:
    """The paths that a query names.

    `tree` is the query as `json_serialize_sql` gives it, `views` are folded names of views whose
    columns are known.
    """
    found = json.loads(tree)
    if found.get("error", True):
        return EVERYTHING
    nodes = list(_nodes(found["statements"]))
    rows = [n for n in nodes if "class" not in n and n.get("type") in _SOURCES]
    names = {_fold(n.get(key)) for n in rows for key in ("alias", "table_name")}
    maps = [n["cte_map"] for n in nodes if "cte_map" in n]
    common = {_fold(entry.get("key")) for one in maps for entry in one.get("map", ())}
    tables = {_fold(n["table_name"]) for n in nodes if n.get("type") == "BASE_TABLE"}
    if not tables <= common | set(views) or any(map(_is_open, nodes)):
        return EVERYTHING
    chains = {tuple(map(_fold, node["column_names"])) for node in nodes if node.get("column_names")}
    # A row as a value: `select s from scan s`.
    if any(chain[-1] in names | common for chain in chains):
        return EVERYTHING
    chains |= {(_fold(name),) for node in nodes for name in node.get("using_columns", ())}
    return Usage(frozenset(chains))


def _is_open(node: dict[str, Any]) -> bool:
    """True if a part of a query may use columns that it does not name."""
    if node.get("class") in {"STAR", "POSITIONAL_REFERENCE"} or node.get("column_name_alias"):
        return True
    if node.get("ref_type") == "NATURAL":
        return True
    sources = [node[key] for key in ("from_table",) if key in node]
    if node.get("type") == "JOIN":
        sources += [node["left"], node["right"]]
    if any(source["type"] not in _SOURCES for source in sources):
        return True
    function = node.get("function") if node.get("type") == "TABLE_FUNCTION" else None
    return function is not None and function.get("function_name") not in _FUNCTIONS


def _nodes(value: Any) -> Iterator[dict[str, Any]]:
    pending = [value]
    while pending:
        value = pending.pop()
        if isinstance(value, dict):
            yield value
            pending.extend(value.values())
        elif isinstance(value, list):
            pending.extend(value)


def _fold(name: object) -> str:
    return name.casefold() if isinstance(name, str) else ""
