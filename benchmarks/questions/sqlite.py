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
from benchmarks.questions.base import ARM, ERROR, GRIPPER, ROSOUT, VIEWPOINT, windows_before
from benchmarks.questions.sql import Sql, SqlAsker, SqlReading, sums

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.backends.base import Backend

_ORDERS: dict[str, Callable[[Any, Any], bool]] = {"eq": eq, "le": le, "ge": ge, "gt": gt, "lt": lt}


def _quoted(topic: str) -> str:
    return quoted(table_of(topic))


class _Connected(Sql):
    """The backend's own connection."""

    column = "msg"
    connection: sqlite3.Connection

    def start(self, backend: Backend) -> None:
        from benchmarks.backends.sqlite import SqliteUdf

        assert isinstance(backend, SqliteUdf)
        self.connection = backend.connection

    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self.connection.execute(query, values).fetchall()

    def field(self, path: str, table: str = "") -> str:
        return expression(path, f"{table}.msg" if table else "msg")

    def name(self, topic: str) -> str:
        return _quoted(topic)

    def loaded(self, value: Any) -> dict[str, Any]:
        """A row's message."""
        found: dict[str, Any] = orjson.loads(value)
        return found


class SqliteJsonAsker(_Connected, SqlAsker):
    """With SQLite's own functions, in the words that the indexes are on."""

    # Keeps the planner off the index on x, which half of all rows are in.
    front = "+"

    def pose(self) -> str:
        return f"{expression('position')} || {expression('orientation')}"

    def index_bytes(self) -> int | None:
        """All indexes, where this SQLite was built to tell."""
        try:
            return self.number(
                "SELECT coalesce(sum(pgsize), 0) FROM dbstat "
                "WHERE name IN (SELECT name FROM sqlite_master WHERE type = 'index')"
            )
        except sqlite3.OperationalError:  # the table dbstat is an option of the build
            return None


class _WithFunctions(_Connected):
    """With the functions of the appendix, which read a field of a message in Python."""

    def start(self, backend: Backend) -> None:
        super().start(backend)
        for name, order in _ORDERS.items():
            self.connection.create_function(f"json_{name}_field", 3, _comparison(order))
        self.connection.create_function("json_get_time_diff", 4, _time_diff)
        self.connection.create_function("json_get_val", 2, _scalar)

    def field(self, path: str, table: str = "") -> str:
        return f"json_get_val({f'{table}.msg' if table else 'msg'}, '{path}')"


class SqliteUdfAsker(_WithFunctions, SqlAsker):
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
        return sums(self.rows(query, ["position.x", 0]))

    def pose(self) -> str:
        return "json_get_val(msg, 'position') || json_get_val(msg, 'orientation')"

    def closed(self) -> str:
        return "json_eq_field(msg, 'position', 0)"

    def before_errors(self) -> int:
        query = f"SELECT {self.time} FROM {_quoted(ROSOUT)} WHERE json_eq_field(msg, ?, ?)"
        windows = windows_before(row[0] for row in self.rows(query, ["level", ERROR]))
        within = "json_ge_field(msg, ?, ?) AND json_lt_field(msg, ?, ?)"
        any_window = " OR ".join([f"({within})"] * len(windows)) or "0"
        values = [v for begin, end in windows for v in ("_meta.t", begin, "_meta.t", end)]
        return sum(
            self.number(f"SELECT COUNT(*) FROM {_quoted(topic)} WHERE {any_window}", values)
            for topic in self.topics
        )


class SqliteUdfReading(_WithFunctions, SqlReading):
    """Through Python functions: every slice reads the whole table."""

    ranges = "msg"

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        within = "json_ge_field(msg, ?, ?) AND json_lt_field(msg, ?, ?)"
        values = ["_meta.t", begin, "_meta.t", end]
        return self._ranges(topic, f"{within} ORDER BY {self.time}", values)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        until = f"json_le_field(msg, ?, ?) ORDER BY {self.time} DESC LIMIT 1"
        found: NDArray[np.float32] = self._ranges(topic, until, ["_meta.t", time])[0]
        return found


class SqliteJsonReading(_Connected, SqlReading):
    """By `_meta.t`, on which there is an index."""

    ranges = "msg"


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
