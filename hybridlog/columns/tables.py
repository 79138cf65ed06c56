"""Reads tables of topics that the catalog confirms.

A table is valid if every segment with rows in it has the catalog's digest, and the number of
rows is the catalog's number of messages. All bytes read are verified by checksum. An invalid
table is ignored, and other engines answer.

A file is opened once for all recordings and topics in it. A recording that is not found is a
reason to look at the folders again.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, chain
from pathlib import Path
from stat import S_ISDIR
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.fields import (
    SUMMARY_FIELDS,
    UnfitError,
    alike,
    has_summaries,
    original_name,
    records_of,
)
from hybridlog.columns.folders import Listing, shared_files
from hybridlog.columns.layout import (
    IN_PARTS,
    IN_TABLES,
    ORIGINAL,
    OWN,
    OWN_COLUMNS,
    SHARED,
    SUFFIX,
    TABLES,
    Section,
    TopicCounts,
    is_of_folder,
    parts_folder,
    table_schema,
    type_prefix,
)
from hybridlog.columns.parquet_file import ParquetFileReader, leaves_of
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import is_list
from hybridlog.schema.column import ranges
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.ordering import order_of
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import placed, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.intervals import Span
    from hybridlog.query.predicate.tree import Node
    from hybridlog_storage.catalog import ChannelEntry, RecordingEntry

MAX_BYTES: Final = 64 << 20
"""Maximum memory of decoded columns."""
_OPEN_FILES: Final = 256
_TYPES: Final = 64  # sets of fields whose types are kept for a file
_MAX_RUNNING: Final = 16  # recordings in progress whose tables are kept open
_MAX_FOUND: Final = 65_536  # tables that are kept
_OWN: Final = frozenset(OWN_COLUMNS)
_FIRST, _LAST = (-(1 << 63), -(1 << 63)), ((1 << 63) - 1, (1 << 63) - 1)

_Key = tuple[int, int]
"""Log time and arrival number: the order of messages."""


@dataclass(frozen=True, slots=True, eq=False)
class TableRows:
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
        return np.asarray(pc.equal(state, "unreadable").to_numpy(zero_copy_only=False))

    def behind(self, key: _Key) -> int:
        """Index of the first row after a log time and arrival number."""
        first, end = (int(np.searchsorted(self.t, key[0], side)) for side in _SIDES)
        return first + int(np.searchsorted(self.seq[first:end], key[1], "right"))


_SIDES: Final[tuple[Any, Any]] = ("left", "right")


class TablePart(NamedTuple):
    """Rows of one topic in a row group, in order.

    Attributes:
        file: The file.
        group: Number of the row group.
        begin: First row of the topic in it.
        rows: Number of its rows.
        first: Key of the first row, or a lower bound of it.
        last: Key of the last row, or an upper bound of it.
    """

    file: ColumnFile
    group: int
    begin: int
    rows: int
    first: _Key
    last: _Key


class _Leaf(NamedTuple):
    """A column in Parquet's order.

    Attributes:
        top: Name of the table's column that contains it.
        is_own: True for a column of the table itself, not of a field.
        names: Names of the fields on the path to it.
        array: Names of the fields on the path to the array whose summary it is part of.
    """

    top: str
    is_own: bool
    names: tuple[str, ...]
    array: tuple[str, ...] | None = None


class ColumnFile(ParquetFileReader):
    """A file of tables, and what is known of its columns."""

    @lazy
    def leaves(self) -> list[_Leaf]:
        """Its columns in Parquet's order."""
        return [leaf for top in self.schema for leaf in _leaves(top)]

    @lazy
    def summaries(self) -> dict[tuple[str, ...], int]:
        """Paths of arrays with summaries, and the number of a column of each."""
        return {leaf.array: n for n, leaf in enumerate(self.leaves) if leaf.array is not None}

    @lazy
    def paths(self) -> set[tuple[str, ...]]:
        """Paths of fields that the messages have."""
        names = [leaf.array or leaf.names for leaf in self.leaves if not leaf.is_own]
        return {path[:end] for path in names for end in range(1, len(path) + 1)}

    @lazy
    def summary_paths(self) -> set[tuple[str, ...]]:
        """Paths of the numbers of summaries."""
        return {leaf.names for leaf in self.leaves if leaf.array is not None}

    @lazy
    def sizes(self) -> dict[tuple[Any, ...], int]:
        """Stored bytes of columns that were asked about."""
        return {}

    def stored(self, group: int, paths: Collection[str] | None, own: Collection[str]) -> int:
        """Stored bytes of some fields in a row group."""
        key = group, None if paths is None else frozenset(paths), frozenset(own)
        found = self.sizes.get(key)
        if found is None:
            if len(self.sizes) >= _TYPES:
                self.sizes.clear()
            found = self.sizes[key] = self.size(group, self.choose(paths, own))
        return found

    @lazy
    def chosen(self) -> dict[tuple[Any, Any], list[int]]:
        """Numbers of columns that were chosen, by fields and columns of ours."""
        return {}

    def choose(self, paths: Collection[str] | None, own: Collection[str]) -> list[int]:
        """Numbers of the columns for some fields."""
        key = None if paths is None else frozenset(paths), frozenset(own)
        found = self.chosen.get(key)
        if found is None:
            wanted = None if paths is None else list(map(_names, paths))
            found = [
                number
                for number, leaf in enumerate(self.leaves)
                if (leaf.top in own if leaf.is_own else self._is_wanted(leaf, wanted))
            ]
            # A summary tells whether the array is there.
            known = {self.leaves[number].array for number in found}
            for array, number in self.summaries.items():
                if array not in known and any(p[: len(array)] == array for p in wanted or ()):
                    found.append(number)
            found.sort()
            if len(self.chosen) >= _TYPES:
                self.chosen.clear()
            self.chosen[key] = found
        return found

    def _is_wanted(self, leaf: _Leaf, wanted: Sequence[tuple[str, ...]] | None) -> bool:
        if wanted is None or any(leaf.names[: len(path)] == path for path in wanted):
            return True
        # A summary is worked out from the array where that is there.
        return any(
            leaf.names[: len(path) - 1] == path[:-1] and path[:-1] in self.summaries
            for path in wanted
            if leaf.array is None and path[-1] in SUMMARY_FIELDS
        )

    def sections(self) -> Iterator[tuple[int, Section]]:
        """The recordings in it, each with its first row."""
        before = 0
        for section in self.about.recordings:
            yield before, section
            before += section.rows

    def parts(self, begin: int, rows: int) -> Iterator[TablePart]:
        """Row groups with some rows of one topic."""
        before = 0
        for group, (count, *keys) in enumerate(self.about.bounds):
            low, high = max(begin, before), min(begin + rows, before + count)
            if low < high:
                is_known = any(keys)
                first = (keys[0], keys[1]) if is_known else _FIRST
                last = (keys[2], keys[3]) if is_known else _LAST
                yield TablePart(self, group, low - before, high - low, first, last)
            before += count

    @lazy
    def counts(self) -> TopicCounts:
        """Counts of all its rows."""
        topics = [section.topics.values() for section in self.about.recordings]
        return TopicCounts(
            *np.array([*chain(*topics)], np.int64).reshape(-1, 3).sum(axis=0).tolist()
        )

    def all_parts(self) -> list[TablePart]:
        """All rows, as if they were of one topic."""
        return [
            TablePart(self, group, 0, bound[0], _FIRST, _LAST)
            for group, bound in enumerate(self.about.bounds)
        ]


