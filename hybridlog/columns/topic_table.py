"""The rows of one topic in one or several files, in order of log time and arrival."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct

from hybridlog.columns.column_file import FIRST
from hybridlog.columns.fields import joined, names_of, records_of
from hybridlog.columns.layout import OWN_COLUMNS, POINTS
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import converted
from hybridlog.schema.column import ranges
from hybridlog.schema.states import State
from hybridlog_storage.errors import StoreError
from hybridlog_storage.messages import order_of
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import placed, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.column_file import Leaf, TablePart
    from hybridlog.query.intervals import Span

_MAX_TYPES: Final = 64  # sets of fields whose types are kept for a table


class TableRows(Struct, frozen=True, eq=False):
    """Some messages of a topic, in order.

    Attributes:
        t: int64[n], log times, ns.
        seq: int64[n], arrival numbers.
        own: Columns of the table itself, by name: `pub`, `stamp`, `channel`, `state`,
            `error`, `ref`.
        records: Fields of the messages, a struct each, under their own names. If one array of
            a field is over the limit, all of its arrays are `{n, min, max, mean}`.
    """

    t: NDArray[np.int64]
    seq: NDArray[np.int64]
    own: Mapping[str, Any]
    records: Any

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.t)

    def take(self, rows: NDArray[np.intp]) -> TableRows:
        """The selected rows, in the order given."""
        places = pa.array(rows)
        own = {name: column.take(places) for name, column in self.own.items()}
        return TableRows(self.t[rows], self.seq[rows], own, self.records.take(places))

    def slice(self, begin: int, end: int) -> TableRows:
        """Rows from one index to another."""
        if begin == 0 and end == len(self):
            return self
        own = {name: column.slice(begin, end - begin) for name, column in self.own.items()}
        records = self.records.slice(begin, end - begin)
        return TableRows(self.t[begin:end], self.seq[begin:end], own, records)

    def is_unreadable(self) -> NDArray[np.bool_]:
        """bool[n], True for messages without fields; none if `state` was not read."""
        state = self.own.get("state")
        if state is None:
            return np.zeros(len(self), np.bool_)
        return np.asarray(pc.equal(state, State.UNREADABLE.value).to_numpy(zero_copy_only=False))


class TopicTable:
    """All messages of a topic in the `segments` of a recording that it covers, by number.

    If it `hides_arrays`, only summaries of arrays are in answers: their payloads have expired.
    """

    def __init__(
        self,
        parts: Sequence[TablePart],
        *,
        unreadable: int = 0,
        hides_arrays: bool = False,
        segments: Iterable[int] = (),
    ) -> None:
        self.segments = frozenset(segments)
        self.rows = sum(part.rows for part in parts)
        self.unreadable = unreadable
        self.hides_arrays = hides_arrays
        self.files = list({part.file.number: part.file for part in parts}.values())
        self._parts = parts
        self._types: dict[frozenset[str] | None, Any] = {}
        self._summarised: dict[tuple[str, ...], bool] = {}

    def fields(self, paths: Collection[str] | None = None) -> Any:
        """Type of `TableRows.records` for dotted paths, `[]` optional; None for all.

        It is common to the files. In JSON, integers beside fractions are doubles.
        """
        key = None if paths is None else frozenset(paths)
        if key not in self._types:
            if len(self._types) >= _MAX_TYPES:
                self._types.clear()
            self._types[key] = self._find_type(paths)
        return self._types[key]

    def whole_types(self) -> list[Any]:
        """Types of the messages in each file, with whole arrays."""
        own = OWN_COLUMNS.union(*(file.own for file in self.files))
        schemas = ([f for f in file.schema if f.name not in own] for file in self.files)
        return [records_of(pa.nulls(0, pa.struct(fields))).type for fields in schemas]

    @property
    def has_fields(self) -> bool:
        """True if the messages have any field."""
        return any(not leaf.is_own for file in self.files for leaf in file.leaves)

    @property
    def points(self) -> Any:
        """Type of the column of points that all rows have; None without."""
        if self.hides_arrays or any(POINTS not in file.own for file in self.files):
            return None
        return joined([pa.nulls(0, file.schema.field(POINTS).type) for file in self.files]).type

    def has(self, path: str, *, summaries: bool = True) -> bool:
        """True if every file has the field: an array is a summary in some, a list in others.

        With `summaries` the path may be that of a number of the summary of an array.
        """
        names = names_of(path)

        def is_at(leaf: Leaf) -> bool:
            if (leaf.array or leaf.names)[: len(names)] == names:
                return not leaf.is_own
            return summaries and leaf.names == names and self._is_summarised(names[:-1])

        return all(any(map(is_at, file.leaves)) for file in self.files)

    def size(
        self,
        paths: Collection[str] | None = None,
        own: Collection[str] = (),
    ) -> int:
        """Stored bytes to read for some fields."""
        own = {"t", "seq", *own}
        return sum(
            part.file.size(part.group, numbers)
            for part in self._parts
            for numbers in part.file.choose(paths, own).values()
        )

    def scan(
        self,
        paths: Collection[str] | None = (),
        *,
        own: Collection[str] = (),
        spans: Sequence[Span] | None = None,
    ) -> Iterator[TableRows]:
        """Messages by log time and arrival, one row group at a time.

        A path includes all fields below it; None is all fields. `own` columns come besides log time
        and arrival number. `spans` are disjoint ranges of log time in order, ns; None for all
        times.
        """
        read = partial(self._read, paths, own, self.fields(paths), spans)
        if all(part.first == FIRST for part in self._parts):  # in order, whatever they are
            yield from filter(None, map(read, self._parts))
            return
        held: TableRows | None = None
        for part in self.parts:
            rows = read(part)
            if rows is None:
                continue
            if held is not None:
                end = int(np.searchsorted(held.t, part.first))
                if end:
                    yield held.slice(0, end)
                if end < len(held):
                    rows = _in_order([held.slice(end, len(held)), rows])
            held = rows
        if held is not None:
            yield held

    def _read(
        self,
        paths: Collection[str] | None,
        own: Collection[str],
        kind: Any,
        spans: Sequence[Span] | None,
        part: TablePart,
    ) -> TableRows | None:
        """The rows of a part in some spans; None without any."""
        low, high = span_of(part.first, part.last)
        near = [span for span in spans or () if span[0] < high and span[1] > low]
        if spans is not None and not near:
            return None
        ours, columns = self.columns(part, paths, {"t", "seq", *own})
        t, seq = (ours.pop(name).to_numpy() for name in ("t", "seq"))
        try:
            records = converted(records_of(columns, self._is_summarised), kind)
        except pa.ArrowInvalid as error:  # an integer that no double is, beside fractions
            raise StoreError(f"The tables have no common exact type: {error}.") from error
        rows = TableRows(t, seq, ours, records)
        if spans is not None:
            bounds = np.searchsorted(placed(t), np.array(near, np.int64).reshape(-1, 2))
            rows = rows.take(ranges(bounds[:, 0], bounds[:, 1] - bounds[:, 0]))
        return rows if len(rows) else None

    @property
    def parts(self) -> list[TablePart]:
        """Its row groups, by the log time of their first rows."""
        return sorted(self._parts, key=lambda part: part.first)

    def columns(
        self, part: TablePart, paths: Collection[str] | None, own: Collection[str]
    ) -> tuple[dict[str, Any], Any]:
        """The table's own columns of a row group by name, and those of fields, a struct each."""
        check_wanted()
        chosen = part.file.choose(paths, own)
        columns = {top: _column(part, numbers) for top, numbers in chosen.items()}
        ours = {name: columns.pop(name) for name in own if name in columns}
        if not columns:
            return ours, structs({}, part.rows)
        schema = part.file.schema
        fields = [schema.field(top).with_type(one.type) for top, one in columns.items()]
        return ours, pa.StructArray.from_arrays([*columns.values()], fields=fields)

    def is_cut(self, array: tuple[str, ...]) -> bool:
        """True if an array at a path, or one inside it, may be only a summary in some row."""
        inside = {
            one for file in self.files for one in file.summaries if one[: len(array)] == array
        }
        return any(map(self._is_summarised, inside))

    def _is_summarised(self, array: tuple[str, ...]) -> bool:
        """True if an array may be a summary in some row."""
        if array not in self._summarised:
            self._summarised[array] = self.hides_arrays or any(
                part.file.summarises(part.group, array) for part in self._parts
            )
        return self._summarised[array]

    def _find_type(self, paths: Collection[str] | None) -> Any:
        found = []
        for file in self.files:
            chosen = file.choose(paths, ()).values()
            table = file.read(None, [*chain.from_iterable(chosen)])
            columns = pa.nulls(0, pa.struct([*table.schema]))
            found.append(records_of(columns, self._is_summarised))
        return joined(found).type


def _column(part: TablePart, leaves: Sequence[int]) -> Any:
    return part.file.column(part.group, leaves).slice(part.begin, part.rows)


def _in_order(parts: Sequence[TableRows]) -> TableRows:
    own = {name: pa.concat_arrays([part.own[name] for part in parts]) for name in parts[0].own}
    t, seq = np.concatenate([p.t for p in parts]), np.concatenate([p.seq for p in parts])
    rows = TableRows(t, seq, own, pa.concat_arrays([part.records for part in parts]))
    order = order_of(t, seq)
    return rows if order is None else rows.take(order)
