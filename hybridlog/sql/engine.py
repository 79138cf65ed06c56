"""Runs SQL on a store: DuckDB as that needs it, and answers of queries.

DuckDB is bounded, interruptible, without access to anything else.
"""

from __future__ import annotations

import re
import resource
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager, suppress
from functools import partial
from importlib import import_module
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from weakref import proxy, ref

import pyarrow as pa
from msgspec.structs import replace

from hybridlog.query.answers.completeness import Completeness, completeness_of
from hybridlog.query.question import Question
from hybridlog.schema.states import without_fields
from hybridlog.sql.content import TREE, StoreContent, paths_named
from hybridlog.sql.views import Names, Reading, TopicDataset
from hybridlog.wording import MAX_ROWS, arrow_html, meant
from hybridlog_storage.errors import HybridlogError, ResourceError, TopicError, UsageError, extra
from hybridlog_storage.stopping import at_safe_points, safe_point
from hybridlog_storage.threads import processors

if TYPE_CHECKING:
    import pandas as pd

    from hybridlog.session import Asked

Params = Sequence[Any] | Mapping[str, Any] | None
EVERYWHERE: Final = Question(())
"""A scope of all recordings and times."""
_BATCH_ROWS: Final = 65_536
_NO_TABLE: Final = re.compile(r"Catalog Error: Table with name (.+?) does not exist")
MEMORY: Final = 1 << 30
"""Default limit of DuckDB's memory, bytes."""
MIN_MEMORY: Final = 64 << 20
"""Least limit of DuckDB's memory, bytes."""
_POLL_S: Final = 0.05
_SETTINGS: Final = {
    "allow_community_extensions": False,
    "allow_persistent_secrets": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "enable_external_access": False,
    "extension_directory": "none",
    "python_enable_replacements": False,
    "secret_directory": "none",
    "temp_directory": "",
}
_SHORTAGES: Final = ("Out of Memory", "Cannot allocate memory", "start new thread")
_T = TypeVar("_T")

OWN_MEMORY: Final = 512 << 20
"""Bytes that hybridlog may take beside DuckDB, on top of what the process has at the start."""


def duckdb() -> Any:
    """The package, or a `MissingDependencyError`."""
    with extra("sql", "SQL needs DuckDB"):
        return import_module("duckdb")


def open_duckdb(memory: int) -> Any:
    """DuckDB in memory (at most so many bytes), which reads nothing but what is registered.

    Files, extensions, other databases and variables of Python are out of its reach, and no query
    can change its settings.
    """
    if memory < MIN_MEMORY:
        raise UsageError(f"SQL needs at least {MIN_MEMORY >> 20} MiB of memory.")
    settings = {**_SETTINGS, "memory_limit": f"{memory}B", "threads": processors()}
    base = duckdb().connect(":memory:", config=settings)
    base.execute("set global TimeZone = 'UTC'")
    base.execute("set global lock_configuration = true")
    return base


@contextmanager
def explained(memory: int, first: Callable[[], Exception | None] = lambda: None) -> Iterator[None]:
    """Turn errors of DuckDB into ours, or into the `first` of what it reads, which caused them.

    `memory` is its limit, bytes.
    """
    package = duckdb()
    try:
        yield
    except Exception as error:
        cause = first() if isinstance(error, package.Error) else None
        if isinstance(cause, HybridlogError):
            raise cause from None
        if isinstance(error, package.PermissionException):
            text = str(error).strip().partition("\n")[0]
            raise UsageError(
                "SQL reads the views of this store alone; files, extensions and other databases "
                f"are off. {text}"
            ) from error
        real = cause or error
        is_short = isinstance(real, MemoryError | package.OutOfMemoryException)
        if is_short or any(text in str(real) for text in _SHORTAGES):
            raise ResourceError(
                f"The query needs more than {memory >> 20} MiB of memory: ask for less at a time, "
                "or allow more (`hybridlog sql --memory`)."
            ) from error
        if isinstance(error, package.Error):
            raise UsageError(str(real).strip()) from error
        raise


class Worker:
    """Runs calls of one connection in a thread, so that Ctrl-C and timeouts interrupt them.

    The timeout is seconds for all calls, None for no limit.
    """

    def __init__(self, cursor: Any, timeout: float | None) -> None:
        self._cursor = cursor
        self._timeout = timeout
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="hybridlog-sql")
        self._until = time.monotonic() + (inf if timeout is None else timeout)

    def run(self, call: Callable[[], _T]) -> _T:
        """The result of a call; an error when the time is over, or it was stopped."""
        with at_safe_points():
            future: Future[_T] = self._pool.submit(call)
            try:
                while not wait([future], _POLL_S).done:
                    safe_point()  # Ctrl-C
                    if time.monotonic() >= self._until:
                        raise HybridlogError(
                            f"The query was stopped after {self._timeout:g} s: narrow it down, or "
                            "allow more."
                        )
            except BaseException:
                # A call that has not reached DuckDB yet does not notice.
                while not future.done():
                    with suppress(KeyboardInterrupt):  # pressed again
                        self._cursor.interrupt()
                        wait([future], _POLL_S)
                raise
            return future.result()

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(cancel_futures=True)


