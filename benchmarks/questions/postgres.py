"""Questions to PostgreSQL: the paper's appendix B, and as an index on casts wants them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from benchmarks.backends.postgres import expression, table_of
from benchmarks.questions.base import ARM, GRIPPER, VIEWPOINT
from benchmarks.questions.sql import Sql, SqlAsker, SqlReading

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend


def _quoted(topic: str) -> str:
    return '"' + table_of(topic).replace('"', '""') + '"'


class _Connected(Sql):
    """A connection in autocommit mode."""

    mark = "%s"
    column = "data"

    def start(self, backend: Backend) -> None:
        import orjson
        from psycopg.types.json import set_json_loads

        from benchmarks.backends.postgres import PostgresAutocommit

        assert isinstance(backend, PostgresAutocommit)
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
        return _quoted(topic)


class PostgresIndexedAsker(_Connected, SqlAsker):
    """With the casts that the expression indexes are on."""

    def pose(self) -> str:
        return "(data->>'position') || (data->>'orientation')"

    def index_bytes(self) -> int | None:
        """All indexes, with those of the primary keys."""
        query = "SELECT pg_indexes_size(%s::regclass)"
        return sum(self.number(query, [_quoted(topic)]) for topic in self.topics)


class PostgresAsker(PostgresIndexedAsker):
    """Q1 to Q4 as in the appendix; only what its scan has broken is mended."""

    def closings(self) -> int:
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(GRIPPER)} WHERE (data->>'position')::REAL = 0"
        )

    def behind(self) -> int:
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(VIEWPOINT)} WHERE (data->'position'->>'x')::REAL <= 0"
        )

    def in_region(self) -> int:
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(ARM)} "
            "WHERE (data->'pose'->'position'->>'z')::REAL > 1 "
            "AND (data->'pose'->'position'->>'y')::REAL > -0.5 "
            "AND (data->'pose'->'position'->>'y')::REAL < 0.5 "
            "AND (data->'pose'->'position'->>'x')::REAL > 0.5 "
            "AND (data->'pose'->'position'->>'x')::REAL < 1"
        )

    def grasps(self, half_ns: int) -> int:
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(GRIPPER)} a "
            "WHERE (a.data->>'position')::REAL = 0 AND EXISTS ("
            f"SELECT 1 FROM {_quoted(VIEWPOINT)} b WHERE ABS(EXTRACT(EPOCH FROM "
            "CAST(a.data->'_meta'->>'inserted_at' AS TIMESTAMP WITH TIME ZONE) - "
            "CAST(b.data->'_meta'->>'inserted_at' AS TIMESTAMP WITH TIME ZONE))) < %s "
            "AND (b.data->'position'->>'x')::REAL >= 0)",
            [half_ns / 1e9],
        )


class PostgresReading(_Connected, SqlReading):
    """Only the field that is asked for is read of a scan."""

    ranges = "data->'ranges'"

    def loaded(self, value: Any) -> dict[str, Any]:
        found: dict[str, Any] = value
        return found

    def loaded_ranges(self, value: Any) -> Any:
        return value
