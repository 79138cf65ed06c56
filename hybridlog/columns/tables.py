"""Reads tables of topics that the catalog confirms.

A table is valid if every segment with rows in it has the catalog's digest, and the number of
rows is the catalog's number of messages. All bytes read are verified by checksum. An invalid
table is ignored, and chunks answer.

A file is opened once for all recordings and topics in it. A recording that is not found is a
reason to look at the folders again. Recordings in progress have no tables.
"""

from __future__ import annotations

import os
import re
import threading
import time
from bisect import bisect_right
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

from hybridlog.columns.column_file import FIRST, ColumnFile, Leaf, TablePart
from hybridlog.columns.fields import joined, records_of
from hybridlog.columns.layout import (
    OWN_COLUMNS,
    POINTS,
    SHARED,
    SUFFIX,
    TABLES,
    Section,
    type_prefix,
)
from hybridlog.schema.arrow_types import converted, structs
from hybridlog.schema.column import names_of, ranges
from hybridlog.schema.states import State, encoding_of
from hybridlog_storage.cache import Cache
from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError, unreadable
from hybridlog_storage.messages import EXPIRED_IDS, MARKS_CHANNEL, order_of
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import placed, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
    """All messages of a topic of a recording."""

    def __init__(self, parts: Sequence[TablePart], *, unreadable: int = 0) -> None:
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
        check_wanted()
        wanted = {"t", "seq", *own}
        whole = part.file.columns(part.group, part.file.choose(paths, wanted))
        columns = {name: one.slice(part.begin, part.rows) for name, one in whole.items()}
        ours = {name: columns.pop(name) for name in wanted if name in columns}
        t, seq = (ours.pop(name).to_numpy() for name in ("t", "seq"))
        schema = part.file.schema
        kinds = [schema.field(top).with_type(one.type) for top, one in columns.items()]
        fields = structs(columns, part.rows, None, kinds)
        try:
            records = converted(records_of(fields, self._is_summarised), kind)
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


def _in_order(parts: Sequence[TableRows]) -> TableRows:
    own = {name: pa.concat_arrays([part.own[name] for part in parts]) for name in parts[0].own}
    t, seq = np.concatenate([p.t for p in parts]), np.concatenate([p.seq for p in parts])
    rows = TableRows(t, seq, own, pa.concat_arrays([part.records for part in parts]))
    order = order_of(t, seq)
    return rows if order is None else rows.take(order)


_SHARED_NAME: Final = re.compile(rf"{SHARED}(\d{{20}}){re.escape(SUFFIX)}", re.ASCII)
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


class _Folder:
    """The entries of a folder, and those files with tables in it that were looked at."""

    def __init__(self, path: Path, cache: Cache) -> None:
        self._path = path
        self._cache = cache
        self._read_at: tuple[int, int] | None = None  # inode, and time of its last change
        self.names: dict[str, os.stat_result] = {}
        """Status of each entry."""
        self._shared: list[int] = []  # numbers in the names of shared files
        self._own: dict[str, list[str]] = {}  # files of long topics, by recording
        self._files: dict[str, tuple[tuple[int, int, int], ColumnFile | None]] = {}
        self.rows: dict[tuple[str, str], list[TopicRows]] = {}
        """The rows in files that were looked at, by recording and topic."""

    @property
    def damaged(self) -> list[str]:
        """Files that were looked at and cannot be read."""
        return [str(self._path / name) for name, (_, file) in self._files.items() if file is None]

    def read(self) -> bool:
        """Read the entries, none without the folder, if they may have changed; tells whether."""
        try:
            now, names = files.changed_names(self._path, self._read_at)
        except FileNotFoundError:
            now, names = (0, 0), {}
        except OSError as error:
            raise unreadable(error, self._path) from error
        if names is not None:
            # A change within the same tick of the clock would have the same time.
            self._read_at = now if 0 < now[1] < time.time_ns() - _STABLE_NS else None
            self.names = names
        return names is not None

    def look(self, recording: RecordingEntry) -> None:
        """Open files that may have rows of a recording, if they are new or replaced."""
        if self.read():
            before, self._files, self.rows, self._own = self._files, {}, {}, {}
            tables = sorted(name for name in self.names if name.endswith(SUFFIX))
            self._shared = shared_times(tables)
            for name in tables:
                self._own.setdefault(name.rpartition("-")[0], []).append(name)
                if name in before and before[name][0] == _identity(self.names[name]):
                    self._add(name, before[name][1])
        for name in self._own.get(recording.id, ()):
            self._open(name)
        for name in shared_for(self._shared, recording.created):
            file = self._open(name)
            if file is not None and file.has(recording.id):
                break

    def _open(self, name: str) -> ColumnFile | None:
        """A file, if it can be read."""
        if name not in self._files:
            try:
                self._add(name, ColumnFile(self._path / name, self._cache))
            except FileNotFoundError:
                return None
            except StoreError:
                self._add(name, None)
        return self._files[name][1]

    def _add(self, name: str, file: ColumnFile | None) -> None:
        self._files[name] = _identity(self.names[name]), file
        if file is not None:
            for begin, section in file.begins():
                rows = self.rows.setdefault((section.id, section.topic), [])
                rows.append(TopicRows(file, begin, section))


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_ino, status.st_size, status.st_mtime_ns


