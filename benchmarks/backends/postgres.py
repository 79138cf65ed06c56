"""PostgreSQL with messages as JSON: tuned, and tuned and indexed."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from benchmarks.backends import postgres_server
from benchmarks.backends.base import BackendFailedError, failing, need
from benchmarks.backends.conversion import T
from benchmarks.backends.server import Server
from benchmarks.backends.sql import SqlBackend, is_due, table_of

if TYPE_CHECKING:
    from psycopg import Connection, Copy

    from hybridlog_storage.messages import Channel

_DEFAULT_CONNECTIONS = 100
_SPARE_CONNECTIONS = 10
_MIB = 1 << 20


@dataclass(slots=True)
class _Batch:
    """One channel's transaction, to which its messages go as they come."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    copy: Copy | None = None
    ending: ExitStack = field(default_factory=ExitStack)
    size: int = 0
    since: float = 0.0


class Postgres(SqlBackend):
    """A server of its own, tuned as in the paper, and as PostgreSQL's documentation says.

    `shared_buffers` is a quarter and `effective_cache_size` three quarters of the memory.
    For loading: `max_wal_size` of 4 GB (fewer checkpoints), `wal_level = minimal` and
    `max_wal_senders = 0` (nobody replicates), and COPY: one of 2 s or 16 MiB of messages,
    which are handed over as they come, is a transaction. Commits stay synchronous. Small
    messages go in three times as fast with COPY as with `executemany`, large ones as fast.

    One connection a channel, made before the first message; `max_connections` is raised
    only when there are more channels than connections.

    The column is `json`, as in the paper; `postgres_indexed` has `jsonb`.
    """

    name, title = "postgres", "PostgreSQL"
    mark, column, ranges = "%s", "data", "data->'ranges'"
    _type: ClassVar[str] = "json"
    _is_indexed: ClassVar[bool] = False

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._server = Server("postgres", directory)
        self._connections: list[Connection] = []
        self._batches: list[_Batch] = []
        self._copies: list[str] = []

    @classmethod
    def check(cls) -> None:
        need("psycopg", "psycopg[binary]")
        need("orjson", "orjson")
        postgres_server.find_programs()

    def _connect(self) -> Connection:
        """A new connection in autocommit mode."""
        import orjson
        import psycopg
        from psycopg.types.json import set_json_loads

        with failing("PostgreSQL", psycopg.Error):
            address = postgres_server.connection_string(self._server.sockets)
            made = psycopg.connect(address, autocommit=True)
        set_json_loads(orjson.loads, made)  # the standard library's takes several times as long
        return made

    def open(self, channels: Sequence[Channel]) -> None:
        self.check()
        self._take_channels(channels)
        needed = len(channels) + _SPARE_CONNECTIONS
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        settings: dict[str, str | int] = {
            "max_connections": max(_DEFAULT_CONNECTIONS, needed),
            "shared_buffers": f"{memory // 4 // _MIB}MB",
            "effective_cache_size": f"{memory * 3 // 4 // _MIB}MB",
            "max_wal_size": "4GB",
            "wal_level": "minimal",
            "max_wal_senders": 0,
        }
        programs = postgres_server.find_programs()
        postgres_server.start(programs, self._server, self.directory / "postgres", settings)
        self._connections = [self._connect() for _ in channels]
        self._batches = [_Batch() for _ in channels]
        self._make_tables()

    def _make_tables(self) -> None:
        import psycopg

        connection = self._connections[0]
        with failing("PostgreSQL", psycopg.Error):
            for topic, groups in self._topics().items():
                table = table_of(topic)
                if self.rows("SELECT to_regclass(%s)", [table]) != [(None,)]:
                    continue
                # All or nothing: a table that is there has its indexes.
                with connection.transaction():
                    make = f"CREATE TABLE {table} (id bigserial PRIMARY KEY, data {self._type})"
                    connection.execute(make.encode())
                    for group in [*groups, (T,)] if self._is_indexed else ():
                        keys = ", ".join(self.field(path) for path in group)
                        connection.execute(f"CREATE INDEX ON {table} ({keys})".encode())
        self._copies = [f"COPY {table_of(c.topic)} (data) FROM STDIN" for c in self._channels]

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        import psycopg

        text = self._converters[channel].text(log_time, payload)
        batch = self._batches[channel]
        with batch.lock:
            try:
                copy = batch.copy or self._begin(channel, batch)
                copy.write_row((text,))
            except psycopg.Error as error:
                raise BackendFailedError(f"PostgreSQL: {error}") from error
            batch.size += len(text)
            if is_due(batch.size, batch.since):
                self._commit(batch)

    def finish(self) -> None:
        for batch in self._batches:
            with batch.lock:
                self._commit(batch)
        if self._is_indexed:
            # As a loaded database has it after a minute, and a query's plan needs it.
            self._connections[0].execute("ANALYZE")

    def counts(self) -> Mapping[str, int]:
        import psycopg

        with failing("PostgreSQL", psycopg.Error):
            return {topic: self._count(topic, "true") for topic in self._topics()}

    def close(self) -> None:
        connections, self._connections = self._connections, []
        try:
            for connection in connections:
                connection.close()
        finally:
            self._server.stop()

    def processes(self) -> Sequence[int]:
        return self._server.processes()

    def rows(self, query: str, values: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        return self._connections[0].execute(query.encode(), list(values)).fetchall()

    def field(self, path: str, table: str = "") -> str:
        """The number at a path: `((data->'pose'->>'x')::float8)`; `_meta.t` is a `bigint`."""
        *outer, last = (f"'{name}'" for name in path.split("."))
        column = f"{table}.data" if table else "data"
        kind = "bigint" if path == T else "float8"
        return f"(({'->'.join([column, *outer])}->>{last})::{kind})"

    def loaded(self, value: Any) -> Any:
        return value

    def _begin(self, channel: int, batch: _Batch) -> Copy:
        """A COPY, which is a transaction by itself."""
        cursor = batch.ending.enter_context(self._connections[channel].cursor())
        batch.copy = batch.ending.enter_context(cursor.copy(self._copies[channel]))
        batch.since = time.monotonic()
        return batch.copy

    def _commit(self, batch: _Batch) -> None:
        import psycopg

        with failing("PostgreSQL", psycopg.Error):
            batch.ending.close()
        batch.copy, batch.size = None, 0


class PostgresIndexed(Postgres):
    """Tuned, with expression indexes on the fields of the paper's appendix A.

    The paper could not index a cast; today's PostgreSQL can. The column is `jsonb`, as its
    documentation advises where JSON is asked: measured with small messages, laser scans
    and images, it went in 0.8 to 3 times as fast as `json`, and a field was found 2 to 8
    times as fast. Each table has an index on `_meta.t`.
    """

    name, records, answers, reads = "postgres_indexed", False, True, True
    _type = "jsonb"
    _is_indexed = True
