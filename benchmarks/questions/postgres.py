"""Questions to PostgreSQL: the paper's appendix B, and as an index on casts wants them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.backends.postgres import expression, table_of
from benchmarks.questions import sql
from benchmarks.questions.base import (
    ARM,
    ERROR,
    GRIPPER,
    ROSOUT,
    VIEWPOINT,
    Asker,
    Reading,
    checked,
    whole_minutes,
    windows_before,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from numpy.typing import NDArray

    from benchmarks.backends.base import Backend

_T = expression("_meta.t")


def _quoted(topic: str) -> str:
    return '"' + table_of(topic).replace('"', '""') + '"'


class _Connected:
    """A connection in autocommit mode."""

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
        """What a query answers."""
        return self._connection.execute(query.encode(), list(values)).fetchall()

    def number(self, query: str, values: Sequence[object] = ()) -> int:
        """The one number that a query answers."""
        return int(self.rows(query, values)[0][0])


class PostgresAsker(_Connected, Asker):
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

    def positions(self) -> list[float]:
        return sql.sums(self.rows(sql.positions(_quoted(VIEWPOINT), expression)))

    def changes(self) -> int:
        pose = "(data->>'position') || (data->>'orientation')"
        return self.number(sql.changes(_quoted(VIEWPOINT), _T, pose))

    def closed_minutes(self) -> list[int]:
        closed = f"({expression('position')} = 0)"
        found = self.rows(sql.closed(_quoted(GRIPPER), _T, closed))
        return checked(whole_minutes((begin, end) for begin, end in found))

    def before_errors(self) -> int:
        level = expression("level")
        query = f"SELECT {_T} FROM {_quoted(ROSOUT)} WHERE {level} = {ERROR}"
        windows = windows_before(row[0] for row in self.rows(query))
        return sum(
            self.number(
                f"SELECT COUNT(*) FROM {_quoted(topic)} WHERE {_T} >= %s AND {_T} < %s",
                [begin, end],
            )
            for topic in self.topics
            for begin, end in windows
        )

    def index_bytes(self) -> int | None:
        """All indexes, with those of the primary keys."""
        query = "SELECT pg_indexes_size(%s::regclass)"
        return sum(self.number(query, [_quoted(topic)]) for topic in self.topics)


class PostgresIndexedAsker(PostgresAsker):
    """The same with the casts that the expression indexes are on."""

    def closings(self) -> int:
        return self.number(sql.closings(_quoted(GRIPPER), expression))

    def behind(self) -> int:
        return self.number(sql.behind(_quoted(VIEWPOINT), expression))

    def in_region(self) -> int:
        return self.number(sql.in_region(_quoted(ARM), expression))

    def grasps(self, half_ns: int) -> int:
        mine, theirs = expression("_meta.t", "a.data"), expression("_meta.t", "b.data")
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(GRIPPER)} a "
            f"WHERE {expression('position', 'a.data')} = 0 AND EXISTS ("
            f"SELECT 1 FROM {_quoted(VIEWPOINT)} b "
            f"WHERE {theirs} > {mine} - %s AND {theirs} < {mine} + %s "
            f"AND {expression('position.x', 'b.data')} >= 0)",
            [half_ns, half_ns],
        )


class PostgresReading(_Connected, Reading):
    """By `_meta.t`, on which the indexed backend has an index."""

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        rows = self.rows(
            f"SELECT data->'ranges' FROM {_quoted(topic)} "
            f"WHERE {_T} >= %s AND {_T} < %s ORDER BY {_T}",
            [begin, end],
        )
        return np.array([row[0] for row in rows], np.float32)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        rows = self.rows(
            f"SELECT data->'ranges' FROM {_quoted(topic)} "
            f"WHERE {_T} <= %s ORDER BY {_T} DESC LIMIT 1",
            [time],
        )
        return np.array(rows[0][0], np.float32)

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        rows = self.rows(f"SELECT data FROM {_quoted(topic)} ORDER BY {_T}")
        return pd.json_normalize([row[0] for row in rows])
