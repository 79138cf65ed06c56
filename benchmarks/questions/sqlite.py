"""Questions to SQLite: Python functions as in the paper's appendix C, and json_extract."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from datetime import datetime
from operator import eq, ge, gt, le, lt
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from benchmarks.backends.sqlite import expression, quoted, table_of
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
    import pandas as pd
    from numpy.typing import NDArray

    from benchmarks.backends.base import Backend

_ORDERS: dict[str, Callable[[Any, Any], bool]] = {"eq": eq, "le": le, "ge": ge, "gt": gt, "lt": lt}
_T = expression("_meta.t")
_TIME = "json_get_val(msg, '_meta.t')"


def _quoted(topic: str) -> str:
    return quoted(table_of(topic))


class _Connected:
    """The backend's own connection."""

    connection: sqlite3.Connection

    def start(self, backend: Backend) -> None:
        from benchmarks.backends.sqlite import SqliteUdf

        assert isinstance(backend, SqliteUdf)
        self.connection = backend.connection

    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """What a query answers."""
        return self.connection.execute(query, values).fetchall()

    def number(self, query: str, values: Sequence[object] = ()) -> int:
        """The one number that a query answers."""
        return int(self.rows(query, values)[0][0])


class _WithFunctions(_Connected):
    """With the functions of the appendix, which read a field of a message in Python."""

    def start(self, backend: Backend) -> None:
        super().start(backend)
        for name, order in _ORDERS.items():
            self.connection.create_function(f"json_{name}_field", 3, _comparison(order))
        self.connection.create_function("json_get_time_diff", 4, _time_diff)
        self.connection.create_function("json_get_val", 2, _scalar)


class SqliteUdfAsker(_WithFunctions, Asker):
    """Q1 to Q4 as in the appendix; every question reads a whole table."""

    def closings(self) -> int:
        query = f"SELECT COUNT(*) FROM {_quoted(GRIPPER)} WHERE json_eq_field(msg, ?, ?)"
        return self.number(query, ["position", 0])

    def behind(self) -> int:
        query = f"SELECT COUNT(*) FROM {_quoted(VIEWPOINT)} WHERE json_le_field(msg, ?, ?)"
        return self.number(query, ["position.x", 0])

    def in_region(self) -> int:
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(ARM)} WHERE json_gt_field(msg, ?, ?) "
            "AND json_gt_field(msg, ?, ?) AND json_lt_field(msg, ?, ?) "
            "AND json_gt_field(msg, ?, ?) AND json_lt_field(msg, ?, ?)",
            [
                *("pose.position.z", 1),
                *("pose.position.y", -0.5),
                *("pose.position.y", 0.5),
                *("pose.position.x", 0.5),
                *("pose.position.x", 1),
            ],
        )

    def grasps(self, half_ns: int) -> int:
        time = "_meta.inserted_at"
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(GRIPPER)} a WHERE json_eq_field(a.msg, ?, ?) "
            f"AND EXISTS (SELECT 1 FROM {_quoted(VIEWPOINT)} b "
            "WHERE json_get_time_diff(a.msg, ?, b.msg, ?) < ? "
            "AND json_ge_field(b.msg, ?, ?))",
            ["position", 0.0, time, time, half_ns / 1e6, "position.x", 0],
        )

    def positions(self) -> list[float]:
        columns = ", ".join(f"json_get_val(msg, 'position.{axis}')" for axis in "xyz")
        query = f"SELECT {columns} FROM {_quoted(VIEWPOINT)} WHERE json_le_field(msg, ?, ?)"
        return sql.sums(self.rows(query, ["position.x", 0]))

    def changes(self) -> int:
        pose = "json_get_val(msg, 'position') || json_get_val(msg, 'orientation')"
        return self.number(sql.changes(_quoted(VIEWPOINT), _TIME, pose))

    def closed_minutes(self) -> list[int]:
        is_closed = "json_eq_field(msg, 'position', 0)"
        found = self.rows(sql.closed(_quoted(GRIPPER), _TIME, is_closed))
        return checked(whole_minutes((begin, end) for begin, end in found))

    def before_errors(self) -> int:
        query = f"SELECT {_TIME} FROM {_quoted(ROSOUT)} WHERE json_eq_field(msg, ?, ?)"
        windows = windows_before(row[0] for row in self.rows(query, ["level", ERROR]))
        within = "json_ge_field(msg, ?, ?) AND json_lt_field(msg, ?, ?)"
        any_window = " OR ".join([f"({within})"] * len(windows)) or "0"
        values = [v for begin, end in windows for v in ("_meta.t", begin, "_meta.t", end)]
        return sum(
            self.number(f"SELECT COUNT(*) FROM {_quoted(topic)} WHERE {any_window}", values)
            for topic in self.topics
        )