class TopicTable:
    """All messages of a topic in a recording.

    Args:
        topic: Full name.
        parts: Its rows.
        counts: Numbers of its rows.
        cache: Cache of decoded columns.

    Attributes:
        topic: Full name.
        rows: Number of messages.
        unreadable: Messages without fields, because they do not fit their definition.
        reduced: Messages without fields, because they were reduced under pressure.
        files: The files with its rows.
    """

    def __init__(
        self, topic: str, parts: Sequence[TablePart], counts: TopicCounts, cache: _Cache
    ) -> None:
        self.topic = topic
        self.rows, self.unreadable, self.reduced = counts
        self.files = list({part.file.number: part.file for part in parts}.values())
        self._cache = cache
        self._parts = parts
        self._types: dict[frozenset[str] | None, Any] = {}
        self._summarised: dict[tuple[str, ...], bool] = {}

    @lazy
    def _runs(self) -> list[list[TablePart]]:
        return list(_runs(self._parts))

    def fields(self, paths: Collection[str] | None = None) -> Any:
        """Type of `TableRows.records`.

        Args:
            paths: Dotted paths of fields, with or without empty brackets; None for all.

        Raises:
            UnfitError: the files have no common type.
        """
        return self.empty(paths).type

    @property
    def has_fields(self) -> bool:
        """True if the messages have any field."""
        return any(not leaf.is_own for file in self.files for leaf in file.leaves)

    def has(self, path: str) -> bool:
        """True if every file has the field: an array is a summary in some, a list in others."""
        names = _names(path)
        return all(
            names in file.paths or (names in file.summary_paths and self._is_summarised(names[:-1]))
            for file in self.files
        )

    def size(
        self,
        paths: Collection[str] | None = None,
        own: Collection[str] = (),
        where: Node | None = None,
    ) -> int:
        """Stored bytes to read for some fields.

        Args:
            paths: As for `fields`.
            own: Columns of the table itself.
            where: As for `scan`.
        """
        own = {"t", "seq", *own}
        return sum(
            part.file.stored(part.group, paths, own)
            for part in self._parts
            if self.may_hold(part, where)
        )

    def scan(
        self,
        paths: Collection[str] | None = (),
        *,
        own: Collection[str] = (),
        spans: Sequence[Span] | None = None,
        where: Node | None = None,
        every: bool = True,
    ) -> Iterator[TableRows]:
        """Messages by log time and arrival, one row group at a time.

        Args:
            paths: Dotted paths of fields, including all fields below them; None for all.
            own: Columns of the table itself besides log time and arrival number.
            spans: Ranges of log time, ns, disjoint, in order; None for all times.
            where: A predicate. Row groups in which it holds for no row have null fields.
            every: False to leave such row groups out.

        Raises:
            StoreError: the data read is damaged.
        """
        kind = self.empty(paths)
        runs = [[p for p in run if every or self.may_hold(p, where)] for run in self._runs]

        def read(part: TablePart) -> TableRows:
            return self._read(part, paths, own, kind, where)

        streams = [self._read_run(run, spans, read) for run in runs]
        return streams[0] if len(streams) == 1 else _merged(streams)

    def _read_run(
        self,
        run: Sequence[TablePart],
        spans: Sequence[Span] | None,
        read: Callable[[TablePart], TableRows],
    ) -> Iterator[TableRows]:
        for part in run:
            if spans is None:
                yield read(part)
                continue
            low, high = span_of(part.first[0], part.last[0])
            near = [span for span in spans if span[0] < high and span[1] > low]
            if not near:
                continue
            rows = read(part)
            bounds = np.searchsorted(placed(rows.t), np.array(near, np.int64).reshape(-1, 2))
            begins, counts = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
            if len(near) == 1:
                rows = rows.slice(int(bounds[0, 0]), int(bounds[0, 1]))
            else:
                rows = rows.take(ranges(begins, counts))
            if len(rows):
                yield rows

    def _read(
        self,
        part: TablePart,
        paths: Collection[str] | None,
        own: Collection[str],
        kind: Any,
        where: Node | None,
    ) -> TableRows:
        is_excluded = not self.may_hold(part, where)
        ours, records = self.read(part, () if is_excluded else paths, {"t", "seq", *own})
        t, seq = (ours.pop(name).to_numpy() for name in ("t", "seq"))
        if is_excluded:
            nulls = {field.name: pa.nulls(len(t), field.type) for field in kind.type}
            return TableRows(t, seq, ours, structs(nulls, len(t)))
        return TableRows(t, seq, ours, self._fitted(records, kind))

    def _fitted(self, records: Any, kind: Any) -> Any:
        """Fields of a row group in the type of all."""
        return alike([kind, records], by_type=True)[1]

    @property
    def parts(self) -> list[TablePart]:
        """Its row groups, by the log time of their first rows."""
        return sorted((part for run in self._runs for part in run), key=lambda part: part.first)

    def read(
        self, part: TablePart, paths: Collection[str] | None, own: Collection[str]
    ) -> tuple[dict[str, Any], Any]:
        """Columns of one row group.

        Args:
            part: One of `parts`.
            paths: As for `fields`.
            own: Columns of the table itself.

        Returns:
            The table's own columns by name, and the fields as for `TableRows.records`, in
            the types of the file.

        Raises:
            StoreError: the data read is damaged.
        """
        check_wanted()
        leaves = part.file.leaves
        by_top: dict[str, list[int]] = {}
        for number in part.file.choose(paths, own):
            by_top.setdefault(leaves[number].top, []).append(number)
        columns = {top: self._column(part, top, numbers) for top, numbers in by_top.items()}
        ours = {name: columns.pop(name) for name in own if name in columns}
        named = [part.file.schema.field(top) for top in columns]
        return ours, self._records(list(columns.values()), named, part.rows)

    def _column(self, part: TablePart, top: str, leaves: Sequence[int]) -> Any:
        column = self._cache.get(part.file, part.group, top, tuple(leaves))
        return column.slice(part.begin, part.rows)

    def _records(self, columns: list[Any], named: Sequence[Any], rows: int) -> Any:
        """Columns as fields of messages, under their own names."""
        if not columns:
            return structs({}, rows)
        pairs = zip(named, columns, strict=True)
        fields = [field.with_type(column.type) for field, column in pairs]
        array = pa.StructArray.from_arrays(columns, fields=fields)
        return records_of(array, self._is_summarised)

    def _is_summarised(self, array: tuple[str, ...]) -> bool:
        """True if an array is over the limit in some row."""
        if array not in self._summarised:
            self._summarised[array] = any(self._has_summary(part, array) for part in self._parts)
        return self._summarised[array]

    def _has_summary(self, part: TablePart, array: tuple[str, ...]) -> bool:
        leaf = part.file.summaries.get(array)
        if leaf is None:
            return False
        nulls = part.file.nulls(part.group, leaf)
        if nulls is not None and nulls == part.file.values(part.group, leaf):
            return False
        top = part.file.leaves[leaf].top
        column = self._column(part, top, [leaf])
        return _has_values(column)

    def empty(self, paths: Collection[str] | None) -> Any:
        """An empty array with the common type of the rows of all files.

        Raises:
            UnfitError: the files have no common type.
        """
        key = None if paths is None else frozenset(paths)
        if key not in self._types:
            if len(self._types) >= _TYPES:
                self._types.clear()
            self._types[key] = self._find_type(paths)
        return self._types[key]

    def _find_type(self, paths: Collection[str] | None) -> Any:
        found = []
        for file in self.files:
            leaves = [file.leaves[number] for number in file.choose(paths, ())]
            chosen = {(leaf.top, leaf.names) for leaf in leaves}
            tops = list(dict.fromkeys(leaf.top for leaf in leaves))
            fields = [_only(file.schema.field(top), chosen, (), top) for top in tops]
            kept = [field for field in fields if field is not None]
            columns = [pa.nulls(0, field.type) for field in kept]
            found.append(self._records(columns, kept, 0))
        first = alike(found, by_type=True)[0]
        return first.slice(0, 0)

    def may_hold(self, part: TablePart, where: Node | None) -> bool:
        """False if a predicate holds for no row of a row group."""
        return True


