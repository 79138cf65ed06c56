"""Completion of SQL: views, columns, fields and words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from hybridlog.sql.names import PLAIN, written

if TYPE_CHECKING:
    from hybridlog.sql.engine import SqlConnection

DELIMITERS: Final = " \t\n,;()[]<>=!+-*/'"
"""Characters between words."""
_WORDS: Final = (
    "as", "asof", "avg", "between", "by", "count", "describe", "distinct", "from", "group",
    "having", "in", "is", "join", "like", "limit", "max", "min", "not", "null", "on", "or",
    "order", "select", "show", "sum", "tables", "union", "using", "where", "with",
)  # fmt: skip


def word_before(text: str) -> str:
    """The word at the end of a text."""
    return text[max(text.rfind(mark) for mark in DELIMITERS) + 1 :]


def candidates(connection: SqlConnection, line: str, text: str) -> list[str]:
    """Views, columns, fields and words that begin with a text, such as `pose.po`, sorted.

    Columns are those of the views in the line, the statement so far.
    """
    names = connection.names()
    words = {word.casefold() for word in PLAIN.findall(line)}
    views = [name for name in names if name.casefold() in words and name != text]
    columns: dict[str, None] = {}
    for view in views:
        schema = connection.schema(view)
        above, _, _ = text.rpartition(".")
        columns.update(dict.fromkeys(_below(schema, above)))
        if above:
            alias, _, rest = above.partition(".")
            found = _below(schema, rest) if alias not in schema.names else []
            columns.update(dict.fromkeys(f"{alias}.{path}" for path in found))
    known = [*columns] if "." in text else [*map(written, names), *columns, *_WORDS]
    return sorted({name for name in known if name.casefold().startswith(text.casefold())})


def _below(schema: Any, path: str) -> list[str]:
    """Paths of the fields below a path; of the columns below an empty one."""
    fields = list(schema)
    for name in path.split(".") if path else ():
        found = [f for f in fields if f.name.casefold() == name.casefold()]
        if not found or not hasattr(found[0].type, "get_field_index"):
            return []
        fields = list(found[0].type)
    return [f"{path}.{field.name}" if path else field.name for field in fields]
