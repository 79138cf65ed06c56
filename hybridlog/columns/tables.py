"""Reads tables of topics that the catalog confirms.

A table is valid if every segment with rows in it has the catalog's digest, and the number of
rows is the catalog's number of messages. All bytes read are verified by checksum. An invalid
table is ignored, and chunks answer.

A file is opened once for all recordings and topics in it. A recording that is not found is a
reason to look at the folders again.
"""

from __future__ import annotations

import os
import threading
import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path
from stat import S_ISDIR
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct

from hybridlog.columns.column_file import FIRST, ColumnFile, TablePart
from hybridlog.columns.fields import joined, names_of, records_of
from hybridlog.columns.folders import shared_for, shared_times
from hybridlog.columns.layout import (
    OWN_COLUMNS,
    POINTS,
    SUFFIX,
    TABLES,
    Section,
    parts_folder,
    type_prefix,
)
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import converted
from hybridlog.schema.column import ranges
from hybridlog.schema.states import State, encoding_of
from hybridlog_storage.cache import Cache
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError, unreadable
from hybridlog_storage.messages import EXPIRED_IDS, MARKS_CHANNEL, order_of
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import placed, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.column_file import Leaf, TablePart
    from hybridlog.query.intervals import Span
    from hybridlog_storage.catalog import ChannelEntry, RecordingEntry


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
    """All messages of a topic in the `segments` of a recording that it covers, by number."""

    def __init__(
        self,
        parts: Sequence[TablePart],
        *,
        unreadable: int = 0,
        segments: Iterable[int] = (),
    ) -> None:
        self.segments = frozenset(segments)
        self.rows = sum(part.rows for part in parts)
        self.unreadable = unreadable
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
        if any(POINTS not in file.own for file in self.files):
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
            self._summarised[array] = any(
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


_MAX_RUNNING: Final = 16  # recordings in progress whose tables are kept open
_MAX_FOUND: Final = 65_536  # tables that are kept
_STABLE_NS: Final = 100_000_000  # a time of change that is older tells of every later change


class TopicRows(NamedTuple):
    """The rows of a topic of a recording in a file."""

    file: ColumnFile
    begin: int
    section: Section

    def is_of(self, recording: RecordingEntry) -> bool:
        """True if they are of segments that the catalog confirms."""
        return self.section.segments.items() <= recording.digests.items()


class _Listing:
    """Status of a folder's entries by name, read again after a change; none without the folder."""

    def __init__(self, path: Path, cache: Cache) -> None:
        self.names: dict[str, os.stat_result] = {}
        self._path = path
        self._cache = cache
        self._read_at: tuple[int, int] | None = None  # inode, and time of its last change

    def read(self) -> bool:
        """Read the entries if they may have changed; returns whether it did."""
        try:
            now, names = files.changed_names(self._path, self._read_at)
            if names is None:
                return False
            self.names = names
        except FileNotFoundError:
            self.names, self._read_at = {}, None
            return True
        except OSError as error:
            raise unreadable(error, self._path) from error
        # A change within the same tick of the clock would have the same time.
        self._read_at = now if time.time_ns() - now[1] > _STABLE_NS else None
        return True


class _Folder(_Listing):
    """The files of a folder."""

    def __init__(self, path: Path, cache: Cache) -> None:
        super().__init__(path, cache)
        self._shared: list[int] = []  # numbers in the names of shared files
        self._own: dict[str, list[str]] = {}  # files of long topics, by recording
        self._files: dict[str, tuple[tuple[int, int, int], ColumnFile | None]] = {}
        self.rows: dict[tuple[str, str], list[TopicRows]] = {}
        """The rows in the files that were looked at, by recording and topic."""

    @property
    def damaged(self) -> list[str]:
        """Files that were looked at and cannot be read."""
        return [str(self._path / name) for name, (_, file) in self._files.items() if file is None]

    def look(self, recording: RecordingEntry) -> None:
        """Open files that may have rows of a recording, if they are new or replaced."""
        if self.read():
            self._drop_replaced()
        for name in self._own.get(recording.id, []):
            self._open(name)
        for name in shared_for(self._shared, recording.created):
            file = self._open(name)
            if file is not None and file.about.has(recording.id):
                break

    def _drop_replaced(self) -> None:
        before, self._files, self.rows, self._own = self._files, {}, {}, {}
        tables = sorted(name for name in self.names if name.endswith(SUFFIX))
        self._shared = shared_times(tables)
        for name in tables:
            self._own.setdefault(name.rpartition("-")[0], []).append(name)
            identity = _identity(self.names[name])
            if name in before and before[name][0] == identity:
                self._add(name, *before[name])

    def _open(self, name: str) -> ColumnFile | None:
        """A file, if there is one that can be read."""
        status = self.names.get(name)
        if name in self._files or status is None:
            return self._files[name][1] if status is not None else None
        try:
            file: ColumnFile | None = ColumnFile(self._path / name, self._cache)
        except FileNotFoundError:
            return None
        except StoreError:
            file = None
        self._add(name, _identity(status), file)
        return file

    def _add(self, name: str, identity: tuple[int, int, int], file: ColumnFile | None) -> None:
        self._files[name] = identity, file
        if file is not None:
            for begin, section in file.sections():
                rows = TopicRows(file, begin, section)
                self.rows.setdefault((section.id, section.topic), []).append(rows)


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_ino, status.st_size, status.st_mtime_ns


class _Folders(_Listing):
    """The folders in one place."""

    def __init__(self, path: Path, cache: Cache) -> None:
        super().__init__(path, cache)
        self._known: dict[str, dict[str, _Folder]] = {}  # by the beginning of their names

    def look(self) -> None:
        """Look which folders there are."""
        if not self.read():
            return
        before, self._known = self._known, {}
        for name, about in sorted(self.names.items()):
            if S_ISDIR(about.st_mode):
                begin = f"{name.rpartition('~')[0]}~"
                folder = before.get(begin, {}).get(name)
                folder = folder or _Folder(self._path / name, self._cache)
                self._known.setdefault(begin, {})[name] = folder

    def of(self, types: Iterable[str]) -> list[_Folder]:
        """The folders of some message types."""
        return [f for one in types for f in self._known.get(type_prefix(one), {}).values()]


class Tables:
    """The tables of a store. Thread safe."""

    def __init__(self, root: Path, cache: Cache | None = None) -> None:
        self._root = root
        self._cache = cache or Cache()
        self._found: dict[tuple[str, str], TopicTable | None] = {}
        self._folders = _Folders(root / TABLES, self._cache)
        self._looked_at: set[str] = set()  # types whose folders were looked at
        self._sealed: dict[str, _Folders] = {}  # of recordings in progress
        self._channels: tuple[RecordingEntry, dict[str, list[ChannelEntry]]] | None = None
        self._lock = threading.RLock()

    def of(self, recording: RecordingEntry, topic: str) -> TopicTable | None:
        """The table of a topic in a recording; None without one that the catalog confirms."""
        key = recording.id, topic
        with self._lock:
            if key not in self._found:
                if len(self._found) >= _MAX_FOUND:
                    self._found.clear()
                self._found[key] = self._find(recording, topic)
            return self._found[key]

    def look_again(self) -> None:
        """Look for all tables again; files that are as before stay open."""
        with self._lock:
            self._found.clear()
            self._looked_at.clear()

    def reject(self, recording: RecordingEntry, topic: str) -> None:
        """Ignore the table from now on, because it was found to be damaged."""
        with self._lock:
            self._found[recording.id, topic] = None

    def whole(self, file: ColumnFile) -> TopicTable:
        """All rows of a file, as if of one topic."""
        unreadable = sum(section.unreadable for section in file.about.sections)
        parts = [TablePart(file, group, 0, rows) for group, rows in enumerate(file.groups)]
        return TopicTable(parts, unreadable=unreadable)

    def damaged(self, recording: RecordingEntry, topic: str) -> list[str]:
        """Files that may have rows of a topic, which were looked at and cannot be read."""
        folders = self._folders.of(self._types_of(recording, topic))
        return [path for folder in folders for path in folder.damaged]

    def _find(self, recording: RecordingEntry, topic: str) -> TopicTable | None:
        if recording.status == "open" or not self._can_have(recording, topic):
            return None
        with suppress(StoreError):
            table = self._table(recording, topic, self._look(recording, [topic])[topic])
            if table is not None and table.rows == self._messages_of(recording, topic):
                return table
        return None

    def _can_have(self, recording: RecordingEntry, topic: str) -> bool:
        """True if a topic has a table when all is well: only with one definition."""
        found = {
            (encoding_of(channel.message_encoding, channel.metadata), channel.schema)
            for channel in self._channels_of(recording, topic)
            if channel.stats.messages
        }
        return len(found) == 1

    def sections_of(self, recording: RecordingEntry) -> list[TopicRows]:
        """The rows of a recording in files."""
        topics = sorted({channel.topic for channel in recording.channels})
        return [rows for own in self._look(recording, topics).values() for rows in own]

    def lacking(self, recording: RecordingEntry, topics: Collection[str]) -> set[str]:
        """Topics of which files lack messages, whatever their definitions are."""
        try:
            found = self._look(recording, topics)
        except StoreError:
            return set(topics)
        return {
            topic
            for topic, rows in found.items()
            if not self._is_whole(recording, topic, rows)
            or not all(one.is_of(recording) for one in rows)
        }

    def of_sealed(
        self, recording: RecordingEntry, topic: str, messages: Mapping[int, int]
    ) -> TopicTable | None:
        """The table of some sealed segments of a running recording; None without a valid one.

        `messages` counts those of the topic by segment.
        """
        if not self._can_have(recording, topic):
            return None
        with self._lock:
            place = _Folders(parts_folder(self._root, recording.id), self._cache)
            place = self._sealed.setdefault(recording.id, place)
            if len(self._sealed) > _MAX_RUNNING:
                del self._sealed[next(iter(self._sealed))]
            rows = self._look(recording, [topic], place)[topic]
        try:
            table = self._table(recording, topic, rows)
        except StoreError:
            return None
        if table is None or table.rows != sum(messages.get(n, 0) for n in table.segments):
            return None  # its files are just getting their names
        return table

    def _look(
        self, recording: RecordingEntry, topics: Collection[str], place: _Folders | None = None
    ) -> dict[str, list[TopicRows]]:
        """The rows of topics in files, after a look at the folders of those that lack some."""
        place = place or self._folders
        with self._lock:
            types = set[str]()
            for topic in topics:
                own = self._types_of(recording, topic)
                rows = self._rows_in(place, recording, topic)
                if not own <= self._looked_at or not self._is_whole(recording, topic, rows):
                    types |= own
            if types:
                place.look()
                for folder in place.of(types):
                    folder.look(recording)
            if place is self._folders:
                self._looked_at |= types
            return {one: self._rows_in(place, recording, one) for one in topics}

    def _rows_in(self, folders: _Folders, recording: RecordingEntry, topic: str) -> list[TopicRows]:
        """The rows of a topic in the files of some folders that were looked at."""
        own = folders.of(self._types_of(recording, topic))
        return [rows for folder in own for rows in folder.rows.get((recording.id, topic), [])]

    def _is_whole(self, recording: RecordingEntry, topic: str, rows: Collection[TopicRows]) -> bool:
        """True if the files have as many rows as the catalog messages."""
        return sum(one.section.rows for one in rows) == self._messages_of(recording, topic)

    def _messages_of(self, recording: RecordingEntry, topic: str) -> int:
        return sum(one.stats.messages for one in self._channels_of(recording, topic))

    def _types_of(self, recording: RecordingEntry, topic: str) -> set[str]:
        return {channel.type for channel in self._channels_of(recording, topic)}

    def _table(
        self, recording: RecordingEntry, topic: str, found: Sequence[TopicRows]
    ) -> TopicTable | None:
        """The table of a topic from some files; None without rows of it, or with stale ones."""
        if not found or not all(rows.is_of(recording) for rows in found):
            return None
        has_arrays = any(one.section.arrays for one in found)
        if has_arrays and any(c.id >= EXPIRED_IDS for c in self._channels_of(recording, topic)):
            return None  # its arrays have expired with their payloads
        table = TopicTable(
            [part for one in found for part in one.file.parts(one.begin, one.section.rows)],
            unreadable=sum(one.section.unreadable for one in found),
            segments=(int(number) for one in found for number in one.section.segments),
        )
        if len(table.files) > 1:
            table.fields()  # which some have not in common
        return table

    def _channels_of(self, recording: RecordingEntry, topic: str) -> list[ChannelEntry]:
        """The channels of a topic; those of the recording asked about last are at hand."""
        found = self._channels
        if found is None or found[0] is not recording:
            by_topic: dict[str, list[ChannelEntry]] = defaultdict(list)
            for channel in recording.channels:
                if channel.id != MARKS_CHANNEL:  # marks that somebody set are in no table
                    by_topic[channel.topic].append(channel)
            found = self._channels = recording, dict(by_topic)
        return found[1].get(topic, [])
