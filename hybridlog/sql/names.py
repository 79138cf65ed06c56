"""Names in SQL: of views, one a topic, and short ones that are unambiguous; usage.

DuckDB asks for whole columns, also where a query names one field of a struct. Its syntax tree
tells the paths that are named. Wherever a struct may be used as a whole (`*`, a bare name, a
row as a value), all of it is read.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from operator import eq
from typing import Any, Final

from msgspec import Struct

from hybridlog.columns.layout import column_names
from hybridlog_storage.mongo.index_documents import collection_of

TABLES: Final = ("recordings", "topics", "losses", "marks")
"""Tables about the store itself; their names are reserved."""
_WORD: Final = re.compile(r'"((?:[^"]|"")*)"|([^\W\d][\w$]*)')
_PLAIN: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_LISTING: Final = frozenset({
    "database", "duckdb_columns", "duckdb_tables", "duckdb_views", "information_schema",
    "pg_catalog", "pragma_show", "pragma_table_info", "show",
})  # fmt: skip
"""Words of statements that list views."""
Path = tuple[str, ...]
"""Names on the way to a field, folded."""

_SOURCES: Final = frozenset(
    {"BASE_TABLE", "JOIN", "SUBQUERY", "EMPTY", "EXPRESSION_LIST", "TABLE_FUNCTION"}
)
_FUNCTIONS: Final = frozenset({"range", "generate_series", "unnest"})
"""Table functions that read no views."""


class ViewNames:
    """The names of the views of some topics, `views` by topic. DuckDB ignores case, so do these."""

    def __init__(self, topics: Iterable[str]) -> None:
        # Of names that differ in case, the one in lower case stays as it is.
        known = sorted(topics, key=lambda topic: (topic.casefold(), topic.swapcase()))
        collections = dict(zip(map(collection_of, known), known, strict=True))
        named = column_names(collections, TABLES)
        self.views = {collections[collection]: view for collection, view in named}
        self._topics = {view.casefold(): topic for topic, view in self.views.items()}
        self._shorts: dict[str, list[str]] = {}
        found = {topic: list(_short_names(topic)) for topic in known}
        owners = Counter(name.casefold() for names in found.values() for name in names)
        for topic, names in found.items():
            for name in names:
                folded = name.casefold()
                if owners[folded] == 1 and folded not in self._topics and folded not in TABLES:
                    self._shorts.setdefault(topic, []).append(name)
        self._topics |= {
            name.casefold(): topic for topic, names in self._shorts.items() for name in names
        }

    def __iter__(self) -> Iterator[str]:
        """All names: tables, views, short names."""
        yield from TABLES
        for topic, view in self.views.items():
            yield view
            yield from self._shorts.get(topic, ())

    def topic(self, name: str) -> str | None:
        """The topic of a view; None if there is none of that name."""
        return self._topics.get(name.casefold())

    def short(self, topic: str) -> str | None:
        """The shortest name of a topic's view; None if only the long one is unambiguous."""
        return min(self._shorts.get(topic, ()), key=len, default=None)

    def named(self, query: str) -> list[str]:
        """Names in the text of a query, in any role; all for statements that list views."""
        found: list[tuple[str, str]] = _WORD.findall(query)
        words = {(quoted.replace('""', '"') or plain).casefold() for quoted, plain in found}
        if not words.isdisjoint(_LISTING):
            return list(self)
        return [name for name in self if name.casefold() in words]


def _short_names(topic: str) -> Iterator[str]:
    """Whole parts at the end of a name: `scan` and `base__scan` of `/robot/base/scan`."""
    parts = topic.strip("/").split("/")
    for start in range(1, len(parts)):
        name = "__".join(parts[start:])
        if _PLAIN.fullmatch(name):
            yield name


class Usage(Struct, frozen=True):
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
