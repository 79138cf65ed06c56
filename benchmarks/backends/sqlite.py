"""SQLite with messages as JSON text: as in the paper, and as one would do it today."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from benchmarks.backends.base import BackendFailedError, failing, need
from benchmarks.backends.conversion import T
from benchmarks.backends.sql import SqlBackend, is_due, table_of
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

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