class Tables:
    """The tables of a store. Thread safe."""

    def __init__(self, root: Path, cache: Cache | None = None) -> None:
        self._cache = cache or Cache()
        self._place = root / TABLES
        self._found: dict[tuple[str, str], TopicTable | None] = {}
        self._all = _Folder(self._place, self._cache)
        self._folders: dict[str, dict[str, _Folder]] = {}  # by the beginning of their names
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

    def reject(self, recording: RecordingEntry, topic: str) -> None:
        """Ignore the table, which was found to be damaged; look again if a file was replaced."""
        with self._lock:
            found = self._found.get((recording.id, topic))
            if found is not None and any(file.was_replaced for file in found.files):
                self.look_again()
            else:
                self._found[recording.id, topic] = None

    def whole(self, file: ColumnFile) -> TopicTable:
        """All rows of a file, as if of one topic."""
        unreadable = sum(section.unreadable for section in file.sections)
        parts = [TablePart(file, group, 0, rows) for group, rows in enumerate(file.groups)]
        return TopicTable(parts, unreadable=unreadable)

    def damaged(self, recording: RecordingEntry, topic: str) -> list[str]:
        """Files that may have rows of a topic, which were looked at and cannot be read."""
        return [path for own in self._of(_channels(recording, topic)) for path in own.damaged]

    def sections_of(self, recording: RecordingEntry) -> list[TopicRows]:
        """The rows of a recording in files."""
        topics = sorted({channel.topic for channel in recording.channels})
        return [rows for topic in topics for rows in self._rows(recording, topic)[0]]

    def lacking(self, recording: RecordingEntry, topics: Collection[str]) -> set[str]:
        """Topics of which files lack messages, whatever their definitions are."""
        try:
            found = {topic: self._rows(recording, topic) for topic in topics}
        except StoreError:
            return set(topics)
        confirmed = {
            topic
            for topic, (rows, is_whole) in found.items()
            if is_whole and all(one.is_of(recording) for one in rows)
        }
        return {*topics} - confirmed

    def _find(self, recording: RecordingEntry, topic: str) -> TopicTable | None:
        channels = [one for one in _channels(recording, topic) if one.stats.messages]
        kinds = {(encoding_of(one.message_encoding, one.metadata), one.schema) for one in channels}
        if recording.status == "open" or len(kinds) != 1:
            return None
        with suppress(StoreError):
            found, is_whole = self._rows(recording, topic)
            if not found or not is_whole or not all(rows.is_of(recording) for rows in found):
                return None
            if any(one.id >= EXPIRED_IDS for one in channels) and any(
                rows.section.arrays for rows in found
            ):
                return None  # its arrays have expired with their payloads
            table = TopicTable(
                [part for one in found for part in one.file.parts(one.begin, one.section.rows)],
                unreadable=sum(one.section.unreadable for one in found),
            )
            if len(table.files) > 1:
                table.fields()  # which some have not in common
            return table
        return None

    def _rows(self, recording: RecordingEntry, topic: str) -> tuple[list[TopicRows], bool]:
        """The rows of a topic in files, and whether these are as many as its messages."""
        channels, found = _channels(recording, topic), list[TopicRows]()
        with self._lock:
            self._look()
            for folder in self._of(channels):
                folder.look(recording)
                found += folder.rows.get((recording.id, topic), ())
        rows = sum(one.section.rows for one in found)
        return found, rows == sum(channel.stats.messages for channel in channels)

    def _look(self) -> None:
        """See which folders there are."""
        if not self._all.read():
            return
        before, self._folders = self._folders, {}
        for name, about in sorted(self._all.names.items()):
            if S_ISDIR(about.st_mode):
                begin = f"{name.rpartition('~')[0]}~"
                folder = before.get(begin, {}).get(name) or _Folder(self._place / name, self._cache)
                self._folders.setdefault(begin, {})[name] = folder

    def _of(self, channels: Iterable[ChannelEntry]) -> list[_Folder]:
        """The known folders of the types of some channels."""
        types = {type_prefix(channel.type) for channel in channels}
        return [folder for one in types for folder in self._folders.get(one, {}).values()]


def _channels(recording: RecordingEntry, topic: str) -> list[ChannelEntry]:
    """The channels of a topic; marks that somebody set are in no table."""
    found = (one for one in recording.channels if one.topic == topic)
    return [one for one in found if one.id != MARKS_CHANNEL]


def type_folders(root: Path) -> list[str]:
    """Names of the folders of tables."""
    found = files.names(root / TABLES).items()
    return sorted(name for name, about in found if "~" in name and S_ISDIR(about.st_mode))


def shared_times(names: Iterable[str]) -> list[int]:
    """The numbers in the names of shared files, in order."""
    return sorted(int(found[1]) for found in map(_SHARED_NAME.fullmatch, names) if found)


def shared_for(times: Sequence[int], created: int | None) -> Iterator[str]:
    """Names of shared files that may have rows of a recording, likeliest first; `created` in ns."""
    end = len(times) if created is None else bisect_right(times, max(created, 0))
    return map(shared_name, reversed(times[:end]))


def shared_name(time: int) -> str:
    """The name of a shared file by its number."""
    return f"{SHARED}{time:020d}{SUFFIX}"


def files_of(root: Path, prefixes: Collection[str] = ("",)) -> Iterator[ColumnFile]:
    """The tables in some folders; those that cannot be read are left out."""
    with suppress(OSError):
        for folder in type_folders(root):
            if folder.startswith(tuple(prefixes)):
                for name in sorted(files.names(root / TABLES / folder)):
                    with suppress(OSError, StoreError):
                        yield ColumnFile(root / TABLES / folder / name)
