"""Answers about ended recordings from the Parquet tables of their topics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridlog.query.chunk_scan import ChunkKey, RowSelection
from hybridlog.query.engines import (
    MatchColumns,
    Need,
    UndecidedError,
    Values,
    offsets_by_chunk,
    places_of,
)
from hybridlog.query.message_filter import meta_array
from hybridlog.query.predicate.tree import is_meta
from hybridlog.record.losses import lost_spans
from hybridlog.schema.kinds import SINGLE, element_of, width_of
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.columns.topic_table import TableRows, TopicTable
    from hybridlog.query.bounds import BoundsFinder
    from hybridlog.query.chunk_scan import ChunkTask
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part
    from hybridlog.session import Session

_OPEN_S = 2e-4  # seconds to query an open table
_BYTE_S = 1.5e-9  # seconds to read and decode a stored byte
_WHOLE = 32  # elements; longer arrays are summaries in tables
_IN_FULL = SINGLE - {"uint8", "byte", "char"}  # elements of arrays in tables with arrays


class _Count(NamedTuple):
    """Numbers of messages of a part."""

    matched: int
    unreadable: int


class TablesEngine:
    """Reads only the columns of the question.

    Args:
        session: The open store.
        counters: Count the bytes that are read.
        table_of: Returns the table of a part; None for the one of its whole recording.
        bounds: Gets the bounds of the columns that are read; None to leave them.
    """

    def __init__(
        self,
        session: Session,
        counters: Counters,
        table_of: Callable[[Part], TopicTable | None] | None = None,
        bounds: BoundsFinder | None = None,
    ) -> None:
        self._session = session
        self._bounds = bounds
        self._table_of = table_of or (lambda part: session.table(part.recording, part.topic))
        self._counters = counters
        self._counts: dict[Part, _Count] = {}
        self._counted: set[Part] = set()
        self._places: dict[Part, dict[ChunkKey, NDArray[np.int64]]] = {}

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """By the stored bytes of the columns; None without a table that can tell."""
        table = self._valid_table(part, need, fields)
        if table is None:
            return None
        own = ("ref",) if need is Need.SELECTION else ()
        try:
            wanted = _wanted(table, part, fields if need is Need.VALUES else ())
        except StoreError:
            self._reject(part)
            return None
        size = table.size(wanted, own)
        return _OPEN_S + _BYTE_S * size * max(part.share, 0.01)

    def _valid_table(
        self, part: Part, need: Need, fields: Collection[str] | None
    ) -> TopicTable | None:
        """The table of a part, if it can answer."""
        is_known = part.predicate is None and need not in {Need.OUTCOMES, Need.VALUES}
        if is_known or not part.is_by_log_time:
            return None  # known from the catalog and the chunk index
        asks_publish = part.predicate is not None and "_meta.pub" in part.predicate.fields()
        if asks_publish and len({c.channel.has_publish_time for c in part.channels}) > 1:
            return None  # the table does not say which messages have one
        is_lossy = any(True for _ in lost_spans(part.recording))  # lost rows must not answer
        asks_arrays = need is Need.VALUES and not _are_whole(part, fields, arrays=False)
        if is_lossy or (asks_arrays and not _are_whole(part, fields, arrays=True)):
            return None
        table = self._table_of(part)
        is_whole = table is not None and not (table.reduced or part.undecodable)
        if table is None or not is_whole or (table.unreadable and part.predicate is None):
            return None  # fields of such messages are not in the table
        if asks_arrays and not table.has_arrays:
            return None
        # A table may be older than the package that reads the messages.
        is_older = not table.has_fields and any(c.codec.indexed for c in part.channels)
        return None if is_older else table

    def count(self, parts: Sequence[Part]) -> int:
        """Number of rows for which the predicate holds.

        Raises:
            UndecidedError: the columns of a table cannot decide.
            StoreError: a table is damaged.
        """
        self._count_by_file(parts)
        found = [*map(self.check, parts)]
        self._count_unreadable(parts)
        return sum(found)

    def _count_by_file(self, parts: Sequence[Part]) -> None:
        """Count whole parts that lie in one file: the predicate is evaluated once for all rows."""
        by_file: dict[tuple[int, bool], list[tuple[Part, TopicTable]]] = defaultdict(list)
        for part in parts:
            if part in self._counts or part.predicate is None or not part.is_unbounded:
                continue
            if any(map(is_meta, part.predicate.fields())):
                continue  # known of the part, not of a row
            table = self._table_of(part)
            if table is not None and len(table.files) == 1:
                by_file[table.files[0].number, table.has_arrays].append((part, table))
        for group in by_file.values():
            if len(group) > 1:
                with suppress(UndecidedError, StoreError):  # then part by part
                    self._count_in_file(group)

    def _count_in_file(self, group: Sequence[tuple[Part, TopicTable]]) -> None:
        part, table = group[0]
        types = part.field_types
        whole = self._session.tables.whole(table.files[0], arrays=table.has_arrays)
        matched, unreadable, before = [np.zeros(1, np.int64)], [np.zeros(1, np.int64)], [0]
        alike = [(part, table) for part, table in group if part.field_types == types]
        bounds = None if self._bounds is None else self._bounds.of([part for part, _ in alike])
        own = [(part, one) for part, table in alike for one in table.parts]
        for rows, holds in self._rows(part, whole=whole):
            if bounds is not None:
                here = [pair for pair in own if pair[1].group == len(before) - 1]
                spans = [(part, one.begin, one.begin + one.rows) for part, one in here]
                bounds.add(rows.records, spans)
            before.append(before[-1] + len(rows))
            for found, mask in ((matched, holds), (unreadable, rows.is_unreadable())):
                found.append(found[-1][-1] + np.cumsum(mask))
        sums, bad = np.concatenate(matched), np.concatenate(unreadable)
        for part, table in alike:
            places = [(before[one.group] + one.begin, one.rows) for one in table.parts]
            self._counts[part] = _Count(
                sum(int(sums[begin + rows] - sums[begin]) for begin, rows in places),
                sum(int(bad[begin + rows] - bad[begin]) for begin, rows in places),
            )
            if bounds is not None and not self._counts[part].unreadable:
                bounds.note(part)

    def check(self, part: Part) -> int:
        """The count of one part; confirms that the columns can decide."""
        if part not in self._counts:
            matched = unreadable = 0
            finder = self._bounds if part.is_unbounded else None
            bounds = None if finder is None else finder.of([part])
            for rows, holds in self._rows(part):
                matched += int(holds.sum())
                unreadable += int(rows.is_unreadable().sum())
                if bounds is not None:
                    bounds.add(rows.records, [(part, 0, len(rows))])
            self._counts[part] = _Count(matched, unreadable)
            if bounds is not None and not unreadable:
                bounds.note(part)
        return self._counts[part].matched

    def _count_unreadable(self, parts: Sequence[Part]) -> None:
        """Count the unreadable messages of parts that are answered, once."""
        for part in parts:
            if part not in self._counted:
                self._counted.add(part)
                self._counters.unreadable += self._counts[part].unreadable

    def _confirm(self, parts: Sequence[Part]) -> None:
        """Confirm that the columns can decide, before an answer begins."""
        for part in parts:
            if part.predicate is not None:
                self.check(part)
                self._count_unreadable([part])

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """The outcome for each row, in order."""
        self._confirm([part])
        for rows, holds in self._rows(part):
            yield MatchColumns(rows.t, rows.seq, holds)

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Columns of the rows for which the predicate holds, in order."""
        self._confirm([part])
        for rows, holds in self._rows(part, fields):
            chosen = rows if holds.all() else rows.take(np.flatnonzero(holds))
            if len(chosen):
                yield Values(chosen.t, chosen.seq, _only(chosen.records, fields))

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """References of the rows for which the predicate holds."""
        wanted = {task.key for task in tasks}
        self._confirm(parts)
        found: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
        for part in parts:
            if part not in self._places:
                self._places[part] = self._find(part)
            for key, offsets in self._places[part].items():
                if key in wanted:
                    found[key].append(offsets)
        return RowSelection({key: np.sort(np.concatenate(o)) for key, o in found.items()})

    def _find(self, part: Part) -> dict[ChunkKey, NDArray[np.int64]]:
        places: list[NDArray[np.int64]] = []
        for rows, holds in self._rows(part, own=("ref",)):
            places.append(places_of(rows.own["ref"])[holds])
        return offsets_by_chunk(part.recording.id, np.concatenate(places)) if places else {}

    def _rows(
        self,
        part: Part,
        fields: Collection[str] | None = (),
        own: Collection[str] = (),
        *,
        whole: TopicTable | None = None,
    ) -> Iterator[tuple[TableRows, NDArray[np.bool_]]]:
        """Rows of the part's time, with the outcome for each.

        Args:
            part: The part.
            fields: Fields to read.
            own: Columns of the table itself.
            whole: All rows of its file, in place of its table.

        Raises:
            UndecidedError: the columns cannot decide.
            StoreError: the table is damaged or missing.
        """
        table = whole or self._table_of(part)
        if table is None:
            raise StoreError(f"The table of {part.topic} is missing.")
        spans = None if part.is_unbounded else [(a, b) for a, b in part.log_windows.tolist()]
        columns = {*own}
        if part.predicate is not None and "_meta.pub" in part.predicate.fields():
            columns.add("pub")
        asks_fields = part.predicate is not None and part.predicate.asks_fields
        if asks_fields and table.unreadable:
            columns.add("state")
        paths = _wanted(table, part, fields)
        size = table.size(paths, own)
        self._counters.bytes_read += int(size * min(part.share * 1.2, 1.0))
        try:
            for rows in table.scan(paths, own=columns, spans=spans):
                yield rows, self._holds(part, rows) & ~rows.is_unreadable()
        except StoreError:
            if whole is None:
                self._reject(part)
            raise

    def _reject(self, part: Part) -> None:
        self._session.reject_table(part.recording, part.topic)

    def _holds(self, part: Part, rows: TableRows) -> NDArray[np.bool_]:
        predicate = part.predicate
        if predicate is None:
            return np.ones(len(rows), np.bool_)
        from hybridlog.query.predicate.to_mask import to_mask

        records: Any = rows.records
        tested = predicate.fields()
        if any(map(is_meta, tested)):
            pub = rows.own.get("pub")
            records = meta_array(records, part.channels[0], rows.t, rows.seq, pub)
        found = to_mask(predicate, part.field_types, records)
        if found is None:
            raise UndecidedError(f"The table of {part.topic} cannot tell.")
        return found


