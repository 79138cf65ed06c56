"""SQLite with messages as JSON text: as in the paper, and as one would do it today."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from benchmarks.backends.base import BackendFailedError, failing, need
from benchmarks.backends.conversion import T
from benchmarks.backends.database import DatabaseBackend
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel

BATCH_S = 2.0
"""Seconds of messages in one transaction."""
BATCH_BYTES = 16 << 20
"""Characters of JSON after which a transaction is not put off any longer."""
_BUSY_S = 5.0


def table_of(topic: str) -> str:
    """Name of the table of a topic, as an SQL identifier: its collection's."""
    return f'"{collection_of(topic)}"'


def expression(path: str, column: str = "msg") -> str:
    """The value at a path, as an index has it: `json_extract(msg, '$.pose.x')`.

    A query uses the index when it asks for exactly this.

    Args:
        path: Names joined by dots.
        column: Of the table.
    """
    return f"json_extract({column}, '$.{path}')"


class Sqlite(DatabaseBackend):
    """One file, one connection under a lock, one transaction a message.

    As SQLite's documentation advises for many small transactions: the journal mode is
    WAL, `synchronous` is NORMAL.
    """

    name, title = "sqlite", "SQLite"

    _is_indexed: ClassVar[bool] = False

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.path = directory / "messages.sqlite3"
        """The database file."""
        self._lock = threading.Lock()
        self._opened: sqlite3.Connection | None = None
        self._inserts: list[str] = []

    @property
    def connection(self) -> sqlite3.Connection:
        """The connection; between `open` and `close`."""
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
                self.path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False
            )
            self._opened.execute("PRAGMA journal_mode = WAL")
            self._opened.execute("PRAGMA synchronous = NORMAL")
            self._make_tables()
        self._inserts = [
            f"INSERT INTO {table_of(channel.topic)} (msg) VALUES (?)" for channel in channels
        ]

    def _make_tables(self) -> None:
        for topic, groups in self._topics().items():
            table = table_of(topic)
            self.connection.execute(
                f"CREATE TABLE IF NOT EXISTS {table} (id INTEGER PRIMARY KEY, msg TEXT)"
            )
            for group in [*groups, (T,)] if self._is_indexed else ():
                keys = ", ".join(expression(path) for path in group)
                index = f'"{collection_of(topic)} by {group[0]}"'
                self.connection.execute(f"CREATE INDEX IF NOT EXISTS {index} ON {table} ({keys})")

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        text = self._converters[channel].text(log_time, payload)
        with self._lock:
            try:
                self.connection.execute(self._inserts[channel], (text,))
            except sqlite3.Error as error:
                raise BackendFailedError(f"SQLite: {error}") from error

    def finish(self) -> None:
        with self._lock, failing("SQLite", sqlite3.Error):
            # With `synchronous` NORMAL this is when commits reach the disk for good.
            self.connection.execute("PRAGMA wal_checkpoint(FULL)")

    def counts(self) -> Mapping[str, int]:
        with self._lock, failing("SQLite", sqlite3.Error):
            return {
                topic: self.connection.execute(
                    f"SELECT count(*) FROM {table_of(topic)}"
                ).fetchone()[0]
                for topic in self._topics()
            }

    def close(self) -> None:
        with self._lock:
            connection, self._opened = self._opened, None
            if connection is not None:
                connection.close()


class SqliteIndexed(Sqlite):
    """The same text, with SQLite's own JSON functions, indexes on them, and 2 s batches.

    One transaction holds the messages of all topics for 2 s or 16 MiB. There are indexes
    on `json_extract` of the fields of the paper's appendix A, where a topic's type has
    them, and of `_meta.t`.
    """

    name, records = "sqlite_indexed", False
    asker = "benchmarks.questions.sqlite:SqliteAsker"
    reader = "benchmarks.questions.sqlite:SqliteReading"
    _is_indexed = True

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._since = 0.0
        self._size = 0

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        text = self._converters[channel].text(log_time, payload)
        with self._lock:
            connection = self.connection
            try:
                if not connection.in_transaction:
                    connection.execute("BEGIN IMMEDIATE")
                    self._since, self._size = time.monotonic(), 0
                connection.execute(self._inserts[channel], (text,))
                self._size += len(text)
                if self._size >= BATCH_BYTES or time.monotonic() - self._since >= BATCH_S:
                    connection.execute("COMMIT")
            except sqlite3.Error as error:
                raise BackendFailedError(f"SQLite: {error}") from error

    def finish(self) -> None:
        with self._lock, failing("SQLite", sqlite3.Error):
            if self.connection.in_transaction:
                self.connection.execute("COMMIT")
        super().finish()
