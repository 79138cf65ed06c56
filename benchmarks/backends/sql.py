"""What PostgreSQL and SQLite have in common: batches, and questions in the same words."""

from __future__ import annotations

import sqlite3
import threading
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from benchmarks.backends.base import (
    ARM,
    GRIPPER,
    HALF_NS,
    VIEWPOINT,
    BackendFailedError,
    failing,
    need,
    sums,
)
from benchmarks.backends.conversion import DatabaseBackend, T
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel

_BATCH_S = 2.0  # of messages in one transaction, as in the paper
_BATCH_CHARACTERS = 16 << 20  # of JSON, after which it is not put off any longer


def is_due(size: int, since: float) -> bool:
    """Whether a transaction is not put off any longer."""
    return size >= _BATCH_CHARACTERS or time.monotonic() - since >= _BATCH_S


def table_of(topic: str) -> str:
    """Name of the table of a topic, as an SQL identifier: its collection's."""
    return f'"{collection_of(topic)}"'


class SqlBackend(DatabaseBackend):
    """A table a topic, with the messages in one column."""

    mark: ClassVar[str]
    """Where a value stands in a query."""
    column: ClassVar[str]
    ranges: ClassVar[str]
    """Expression of the ranges of a scan, or of a message that has them."""
    front: ClassVar[str] = ""
    """Before the viewpoint's x in Q4."""

    @abstractmethod
    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """What a query answers."""

    @abstractmethod
    def field(self, path: str, table: str = "") -> str:
        """The expression of a field, as the indexes have it: a query uses one for exactly that."""

    @abstractmethod
    def loaded(self, value: Any) -> Any:
        """A message, or what `ranges` gives."""

    def _count(self, topic: str, condition: str) -> int:
        return int(self.rows(f"SELECT COUNT(*) FROM {table_of(topic)} WHERE {condition}")[0][0])

    def closings(self) -> int:
        return self._count(GRIPPER, f"{self.field('position')} = 0")

    def behind(self) -> int:
        return self._count(VIEWPOINT, f"{self.field('position.x')} <= 0")

    def in_region(self) -> int:
        x, y, z = (self.field(f"pose.position.{axis}") for axis in "xyz")
        return self._count(ARM, f"{z} > 1 AND {y} > -0.5 AND {y} < 0.5 AND {x} > 0.5 AND {x} < 1")

    def grasps(self) -> int:
        mine, theirs = self.field("_meta.t", "a"), self.field("_meta.t", "b")
        query = (
            f"SELECT COUNT(*) FROM {table_of(GRIPPER)} a "
            f"WHERE {self.field('position', 'a')} = 0 AND EXISTS ("
            f"SELECT 1 FROM {table_of(VIEWPOINT)} b "
            f"WHERE {theirs} > {mine} - {self.mark} AND {theirs} < {mine} + {self.mark} "
            f"AND {self.front}{self.field('position.x', 'b')} >= 0)"
        )
        return int(self.rows(query, [HALF_NS, HALF_NS])[0][0])

    def positions(self) -> list[float]:
        x, y, z = (self.field(f"position.{axis}") for axis in "xyz")
        query = f"SELECT {x}, {y}, {z} FROM {table_of(VIEWPOINT)} WHERE {x} <= 0"
        return sums(self.rows(query))

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        at = self.field("_meta.t")
        return self._ranges(
            topic, f"{at} >= {self.mark} AND {at} < {self.mark} ORDER BY {at}", begin, end
        )

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        at = self.field("_meta.t")
        until = f"{at} <= {self.mark} ORDER BY {at} DESC LIMIT 1"
        found: NDArray[np.float32] = self._ranges(topic, until, time)[0]
        return found

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        at = self.field("_meta.t")
        query = f"SELECT {self.column} FROM {table_of(topic)} ORDER BY {at}"
        return pd.json_normalize([self.loaded(row[0]) for row in self.rows(query)])

    def _ranges(self, topic: str, condition: str, *values: int) -> NDArray[np.float32]:
        query = f"SELECT {self.ranges} FROM {table_of(topic)} WHERE {condition}"
        found = [self.loaded(row[0]) for row in self.rows(query, values)]
        whole = [one["ranges"] if isinstance(one, dict) else one for one in found]
        return np.array(whole, np.float32)