class SqliteJsonAsker(_Connected, Asker):
    """With SQLite's own functions, in the words that the indexes are on."""

    def index_bytes(self) -> int | None:
        """All indexes, where this SQLite was built to tell."""
        try:
            return self.number(
                "SELECT coalesce(sum(pgsize), 0) FROM dbstat "
                "WHERE name IN (SELECT name FROM sqlite_master WHERE type = 'index')"
            )
        except sqlite3.OperationalError:  # the table dbstat is an option of the build
            return None

    def closings(self) -> int:
        return self.number(sql.closings(_quoted(GRIPPER), expression))

    def behind(self) -> int:
        return self.number(sql.behind(_quoted(VIEWPOINT), expression))

    def in_region(self) -> int:
        return self.number(sql.in_region(_quoted(ARM), expression))

    def grasps(self, half_ns: int) -> int:
        mine, theirs = expression("_meta.t", "a.msg"), expression("_meta.t", "b.msg")
        # A plus sign keeps the planner off the index on x, which half of all rows are in.
        return self.number(
            f"SELECT COUNT(*) FROM {_quoted(GRIPPER)} a "
            f"WHERE {expression('position', 'a.msg')} = 0 AND EXISTS ("
            f"SELECT 1 FROM {_quoted(VIEWPOINT)} b "
            f"WHERE {theirs} > {mine} - ? AND {theirs} < {mine} + ? "
            f"AND +{expression('position.x', 'b.msg')} >= 0)",
            [half_ns, half_ns],
        )

    def positions(self) -> list[float]:
        return sql.sums(self.rows(sql.positions(_quoted(VIEWPOINT), expression)))

    def changes(self) -> int:
        pose = f"{expression('position')} || {expression('orientation')}"
        return self.number(sql.changes(_quoted(VIEWPOINT), _T, pose))

    def closed_minutes(self) -> list[int]:
        found = self.rows(sql.closed(_quoted(GRIPPER), _T, f"{expression('position')} = 0"))
        return checked(whole_minutes((begin, end) for begin, end in found))

    def before_errors(self) -> int:
        query = f"SELECT {_T} FROM {_quoted(ROSOUT)} WHERE {expression('level')} = {ERROR}"
        windows = windows_before(row[0] for row in self.rows(query))
        return sum(
            self.number(
                f"SELECT COUNT(*) FROM {_quoted(topic)} WHERE {_T} >= ? AND {_T} < ?",
                [begin, end],
            )
            for topic in self.topics
            for begin, end in windows
        )


class SqliteUdfReading(_WithFunctions, Reading):
    """Through Python functions: every slice reads the whole table."""

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        rows = self.rows(
            f"SELECT msg FROM {_quoted(topic)} WHERE json_ge_field(msg, ?, ?) "
            f"AND json_lt_field(msg, ?, ?) ORDER BY {_TIME}",
            ["_meta.t", begin, "_meta.t", end],
        )
        return _ranges(rows)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        rows = self.rows(
            f"SELECT msg FROM {_quoted(topic)} WHERE json_le_field(msg, ?, ?) "
            f"ORDER BY {_TIME} DESC LIMIT 1",
            ["_meta.t", time],
        )
        found: NDArray[np.float32] = _ranges(rows)[0]
        return found

    def table(self, topic: str) -> pd.DataFrame:
        return _table(self.rows(f"SELECT msg FROM {_quoted(topic)} ORDER BY {_TIME}"))


class SqliteJsonReading(_Connected, Reading):
    """By `_meta.t`, on which there is an index."""

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        rows = self.rows(
            f"SELECT msg FROM {_quoted(topic)} WHERE {_T} >= ? AND {_T} < ? ORDER BY {_T}",
            [begin, end],
        )
        return _ranges(rows)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        rows = self.rows(
            f"SELECT msg FROM {_quoted(topic)} WHERE {_T} <= ? ORDER BY {_T} DESC LIMIT 1", [time]
        )
        found: NDArray[np.float32] = _ranges(rows)[0]
        return found

    def table(self, topic: str) -> pd.DataFrame:
        return _table(self.rows(f"SELECT msg FROM {_quoted(topic)} ORDER BY {_T}"))


def get_val(message: str, path: str) -> Any:
    """A field of a message; None when there is none."""
    value = orjson.loads(message)
    for name in path.split("."):
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _scalar(message: str, path: str) -> Any:
    """A field as SQLite takes it: objects and lists as text."""
    value = get_val(message, path)
    return orjson.dumps(value).decode() if isinstance(value, dict | list) else value


def _comparison(order: Callable[[Any, Any], bool]) -> Callable[[str, str, Any], bool]:
    def compare(message: str, path: str, value: Any) -> bool:
        found = get_val(message, path)
        return found is not None and order(found, value)

    return compare


def _time_diff(one: str, path: str, other: str, other_path: str) -> float:
    """Milliseconds between two times, whichever is the earlier."""
    times = (get_val(one, path), get_val(other, other_path))
    first, second = (datetime.fromisoformat(time) for time in times)
    return abs((first - second).total_seconds()) * 1e3


def _ranges(rows: Sequence[tuple[Any, ...]]) -> NDArray[np.float32]:
    return np.array([orjson.loads(row[0])["ranges"] for row in rows], np.float32)


def _table(rows: Sequence[tuple[Any, ...]]) -> pd.DataFrame:
    import pandas as pd

    return pd.json_normalize([orjson.loads(row[0]) for row in rows])