def private_bytes() -> int:
    """Bytes of private memory of this process, reserved ones included; 0 where it is unknown."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:"))


@contextmanager
def limited_memory(memory: int) -> Iterator[int]:
    """Limit what this process takes from now on, where the system can; yields the limit, bytes.

    `OWN_MEMORY` is on top of DuckDB's memory.
    """
    before, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = private_bytes() + memory + OWN_MEMORY
    most = wanted if before == resource.RLIM_INFINITY else min(wanted, before)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    try:
        yield most
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (before, hard))


class SqlEngine:
    """Runs SQL on an open store. Thread safe."""

    def __init__(self, source: Asked) -> None:
        self._source = source
        self._bases: dict[int, Any] = {}
        self._content: StoreContent | None = None
        self._lock = threading.RLock()

    def query(
        self,
        text: str,
        params: Params = None,
        timeout: float | None = None,
        *,
        memory: int | None = None,
        scope: Question = EVERYWHERE,
    ) -> SqlAnswer:
        """Prepare a query; of several statements, all but the last are run.

        What it creates is there as long as its answer.

        Args:
            text: One statement or several.
            params: Values of `?` or `$name` in the last statement.
            timeout: Seconds that it may take; None for no limit.
            memory: Limit of DuckDB's memory, bytes; None for 1 GiB.
            scope: The recordings and times that views and tables show, whatever its topics.

        Raises:
            MissingDependencyError: DuckDB is not installed.
            UsageError: DuckDB refuses it, or the limit is too low.
        """
        if isinstance(params, str) or not isinstance(() if params is None else params, Iterable):
            raise UsageError("Parameters are a list, or a dictionary by name: sql(query, [0.5]).")
        if not isinstance(timeout, int | float | None):
            raise UsageError(f"A timeout is a number of seconds, not {timeout!r}.")
        most = MEMORY if memory is None else memory
        with self._lock:
            if most not in self._bases:
                self._bases[most] = open_duckdb(most)
            cursor = self._bases[most].cursor()
        with explained(most):
            statements = list(cursor.extract_statements(text))
        if not statements:
            raise UsageError("The query is empty.")
        named = None
        if [*map(_kind, statements)] == ["SELECT"]:
            sql = statements[0].query.strip().rstrip(";")
            named = paths_named(cursor.cursor().execute(TREE, [sql]).fetchone()[0])
        else:  # what it creates is its own
            cursor = open_duckdb(most).cursor()
        return SqlAnswer(
            self.content(scope),
            cursor,
            text,
            statements,
            params,
            named=named,
            memory=most,
            timeout=timeout,
        )

    def content(self, scope: Question = EVERYWHERE) -> StoreContent:
        """Recordings and views of a scope as they are now."""
        with self._lock:
            known, session = self._content, self._source.now()
            if known is None or known.scope != scope or known.snapshot is not session.look():
                known = self._content = StoreContent(session, scope)
            return known

    def close(self) -> None:
        """Close DuckDB. May be called more than once."""
        with self._lock:
            for base in self._bases.values():
                base.close()
            self._bases.clear()
            self._content = None


_Batches = Generator[pa.RecordBatch, None, None]


class SqlAnswer:
    """The answer of a query, computed whenever it is asked for; its store must be open then.

    The limit of DuckDB's memory is in bytes, the timeout in seconds, None for no limit.

    Attributes:
        columns: Names of the columns; empty for statements that return nothing.
        reading: What was read for it, and what it may lack.
    """

    def __init__(
        self,
        content: StoreContent,
        cursor: Any,
        text: str,
        statements: Sequence[Any],
        params: Params,
        *,
        named: Names,
        memory: int,
        timeout: float | None,
    ) -> None:
        self._content, self._cursor, self._memory = content, cursor, memory
        self._timeout, self.reading = timeout, Reading(named)
        self._last: Callable[[], _Batches | None] = lambda: None
        own = proxy(self)  # nothing that the cursor has keeps the answer
        for name in content.named(text):
            view = content.view(name)
            source = TopicDataset(view, lambda: own.reading) if view else content.table(name)
            cursor.register(name, source)
        for statement in statements:
            self._done: pa.Table | None = None  # of a statement that changes something
            asked = params if statement is statements[-1] else None
            self._relation = self._prepared(statement.query, asked)
            found = self._relation
            self.columns: list[str] = [] if found is None else list(found.columns)
            if _kind(statement) not in {"SELECT", "EXPLAIN"}:
                self._done = self.to_arrow() if self.columns else pa.table({})

    def _prepared(self, text: str, params: Params) -> Any:
        """The relation of a statement; None if it returns nothing."""
        try:
            with explained(self._memory):
                return self._cursor.sql(text, params=params)
        except UsageError as error:
            found = _NO_TABLE.match(str(error))
            if found is None:
                raise
            hint = meant(found[1], self._content.names)
            raise TopicError(f"There is no view {found[1]!r}; {hint}") from error

    def __repr__(self) -> str:
        return f"<SqlAnswer of {len(self.columns)} columns: {', '.join(self.columns[:8])}>"

    def _repr_html_(self) -> str:
        table = self._done
        if table is None:
            rows = self._computed(MAX_ROWS, self._relation.limit(MAX_ROWS))
            table = pa.Table.from_batches([*rows])
        return arrow_html(repr(self), table)

    def sentences(self) -> list[str]:
        """Sentences about what the computed answer may lack."""
        found = self.reading
        lines = [
            f"{topic} has no columns of fields: {reason}."
            for topic, reason in found.undefined.items()
        ]
        lines += [
            f"{topic}: {without_fields(count, state)}."
            for (topic, state), count in found.absent.items()
        ]
        return [*lines, *self.completeness().sentences]

    def completeness(self) -> Completeness:
        """Completeness of the computed answer, by what was read for it."""
        topics, recordings = tuple(self.reading.topics), tuple(self.reading.recordings)
        asked = replace(self._content.scope, topics=topics, recordings=recordings)
        return completeness_of(self._content.session, asked)

    def check_names(self) -> None:
        """Check that no two columns have one name, for forms that go by names.

        Raises:
            UsageError: two have.
        """
        for name, number in Counter(self.columns).items():
            if number > 1:
                raise UsageError(f"There are two columns {name!r}: name one with `as`.")

    def to_arrow(self) -> pa.Table:
        """The whole answer as an Arrow table.

        Raises:
            ResourceError: it needs more memory or time than it may.
        """
        done = self._done
        return pa.Table.from_batches([*self.to_batches()]) if done is None else done

    def to_batches(self) -> Iterator[pa.RecordBatch]:
        """The answer in record batches of bounded size, at least one.

        When it is computed again, that ends it.

        Raises:
            ResourceError: it needs more memory or time than it may.
        """
        if self._done is not None:
            return iter(self._done.to_batches())
        return self._computed(_BATCH_ROWS, self._relation)

    def _computed(self, size: int, relation: Any) -> _Batches:
        """The answer in batches of so many rows; what was computed last ends."""
        if (last := self._last()) is not None:
            last.close()
        batches = self._batches(size, relation)
        self._last = ref(batches)
        return batches

    def _batches(self, size: int, relation: Any) -> _Batches:
        """The answer in batches of so many rows."""
        reading = self.reading = Reading(self.reading.named)
        with (
            closing(Worker(self._cursor, self._timeout)) as worker,
            explained(self._memory, lambda: reading.error),
        ):
            reader = worker.run(lambda: relation.to_arrow_reader(size))
            batch = worker.run(partial(next, reader, None))
            if batch is None:
                yield pa.RecordBatch.from_pylist([], schema=reader.schema)
            while batch is not None:
                yield batch
                batch = worker.run(partial(next, reader, None))

    def to_pandas(self) -> pd.DataFrame:
        """The whole answer as a pandas frame.

        Raises:
            ResourceError: it needs more memory or time than it may.
            UsageError: two columns have one name.
        """
        from hybridlog.frames.frame import frame_of_table

        self.check_names()
        return frame_of_table(self.to_arrow())

    def to_polars(self) -> Any:
        """The whole answer as a polars frame.

        Raises:
            MissingDependencyError: polars is not installed.
            ResourceError: it needs more memory or time than it may.
            UsageError: two columns have one name.
        """
        from hybridlog.frames.frame import to_polars

        self.check_names()
        return to_polars(self.to_arrow())

    def rows(self) -> list[tuple[Any, ...]]:
        """The whole answer as tuples of Python values."""
        columns = [column.to_pylist(maps_as_pydicts="strict") for column in self.to_arrow().columns]
        return list(zip(*columns, strict=True))


def _kind(statement: Any) -> str:
    """Kind of a statement; empty for those that the package has no name for."""
    try:
        return str(statement.type.name)
    except ValueError:
        return ""