def _are_whole(part: Part, fields: Collection[str] | None, *, arrays: bool) -> bool:
    """True if a table holds these fields in full: no array that may be a summary.

    Args:
        part: The part.
        fields: Paths of the fields; None for all.
        arrays: True if the table has arrays in full, but for those of bytes.
    """
    types = part.field_types
    if types is None:
        return False
    paths = list(types) if fields is None else list(fields)
    for path in paths:
        below = [p for p in types if p == path or p.startswith((f"{path}.", f"{path}["))]
        if not below:
            return False
        for name in below:
            inner = any(other.startswith((f"{name}.", f"{name}[")) for other in types)
            kind, width, element = types[name], width_of(types[name]), element_of(types[name])
            is_short = width is not None and width <= _WHOLE and element in SINGLE
            is_full = arrays and element is not None and (element in _IN_FULL or inner)
            if not (kind in SINGLE or is_short or is_full) and not (inner and element is None):
                return False
    return True


def _paths(table: TopicTable, part: Part) -> set[str]:
    """Columns of the predicate of a part."""
    found: set[str] = set()
    for condition in part.predicate.conditions() if part.predicate is not None else ():
        path = condition.field.names
        if is_meta(condition.field.path):
            continue
        # `ranges.min` is a column of its own, or the least element of an array.
        is_of_some = len(condition.field.parts) > 1 and not isinstance(
            condition.field.parts[-2], str
        )
        while "." in path and not table.has(path, summaries=not is_of_some):
            path = path.rpartition(".")[0]
        found.add(path)
    return found


def _wanted(table: TopicTable, part: Part, fields: Collection[str] | None) -> set[str] | None:
    """Columns to read: those of the predicate and the requested ones; None for all."""
    if fields is None:
        return None
    return {*_paths(table, part), *(path.replace("[]", "") for path in fields)}


def _only(records: pa.StructArray, fields: Collection[str] | None) -> pa.StructArray:
    """The records without the columns that only the predicate needs."""
    if fields is None:
        return records
    return _pruned(records, [path.replace("[]", "").split(".") for path in fields])


def _pruned(records: pa.StructArray, paths: Sequence[Sequence[str]]) -> pa.StructArray:
    import pyarrow as pa

    from hybridlog.schema.arrow_columns import structs

    names, columns = [], []
    for field, column in zip(records.type, records.flatten(), strict=True):
        below = [path[1:] for path in paths if path[0] == field.name]
        if not below:
            continue
        is_whole = any(not path for path in below) or not pa.types.is_struct(field.type)
        names.append(field.name)
        columns.append(column if is_whole else _pruned(column, below))
    if not names:
        return structs({}, len(records))
    return pa.StructArray.from_arrays(columns, names=names)
