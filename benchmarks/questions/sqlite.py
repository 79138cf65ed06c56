"""Questions to SQLite through json_extract."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import orjson

from benchmarks.backends.sqlite import expression, table_of
from benchmarks.questions.sql import Sql, SqlAsker, SqlReading

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend


class _Connected(Sql):
    """The backend's own connection."""

    column = "msg"
    connection: sqlite3.Connection

    def start(self, backend: Backend) -> None:
        from benchmarks.backends.sqlite import Sqlite

        assert isinstance(backend, Sqlite)
        self.connection = backend.connection

    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self.connection.execute(query, values).fetchall()

    def field(self, path: str, table: str = "") -> str:
        return expression(path, f"{table}.msg" if table else "msg")

    def name(self, topic: str) -> str:
        return table_of(topic)

    def loaded(self, value: Any) -> dict[str, Any]:
        """A row's message."""
        found: dict[str, Any] = orjson.loads(value)
        return found


class SqliteAsker(_Connected, SqlAsker):
    """With SQLite's own functions, in the words that the indexes are on."""

    # Keeps the planner off the index on x, which half of all rows are in.
    front = "+"


class SqliteReading(_Connected, SqlReading):
    """By `_meta.t`, on which there is an index."""

    ranges = "msg"