class _Cache:
    """A cache of the most recently used decoded columns. Thread safe."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self._columns: OrderedDict[tuple[int, int, str, tuple[int, ...]], Any] = OrderedDict()
        self._open: OrderedDict[int, ColumnFile] = OrderedDict()
        self._size = 0
        self._lock = threading.Lock()

    def get(self, file: ColumnFile, group: int, top: str, leaves: tuple[int, ...]) -> Any:
        """A column of a row group, or the requested parts of it."""
        key = file.number, group, top, leaves
        with self._lock:
            if key in self._columns:
                self._columns.move_to_end(key)
                return self._columns[key]
        self.opened(file)
        column = file.read(group, leaves).column(0).combine_chunks()
        if isinstance(column, pa.ChunkedArray):
            column = pa.concat_arrays(column.chunks)
        with self._lock:
            if key not in self._columns and column.nbytes <= self.most_bytes:
                self._columns[key] = column
                self._size += column.nbytes
                while self._size > self.most_bytes:
                    self._size -= self._columns.popitem(last=False)[1].nbytes
        return column

    def opened(self, file: ColumnFile) -> None:
        """Close files that were not read lately, if too many are open."""
        with self._lock:
            self._open[file.number] = file
            self._open.move_to_end(file.number)
            while len(self._open) > files.most_open(_OPEN_FILES):
                self._open.popitem(last=False)[1].release()

    def clear(self) -> None:
        with self._lock:
            self._columns.clear()
            self._open.clear()
            self._size = 0


@dataclass(frozen=True)
class _Rows:
    """The rows of a recording in a file.

    Attributes:
        file: The file.
        begin: Its first row.
        section: Digests and topics.
    """

    file: ColumnFile
    begin: int
    section: Section

    @lazy
    def _begins(self) -> dict[str, int]:
        """First row of each topic."""
        rows = (counts.rows for counts in self.section.topics.values())
        return dict(zip(self.section.topics, accumulate(rows, initial=self.begin), strict=False))

    def of(self, topic: str) -> Iterator[TablePart]:
        """The rows of a topic."""
        return self.file.parts(self._begins[topic], self.section.topics[topic].rows)


class _Folder:
    """The files of a folder.

    Args:
        path: The folder.
        depth: Parts of its path that lie inside the store.
        cache: Knows the open files.
    """

    def __init__(self, path: Path, depth: int, cache: _Cache) -> None:
        self._path = path
        self._depth = depth
        self._cache = cache
        self._listing = Listing(path, depth)
        self._shared: list[str] = []
        self._own: dict[str, list[str]] = {}  # files of long topics, by recording
        self._listed: Mapping[str, Collection[str]] = {}
        self._files: dict[str, tuple[tuple[int, int, int], ColumnFile | None]] = {}
        self._rows: dict[str, list[_Rows]] = {}

    @property
    def damaged(self) -> list[str]:
        """Files that were looked at and cannot be read."""
        return [str(self._path / name) for name, (_, file) in self._files.items() if file is None]

    def rows(self, recording: str) -> list[_Rows]:
        """The rows of a recording in the files that were looked at."""
        return self._rows.get(recording, [])

    def look(self, recording: str, *, everywhere: bool) -> None:
        """Open files that may have rows of a recording, if they are new or were replaced.

        Args:
            recording: Id of the recording.
            everywhere: True for all shared files, False for those that are listed for it.
        """
        self._look()
        listed = self._shared if everywhere else self._listed.get(recording, ())
        for name in (*self._own.get(recording, ()), *sorted(listed)):
            self._open(name)

    def look_at_all(self) -> None:
        """Open all files that are new or were replaced."""
        self._look()
        for name in sorted(self._listing.names):
            if name.endswith(SUFFIX):
                self._open(name)

    def _look(self) -> None:
        """Look which files there are, and drop those that were replaced."""
        if not self._listing.look():
            return
        names = self._listing.names
        before = self._files
        self._files = {
            name: known
            for name, known in before.items()
            if name in names and known[0] == _identity(names[name])
        }
        if len(self._files) < len(before):
            self._rows = {}
            for _, file in self._files.values():
                self._add(file)
        tables = sorted(name for name in names if name.endswith(SUFFIX))
        self._shared = [name for name in tables if name.startswith(SHARED)]
        self._own = {}
        for name in tables:
            self._own.setdefault(name.rpartition("-")[0], []).append(name)
        root, folder = self._path.parent.parent, self._path.name
        self._listed = shared_files(root, folder) if self._shared else {}

    def _open(self, name: str) -> None:
        status = self._listing.names.get(name)
        if name in self._files or status is None:
            return
        file: ColumnFile | None = None
        with suppress(FileNotFoundError, StoreError):
            file = ColumnFile(self._path / name, depth=self._depth + 1)
            self._cache.opened(file)
        if file is not None and not is_of_folder(self._path.name, file.schema):
            file = None
        self._files[name] = _identity(status), file
        self._add(file)

    def _add(self, file: ColumnFile | None) -> None:
        if file is not None:
            for begin, section in file.sections():
                self._rows.setdefault(section.id, []).append(_Rows(file, begin, section))


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_ino, status.st_size, status.st_mtime_ns


class _Folders:
    """The folders in one place.

    Args:
        place: Where they are.
        depth: Parts of its path that lie inside the store.
        cache: Knows the open files.
    """

    def __init__(self, place: Path, depth: int, cache: _Cache) -> None:
        self._place = place
        self._depth = depth
        self._cache = cache
        self._listing = Listing(place, depth)
        self._known: dict[str, _Folder] = {}
        self._by_type: dict[str, list[_Folder]] = {}

    def look(self) -> None:
        """Look which folders there are."""
        if not self._listing.look():
            return
        before = self._known
        self._known = {
            name: before.get(name) or _Folder(self._place / name, self._depth + 1, self._cache)
            for name, about in sorted(self._listing.names.items())
            if S_ISDIR(about.st_mode)
        }
        self._by_type = {}

    def of(self, types: Iterable[str]) -> list[_Folder]:
        """The folders of some message types."""
        found: list[_Folder] = []
        for one in types:
            if one not in self._by_type:
                prefix = type_prefix(one)
                folders = self._known.items()
                self._by_type[one] = [own for name, own in folders if name.startswith(prefix)]
            found += self._by_type[one]
        return found


class Tables:
    """The tables of a store. Thread safe.

    Args:
        root: The store.
        most_bytes: Maximum memory of decoded columns.
    """

    def __init__(self, root: Path, *, most_bytes: int = MAX_BYTES) -> None:
        self._root = root
        self._cache = _Cache(most_bytes)
        self._found: OrderedDict[tuple[str, str], TopicTable | None] = OrderedDict()
        self._folders = _Folders(root / TABLES, IN_TABLES - 1, self._cache)
        self._looked_at: set[str] = set()  # types whose folders were looked at
        self._sealed: OrderedDict[str, _Folders] = OrderedDict()
        self._channels: tuple[RecordingEntry, dict[str, list[ChannelEntry]]] | None = None
        self._generation = 0
        self._lock = threading.RLock()

    @property
    def cache(self) -> _Cache:
        """The cache of decoded columns, for tables that are not in `tables/`."""
        return self._cache

    def invalidate(self) -> None:
        """Forget all files, columns and invalid tables."""
        with self._lock:
            self._generation += 1
            self._found.clear()
            self._looked_at.clear()
            self._folders = _Folders(self._root / TABLES, IN_TABLES - 1, self._cache)
            self._sealed.clear()
            self._channels = None
        self._cache.clear()

    def of(self, recording: RecordingEntry, topic: str) -> TopicTable | None:
        """The table of a topic in a recording; None without one that the catalog confirms.

        Args:
            recording: The recording's entry in the catalog.
            topic: Full name.
        """
        key = recording.id, topic
        with self._lock:
            generation = self._generation
            if key in self._found:
                return self._found[key]
        found = None
        with suppress(FileNotFoundError, StoreError):
            found = self.check(recording, topic)
        self._remember(key, found, generation)
        return found

    def look_again(self) -> None:
        """Look for all tables again; files that are as before stay open."""
        with self._lock:
            self._generation += 1
            self._found.clear()
            self._looked_at.clear()

    def forget(self, recording: RecordingEntry, topics: Collection[str]) -> None:
        """Look for tables of a recording again."""
        with self._lock:
            for topic in topics:
                self._found.pop((recording.id, topic), None)
            types = {channel.type for channel in recording.channels if channel.topic in topics}
            self._looked_at -= types

    def reject(self, recording: RecordingEntry, topic: str) -> None:
        """Ignore the table from now on, because it was found to be damaged."""
        self._remember((recording.id, topic), None, self._generation)

    def _remember(self, key: tuple[str, str], found: TopicTable | None, generation: int) -> None:
        with self._lock:
            if generation == self._generation:
                self._found[key] = found
                while len(self._found) > _MAX_FOUND:
                    self._found.popitem(last=False)

    def whole(self, file: ColumnFile) -> TopicTable:
        """All rows of a file, as if they were of one topic."""
        return TopicTable("", file.all_parts(), file.counts, self._cache)

    def check(self, recording: RecordingEntry, topic: str) -> TopicTable:
        """The table of a topic in a recording.

        Raises:
            FileNotFoundError: no table of these segments exists.
            StoreError: the table is damaged, or has another number of rows.
        """
        channels = self._channels_of(recording, topic)
        if recording.status == "open" or not has_one_definition(channels):
            raise FileNotFoundError
        rows, damaged = self._rows_of(recording, topic, channels)
        table = self._table(recording, topic, rows)
        if table is None:
            if damaged:
                raise StoreError(f"The table {damaged[0]} is damaged.")
            raise FileNotFoundError
        messages = sum(channel.stats.messages for channel in channels)
        if table.rows != messages:
            raise StoreError(
                f"The tables of {topic} have {table.rows} messages, the segments {messages}."
            )
        return table

    def has_all(self, recording: RecordingEntry, topic: str) -> bool:
        """True if files have all messages of a topic, whatever their definitions are."""
        channels = self._channels_of(recording, topic)
        try:
            rows, _ = self._rows_of(recording, topic, channels)
        except StoreError:
            return False
        own = [one.section for one in rows if topic in one.section.topics]
        messages = sum(channel.stats.messages for channel in channels)
        return (
            all(one.segments.items() <= recording.digests.items() for one in own)
            and sum(one.topics[topic].rows for one in own) == messages
        )

    def _rows_of(
        self, recording: RecordingEntry, topic: str, channels: Sequence[ChannelEntry]
    ) -> tuple[list[_Rows], list[str]]:
        """The rows of a recording in the folders of a topic, and damaged files there.

        Shared files that are not listed for it are opened only if rows are missing otherwise.
        """
        types = {channel.type for channel in channels}
        messages = sum(channel.stats.messages for channel in channels)
        rows: list[_Rows] = []
        with self._lock:
            if types <= self._looked_at:
                rows = self._known_rows(recording, types)
            for everywhere in (False, True):
                if sum(_rows_in(one.section, topic) for one in rows) == messages:
                    break
                self._folders.look()
                for folder in self._folders.of(types):
                    folder.look(recording.id, everywhere=everywhere)
                self._looked_at |= types
                rows = self._known_rows(recording, types)
            return rows, [path for folder in self._folders.of(types) for path in folder.damaged]

    def _known_rows(self, recording: RecordingEntry, types: Collection[str]) -> list[_Rows]:
        return [rows for one in self._folders.of(types) for rows in one.rows(recording.id)]

    def _table(
        self, recording: RecordingEntry, topic: str, found: Sequence[_Rows]
    ) -> TopicTable | None:
        """The table of a topic from some files; None without rows of it, or with stale ones.

        Raises:
            StoreError: its files do not fit together.
        """
        own = [rows for rows in found if topic in rows.section.topics]
        if not own:
            return None
        counts = TopicCounts(0)
        parts: list[TablePart] = []
        for rows in own:
            if not rows.section.segments.items() <= recording.digests.items():
                return None
            counts = counts.plus(rows.section.topics[topic])
            parts += rows.of(topic)
        table = TopicTable(topic, parts, counts, self._cache)
        if len(table.files) > 1:
            try:
                table.fields()
            except UnfitError as error:
                raise StoreError(f"The tables of {topic} have no common type: {error}.") from error
        return table

    def of_sealed(
        self, recording: RecordingEntry, topic: str, messages: Mapping[int, int]
    ) -> tuple[TopicTable, frozenset[int]] | None:
        """The table of some sealed segments of a recording that is being written.

        Args:
            recording: The recording's entry in the catalog.
            topic: Full name.
            messages: Number of messages of the topic by sealed segment.

        Returns:
            The table, and the segments of which it has all rows; None without a valid one.
        """
        channels = self._channels_of(recording, topic)
        if not has_one_definition(channels):
            return None
        with self._lock:
            place = parts_folder(self._root, recording.id)
            known = self._sealed.setdefault(
                recording.id, _Folders(place, IN_PARTS - 2, self._cache)
            )
            known.look()
            folders = known.of({channel.type for channel in channels})
            for folder in folders:
                folder.look_at_all()
            rows = [rows for folder in folders for rows in folder.rows(recording.id)]
            while len(self._sealed) > _MAX_RUNNING:
                self._sealed.popitem(last=False)
        try:
            table = self._table(recording, topic, rows)
        except StoreError:
            return None
        own = [one.section for one in rows if topic in one.section.topics]
        segments = frozenset(int(number) for section in own for number in section.segments)
        if table is None or table.rows != sum(messages.get(number, 0) for number in segments):
            return None  # its files are just getting their names
        return table, segments

    def _channels_of(self, recording: RecordingEntry, topic: str) -> list[ChannelEntry]:
        """The channels of a topic; those of the recording asked about last are at hand."""
        found = self._channels
        if found is None or found[0] is not recording:
            by_topic: dict[str, list[ChannelEntry]] = defaultdict(list)
            for channel in recording.channels:
                by_topic[channel.topic].append(channel)
            found = self._channels = recording, dict(by_topic)
        return found[1].get(topic, [])


def _rows_in(section: Section, topic: str) -> int:
    counts = section.topics.get(topic)
    return 0 if counts is None else counts.rows


def has_one_definition(channels: Sequence[ChannelEntry]) -> bool:
    """True if the messages of some channels have one definition: only then do tables answer."""
    found = {
        table_schema(channel.message_encoding, channel.schema, channel.metadata)
        for channel in channels
        if channel.stats.messages
    }
    return len(found) == 1


def _has_values(column: Any) -> bool:
    """True if a value inside a column is not null."""
    if pa.types.is_struct(column.type):
        return any(map(_has_values, column.flatten()))
    if is_list(column.type):
        return _has_values(column.flatten())
    return bool(column.null_count < len(column))


def _runs(parts: Sequence[TablePart]) -> Iterator[list[TablePart]]:
    """Row groups in as few ordered sequences as possible."""
    if all(part.first == _FIRST for part in parts):
        yield list(parts)  # of a file in which the topic's rows are in order
        return
    runs: list[list[TablePart]] = []
    for part in sorted(parts, key=lambda part: part.first):
        for run in runs:
            if run[-1].last < part.first:
                run.append(part)
                break
        else:
            runs.append([part])
    yield from runs


def _merged(streams: Sequence[Iterator[TableRows]]) -> Iterator[TableRows]:
    """Rows of several ordered sequences, merged in order."""
    heads: list[tuple[TableRows, Iterator[TableRows]]] = []
    for stream in streams:
        head = next(stream, None)
        if head is not None:
            heads.append((head, stream))
    while heads:
        key = min((int(rows.t[-1]), int(rows.seq[-1])) for rows, _ in heads)
        ready, left = [], []
        for rows, stream in heads:
            end = rows.behind(key)
            if end:
                ready.append(rows.slice(0, end))
            rest = rows.slice(end, len(rows)) if end < len(rows) else next(stream, None)
            if rest is not None:
                left.append((rest, stream))
        heads = left
        yield _in_order(ready)


def _in_order(parts: Sequence[TableRows]) -> TableRows:
    if len(parts) == 1:
        return parts[0]
    own = {name: pa.concat_arrays([part.own[name] for part in parts]) for name in parts[0].own}
    t, seq = np.concatenate([p.t for p in parts]), np.concatenate([p.seq for p in parts])
    rows = TableRows(t, seq, own, pa.concat_arrays([part.records for part in parts]))
    order = order_of(t, seq)
    return rows if order is None else rows.take(order)


def _leaves(top: Any) -> Iterator[_Leaf]:
    if top.name in _OWN or OWN in (top.metadata or {}):
        for names, _ in leaves_of(pa.schema([top])):
            yield _Leaf(top.name, True, names)
        return
    for names, array in _inner_leaves(top, ()):
        yield _Leaf(top.name, False, names, array)


def _inner_leaves(
    field: Any, above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], tuple[str, ...] | None]]:
    """Paths of the leaves of a column, and of the array whose summary it is."""
    names = (*above, original_name(field))
    kind = field.type
    while is_list(kind):
        kind = kind.value_type
    if not pa.types.is_struct(kind):
        yield names, None
        return
    for number in range(kind.num_fields):
        for inner, array in _inner_leaves(kind.field(number), names):
            yield inner, names if has_summaries(field) else array


def _only(
    field: Any, chosen: Collection[tuple[str, tuple[str, ...]]], above: tuple[str, ...], top: str
) -> Any | None:
    """A column with only the chosen parts; None if no part is chosen."""
    names = (*above, original_name(field))
    kind = field.type
    if pa.types.is_struct(kind):
        inner = [_only(kind.field(n), chosen, names, top) for n in range(kind.num_fields)]
        kept = [part for part in inner if part is not None]
        return field.with_type(pa.struct(kept)) if kept else None
    if is_list(kind):
        # The elements have no name of their own.
        element = kind.value_field.with_metadata({ORIGINAL: names[-1]})
        value = _only(element, chosen, above, top)
        if value is None:
            return None
        value = kind.value_field.with_type(value.type)
        if pa.types.is_fixed_size_list(kind):
            return field.with_type(pa.list_(value, kind.list_size))
        large = pa.types.is_large_list(kind)
        return field.with_type(pa.large_list(value) if large else pa.list_(value))
    return field if (top, names) in chosen else None


def _names(path: str) -> tuple[str, ...]:
    return tuple(path.replace("[]", "").split("."))
