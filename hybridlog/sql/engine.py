"""Runs SQL on a store: connections to DuckDB, and answers of queries."""

from __future__ import annotations

import re
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
from msgspec.structs import replace

from hybridlog.query.answers.completeness import completeness_of
from hybridlog.query.question import Question
from hybridlog.schema.states import without_fields
from hybridlog.sql.content import TREE, StoreContent, paths_named
from hybridlog.sql.duck import MEMORY, Worker, explained, open_duckdb
from hybridlog.sql.views import Reading, TopicDataset
from hybridlog.wording import MAX_ROWS, arrow_html, meant
from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    import pandas as pd

    from hybridlog.query.answers.completeness import Completeness
    from hybridlog.session import Asked

Params = Sequence[Any] | Mapping[str, Any] | None
EVERYWHERE: Final = Question(())
"""A scope of all recordings and times."""
_BATCH_ROWS: Final = 65_536
_FIRST_ROWS: Final = 64
_NO_TABLE: Final = re.compile(r"Catalog Error: Table with name (.+?) does not exist")


class SqlEngine:
    """Runs SQL on an open store. Thread safe."""

    def __init__(self, source: Asked) -> None:
        self._source = source
        self._bases: dict[int, Any] = {}
        self._content: StoreContent | None = None
        self._lock = threading.RLock()

    def connect(
        self,
        memory: int | None = None,
        *,
        only_reads: bool = False,
        scope: Question = EVERYWHERE,
    ) -> SqlConnection:
        """A connection; what is created in it is there until it is closed.

        Args:
            memory: Limit of DuckDB's memory, bytes; None for 1 GiB.
            only_reads: Nothing can be created in it.
            scope: The recordings and times that views and tables show, whatever its topics.

        Raises:
            MissingDependencyError: DuckDB is not installed.
            UsageError: the limit is too low.
        """
        most = MEMORY if memory is None else memory
        with self._lock:
            if most not in self._bases:
                self._bases[most] = open_duckdb(most)
            cursor = self._bases[most].cursor()
            return SqlConnection(self, cursor, most, scope, only_reads=only_reads)

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


class SqlConnection:
    """Runs queries one after the other. Not thread safe.

    `memory` is DuckDB's limit, bytes. With `only_reads`, statements other than queries are refused.
    """

    def __init__(
        self,
        engine: SqlEngine,
        cursor: Any,
        memory: int,
        scope: Question,
        *,
        only_reads: bool = False,
    ) -> None:
        self.cursor = cursor
        self.memory = memory
        self.scope = scope
        self.reading = Reading()
        self._engine = engine
        self._only_reads = only_reads
        self._has_own = False  # views and macros of the user read what a query does not name
        self._names: set[str] = set()

    @property
    def content(self) -> StoreContent:
        """Recordings and views as they are now."""
        return self._engine.content(self.scope)

    def query(self, text: str, params: Params = None, timeout: float | None = None) -> SqlAnswer:
        """Prepare a query; of several statements, all but the last are run.

        Args:
            text: One statement or several.
            params: Values of `?` or `$name` in the last statement.
            timeout: Seconds that it may take; None for no limit.

        Raises:
            UsageError: DuckDB refuses it.
        """
        if isinstance(params, str) or not isinstance(() if params is None else params, Iterable):
            raise UsageError("Parameters are a list, or a dictionary by name: sql(query, [0.5]).")
        if not isinstance(timeout, int | float | None):
            raise UsageError(f"A timeout is a number of seconds, not {timeout!r}.")
        with explained(self.memory):
            statements = list(self.cursor.extract_statements(text))
        if not statements:
            raise UsageError("The query is empty.")
        kinds = [*map(_kind, statements)]
        if self._only_reads and {*kinds} != {"SELECT"}:
            raise UsageError("Only queries are possible here, such as select and show.")
        content = self.content
        self._names.update(content.named(text))
        for name in self._names.intersection(content.names):
            view = content.view(name)
            source = TopicDataset(view, lambda: self.reading) if view else content.table(name)
            self.cursor.register(name, source)
        for statement, kind in zip(statements, kinds, strict=True):
            asked = params if statement is statements[-1] else None
            named = None
            if kind == "SELECT" and not self._has_own:
                sql = statement.query.strip().rstrip(";")
                named = paths_named(self.cursor.cursor().execute(TREE, [sql]).fetchone()[0])
            answer = SqlAnswer(self, statement.query, asked, Reading(named), timeout)
            if kind not in {"SELECT", "EXPLAIN"}:
                self._has_own = True
                answer.run()
        return answer

    def close(self) -> None:
        """Close the connection."""
        self.cursor.close()


class SqlAnswer:
    """The answer of a query, computed whenever it is asked for; its connection must be open then.

    The timeout is in seconds, None for no limit.

    Attributes:
        columns: Names of the columns; empty for statements that return nothing.
        reading: What was read for it, and what it may lack.
    """

    def __init__(
        self,
        connection: SqlConnection,
        text: str,
        params: Params,
        reading: Reading,
        timeout: float | None,
    ) -> None:
        self._connection = connection
        self._timeout = timeout
        self.reading = reading
        self._done: pa.Table | None = None  # of a statement that changes something
        try:
            with explained(connection.memory):
                self._relation = connection.cursor.sql(text, params=params)
        except UsageError as error:
            found = _NO_TABLE.match(str(error))
            if found is None:
                raise
            hint = meant(found[1], connection.content.names)
            raise TopicError(f"There is no view {found[1]!r}; {hint}") from error
        self.columns: list[str] = [] if self._relation is None else list(self._relation.columns)

    def __repr__(self) -> str:
        return f"<SqlAnswer of {len(self.columns)} columns: {', '.join(self.columns[:8])}>"

    def _repr_html_(self) -> str:
        return arrow_html(repr(self), self.first(MAX_ROWS, 1 << 20)[0])

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
        asked = replace(self._connection.scope, topics=topics, recordings=recordings)
        return completeness_of(self._connection.content.session, asked)

    def run(self) -> None:
        """Compute a statement that changes something, once."""
        self._done = self.to_arrow() if self.columns else pa.table({})

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

    def first(self, rows: int, size: int) -> tuple[pa.Table, bool]:
        """The first rows of a query, and whether there are more; the others are not computed.

        No further row is taken after so many bytes.
        """
        taken: list[pa.RecordBatch] = []
        # Few rows at a time: each may be an image.
        for batch in self._batches(_FIRST_ROWS, self._relation.limit(rows + 1)):
            if sum(one.nbytes for one in taken) > size:
                return pa.Table.from_batches(taken), True
            taken.append(batch)
        table = pa.Table.from_batches(taken)
        return table.slice(0, rows), table.num_rows > rows

    def to_batches(self) -> Iterator[pa.RecordBatch]:
        """The answer in record batches of bounded size, at least one.

        The next query of the connection ends it.

        Raises:
            ResourceError: it needs more memory or time than it may.
        """
        if self._done is not None:
            return iter(self._done.to_batches())
        return self._batches(_BATCH_ROWS, self._relation)

    def _batches(self, size: int, relation: Any) -> Iterator[pa.RecordBatch]:
        """The answer in batches of so many rows."""
        connection = self._connection
        reading = self.reading = connection.reading = Reading(self.reading.named)
        with (
            closing(Worker(connection.cursor, self._timeout)) as worker,
            explained(connection.memory, lambda: reading.error),
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