_BUSY_S = 5.0


class Sqlite(SqlBackend):
    """One file, one connection under a lock, one transaction a message.

    As SQLite's documentation advises for many small transactions: the journal mode is
    WAL, `synchronous` is NORMAL.
    """

    name, title = "sqlite", "SQLite"
    mark, column, ranges = "?", "msg", "msg"
    front = "+"  # keeps the planner off the index on x, which half of all rows are in
    _is_indexed: ClassVar[bool] = False

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._lock = threading.Lock()
        self._opened: sqlite3.Connection | None = None
        self._inserts: list[str] = []

    @property
    def _connection(self) -> sqlite3.Connection:
        assert self._opened is not None
        return self._opened

    @classmethod
    def check(cls) -> None:
        need("orjson", "orjson")

    def open(self, channels: Sequence[Channel]) -> None:
        self.check()
        self._take_channels(channels)
        with failing("SQLite", sqlite3.Error):
            self._opened = sqlite3.connect(
                self.directory / "messages.sqlite3",
                timeout=_BUSY_S,
                isolation_level=None,
                check_same_thread=False,
            )
            self._opened.execute("PRAGMA journal_mode = WAL")
            self._opened.execute("PRAGMA synchronous = NORMAL")
            self._make_tables()
        self._inserts = [f"INSERT INTO {table_of(c.topic)} (msg) VALUES (?)" for c in channels]

    def _make_tables(self) -> None:
        for topic, groups in self._topics().items():
            table = table_of(topic)
            make = f"CREATE TABLE IF NOT EXISTS {table} (id INTEGER PRIMARY KEY, msg TEXT)"
            self._connection.execute(make)
            for group in [*groups, (T,)] if self._is_indexed else ():
                keys = ", ".join(self.field(path) for path in group)
                index = f'"{collection_of(topic)} by {group[0]}"'
                self._connection.execute(f"CREATE INDEX IF NOT EXISTS {index} ON {table} ({keys})")

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        text = self._converters[channel].text(log_time, payload)
        with self._lock:
            try:
                self._store(self._inserts[channel], text)
            except sqlite3.Error as error:
                raise BackendFailedError(f"SQLite: {error}") from error

    def _store(self, insert: str, text: str) -> None:
        self._connection.execute(insert, (text,))

    def finish(self) -> None:
        with self._lock, failing("SQLite", sqlite3.Error):
            if self._connection.in_transaction:
                self._connection.execute("COMMIT")
            # With `synchronous` NORMAL this is when commits reach the disk for good.
            self._connection.execute("PRAGMA wal_checkpoint(FULL)")

    def counts(self) -> Mapping[str, int]:
        with failing("SQLite", sqlite3.Error):
            return {topic: self._count(topic, "true") for topic in self._topics()}

    def close(self) -> None:
        with self._lock:
            connection, self._opened = self._opened, None
            if connection is not None:
                connection.close()

    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self._connection.execute(query, values).fetchall()

    def field(self, path: str, table: str = "") -> str:
        return f"json_extract({table}{'.' * bool(table)}msg, '$.{path}')"

    def loaded(self, value: Any) -> Any:
        import orjson

        return orjson.loads(value)


class SqliteIndexed(Sqlite):
    """The same text, with SQLite's own JSON functions, indexes on them, and 2 s batches.

    One transaction holds the messages of all topics for 2 s or 16 MiB. There are indexes
    on `json_extract` of the fields of the paper's appendix A, where a topic's type has
    them, and of `_meta.t`.
    """

    name, records, answers, reads = "sqlite_indexed", False, True, True
    _is_indexed = True
    _since, _size = 0.0, 0

    def _store(self, insert: str, text: str) -> None:
        if not self._connection.in_transaction:
            self._connection.execute("BEGIN IMMEDIATE")
            self._since, self._size = time.monotonic(), 0
        super()._store(insert, text)
        self._size += len(text)
        if is_due(self._size, self._since):
            self._connection.execute("COMMIT")
