"""Questions to PostgreSQL, as an index on casts wants them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from benchmarks.backends.postgres import expression, table_of
from benchmarks.questions.sql import Sql, SqlAsker, SqlReading

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend


class _Connected(Sql):
    """A connection in autocommit mode."""

    mark = "%s"
    column = "data"

    def start(self, backend: Backend) -> None:
        import orjson
        from psycopg.types.json import set_json_loads

        from benchmarks.backends.postgres import Postgres

        assert isinstance(backend, Postgres)
        self._connection = backend.connect()
        # The standard library's takes several times as long.
        set_json_loads(orjson.loads, self._connection)
        # As a loaded database has it after a minute, and a query's plan needs it.
        self._connection.execute("ANALYZE")

    def close(self) -> None:
        self._connection.close()

    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self._connection.execute(query.encode(), list(values)).fetchall()

    def field(self, path: str, table: str = "") -> str:
        return expression(path, f"{table}.data" if table else "data")

    def name(self, topic: str) -> str:
        return table_of(topic)


class PostgresAsker(_Connected, SqlAsker):
    """With the casts that the expression indexes are on."""


class PostgresReading(_Connected, SqlReading):
    """Only the field that is asked for is read of a scan."""

    ranges = "data->'ranges'"

    def loaded(self, value: Any) -> dict[str, Any]:
        found: dict[str, Any] = value
        return found

    def loaded_ranges(self, value: Any) -> Any:
        return value
