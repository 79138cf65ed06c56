"""Reads tables of topics that the catalog confirms.

A table is valid if its files belong to this recording, topic and type. Every segment with
rows in it must have the catalog's digest, and the number of rows must be the catalog's
number of messages. All bytes read are verified by checksum. An invalid table is ignored,
and other engines answer.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import is_list
from hybridlog.schema.column import ranges
from hybridlog.tables.fields import UnfitError, alike, original_name, records_of
from hybridlog.tables.layout import (
    IN_TOPIC,
    ORIGINAL,
    OWN_COLUMNS,
    SMALL,
    SUFFIX,
    TOPIC_COLUMN,
    recording_folder,
    small_file,
    table_schema,
    topic_file,
    topic_folder,
)
from hybridlog.tables.parquet_file import ParquetFileReader, leaves_of
from hybridlog_storage import files
from hybridlog_storage.errors import StoreError, exhausted
from hybridlog_storage.stopping import check_wanted
from hybridlog_storage.times import placed, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.intervals import Span
    from hybridlog_storage.catalog import ChannelEntry, RecordingEntry

MAX_BYTES: Final = 64 << 20
"""Maximum memory of decoded columns."""
_OPEN_FILES: Final = 256
_TYPES: Final = 64  # of which a table remembers what they are
_OWN: Final = frozenset({*OWN_COLUMNS, TOPIC_COLUMN})
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
        records: Fields of the messages, a struct each, under their own names. Arrays over the
            limit are `{n, min, max, mean}`.
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

    file: ParquetFileReader
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
    """

    top: str
    is_own: bool
    names: tuple[str, ...]


class TopicTable:
    """All messages of a topic in a recording.

    Args:
        topic: Full name.
        parts: Its rows.
        cache: Cache of decoded columns.

    Attributes:
        topic: Full name.
        rows: Number of messages.
        unreadable: Messages without fields, because they do not fit their definition.
        reduced: Messages without fields, because they were reduced under pressure.
        files: The files with its rows.
    """

    def __init__(self, topic: str, parts: Sequence[TablePart], cache: _Cache) -> None:
        self.topic = topic
        self.rows = sum(part.rows for part in parts)
        self.files = list({part.file.number: part.file for part in parts}.values())
        self.unreadable = sum(file.about.unreadable for file in self.files)
        self.reduced = sum(file.about.reduced for file in self.files)
        self._cache = cache
        self._runs = list(_runs(parts))
        self._leaves = {file.number: cache.leaves(file) for file in self.files}
        self._types: dict[frozenset[str] | None, Any] = {}

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
        return any(not leaf.is_own for leaves in self._leaves.values() for leaf in leaves)

    def has(self, path: str) -> bool:
        """True if every file has the field: an array is a summary in some, a list in others."""
        names = _names(path)
        return all(
            any(not leaf.is_own and leaf.names[: len(names)] == names for leaf in leaves)
            for leaves in self._leaves.values()
        )

    def size(self, paths: Collection[str] | None = None, own: Collection[str] = ()) -> int:
        """Stored bytes to read for some fields.

        Args:
            paths: As for `fields`.
            own: Columns of the table itself.
        """
        own = {"t", "seq", *own}
        return sum(
            part.file.size(part.group, self._chosen(part.file, paths, own))
            for run in self._runs
            for part in run
        )

    def scan(
        self,
        paths: Collection[str] | None = (),
        *,
        own: Collection[str] = (),
        spans: Sequence[Span] | None = None,
    ) -> Iterator[TableRows]:
        """Messages by log time and arrival, one row group at a time.

        Args:
            paths: Dotted paths of fields, including all fields below them; None for all.
            own: Columns of the table itself besides log time and arrival number.
            spans: Ranges of log time, ns, disjoint, in order; None for all times.

        Raises:
            StoreError: the data read is damaged.
        """
        kind = self.empty(paths)
        streams = [self._read_run(run, paths, own, spans, kind) for run in self._runs]
        return streams[0] if len(streams) == 1 else _merged(streams)

    def _read_run(
        self,
        run: Sequence[TablePart],
        paths: Collection[str] | None,
        own: Collection[str],
        spans: Sequence[Span] | None,
        kind: Any,
    ) -> Iterator[TableRows]:
        for part in run:
            if spans is None:
                yield self._read(part, paths, own, kind)
                continue
            low, high = span_of(part.first[0], part.last[0])
            near = [span for span in spans if span[0] < high and span[1] > low]
            if not near:
                continue
            rows = self._read(part, paths, own, kind)
            bounds = np.searchsorted(placed(rows.t), np.array(near, np.int64).reshape(-1, 2))
            begins, counts = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
            if len(near) == 1:
                rows = rows.slice(int(bounds[0, 0]), int(bounds[0, 1]))
            else:
                rows = rows.take(ranges(begins, counts))
            if len(rows):
                yield rows

    def _read(
        self, part: TablePart, paths: Collection[str] | None, own: Collection[str], kind: Any
    ) -> TableRows:
        ours, records = self.read(part, paths, {"t", "seq", *own})
        t, seq = (ours.pop(name).to_numpy() for name in ("t", "seq"))
        return TableRows(t, seq, ours, alike([kind, records], by_type=True)[1])

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
        leaves = self._leaves[part.file.number]
        by_top: dict[str, list[int]] = {}
        for number in self._chosen(part.file, paths, own):
            by_top.setdefault(leaves[number].top, []).append(number)
        columns = {
            top: self._cache.get(part.file, part.group, top, tuple(numbers)).slice(
                part.begin, part.rows
            )
            for top, numbers in by_top.items()
        }
        ours = {name: columns.pop(name) for name in own if name in columns}
        named = [part.file.schema.field(top) for top in columns]
        return ours, _records(list(columns.values()), named, part.rows)

    def _chosen(
        self, file: ParquetFileReader, paths: Collection[str] | None, own: Collection[str]
    ) -> list[int]:
        """Numbers of the columns for these fields."""
        wanted = None if paths is None else list(map(_names, paths))
        return [
            number
            for number, leaf in enumerate(self._leaves[file.number])
            if (leaf.top in own if leaf.is_own else _is_wanted(leaf.names, wanted))
        ]

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
            leaves = self._leaves[file.number]
            chosen = {leaves[number] for number in self._chosen(file, paths, ())}
            tops = list(dict.fromkeys(leaf.top for leaf in leaves if leaf in chosen))
            fields = [_only(file.schema.field(top), chosen, (), top) for top in tops]
            kept = [field for field in fields if field is not None]
            columns = [pa.nulls(0, field.type) for field in kept]
            found.append(_records(columns, kept, 0))
        first = alike(found, by_type=True)[0]
        return first.slice(0, 0)


class _Cache:
    """A cache of the most recently used decoded columns. Thread safe."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self._columns: OrderedDict[tuple[int, int, str, tuple[int, ...]], Any] = OrderedDict()
        self._leaves: dict[int, list[_Leaf]] = {}
        self._size = 0
        self._lock = threading.Lock()

    def get(self, file: ParquetFileReader, group: int, top: str, leaves: tuple[int, ...]) -> Any:
        """A column of a row group, or the requested parts of it."""
        key = file.number, group, top, leaves
        with self._lock:
            if key in self._columns:
                self._columns.move_to_end(key)
                return self._columns[key]
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

    def leaves(self, file: ParquetFileReader) -> list[_Leaf]:
        """The columns of a file; the tables of several topics may be in one."""
        with self._lock:
            found = self._leaves.get(file.number)
        if found is None:
            found = list(_leaves(file.schema))
            with self._lock:
                if len(self._leaves) >= _OPEN_FILES:
                    self._leaves.clear()
                self._leaves[file.number] = found
        return found

    def clear(self) -> None:
        with self._lock:
            self._columns.clear()
            self._leaves.clear()
            self._size = 0


class _SmallFile(NamedTuple):
    """A file of several topics, and the first row of each."""

    file: ParquetFileReader
    first_rows: dict[str, int]


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
        self._small: OrderedDict[Path, _SmallFile] = OrderedDict()
        self._channels: tuple[RecordingEntry, dict[str, list[ChannelEntry]]] | None = None
        # Files of running recordings, by name: each question finds the same ones and a few more.
        self._sealed: OrderedDict[tuple[str, str], dict[str, list[TablePart]]] = OrderedDict()
        self._generation = 0
        self._lock = threading.Lock()

    def invalidate(self) -> None:
        """Forget all files, columns and invalid tables."""
        with self._lock:
            self._generation += 1
            self._found.clear()
            self._small.clear()
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
                self._found.move_to_end(key)
                return self._found[key]
        found = None
        with suppress(FileNotFoundError, StoreError):
            found = self.check(recording, topic)
        self._remember(key, found, generation)
        return found

    def forget(self, recording: RecordingEntry, topic: str) -> None:
        """Look for the table again at the next request."""
        with self._lock:
            self._found.pop((recording.id, topic), None)
            self._small.clear()

    def reject(self, recording: RecordingEntry, topic: str) -> None:
        """Ignore the table from now on, because it was found to be damaged."""
        self._remember((recording.id, topic), None, self._generation)

    def _remember(self, key: tuple[str, str], found: TopicTable | None, generation: int) -> None:
        with self._lock:
            if generation == self._generation:
                self._found[key] = found
                while len(self._found) > files.most_open(_OPEN_FILES):
                    self._found.popitem(last=False)

    def check(self, recording: RecordingEntry, topic: str) -> TopicTable:
        """The table of a topic in a recording.

        Raises:
            FileNotFoundError: no table exists.
            StoreError: the table is damaged, or the catalog does not confirm it.
        """
        if recording.status == "open":
            raise FileNotFoundError
        channels = self._channels_of(recording, topic)
        schemas = {
            table_schema(c.message_encoding, c.schema, c.metadata): c.type
            for c in channels
            if c.stats.messages
        }
        if len(schemas) != 1:
            raise FileNotFoundError
        ((schema, type_name),) = schemas.items()
        folder = recording_folder(self._root, recording.id)
        parts = list(self._own_parts(folder / topic_folder(topic)))
        if not parts:
            parts = list(self._small_parts(folder / SMALL / small_file(type_name, schema), topic))
        if not parts:
            raise FileNotFoundError
        table = TopicTable(topic, parts, self._cache)
        for file in table.files:
            _confirm(file, recording, topic, schema)
        messages = sum(channel.stats.messages for channel in channels)
        if table.rows != messages:
            raise StoreError(
                f"The tables of {topic} have {table.rows} messages, the segments {messages}."
            )
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
        schemas = {
            table_schema(c.message_encoding, c.schema, c.metadata)
            for c in self._channels_of(recording, topic)
        }
        if len(schemas) != 1:
            return None
        folder = recording_folder(self._root, recording.id)
        key = recording.id, topic
        with self._lock:
            known = self._sealed.pop(key, {})
        try:
            found = list(self._own_parts(folder / topic_folder(topic), known))
            for part in found:
                _confirm(part.file, recording, topic, *schemas)
        except (FileNotFoundError, StoreError):
            return None
        with self._lock:
            self._sealed[key] = known
            while sum(map(len, self._sealed.values())) > files.most_open(_OPEN_FILES):
                self._sealed.popitem(last=False)
        segments = frozenset(int(number) for part in found for number in part.file.about.segments)
        rows = sum(part.rows for part in found)
        if not found or rows != sum(messages.get(number, 0) for number in segments):
            return None  # its files are just getting their names
        return TopicTable(topic, found, self._cache), segments

    def _channels_of(self, recording: RecordingEntry, topic: str) -> list[ChannelEntry]:
        """The channels of a topic; those of the recording asked about last are at hand."""
        found = self._channels
        if found is None or found[0] is not recording:
            by_topic: dict[str, list[ChannelEntry]] = defaultdict(list)
            for channel in recording.channels:
                by_topic[channel.topic].append(channel)
            found = self._channels = recording, dict(by_topic)
        return found[1].get(topic, [])

    def _own_parts(
        self, folder: Path, known: dict[str, list[TablePart]] | None = None
    ) -> Iterator[TablePart]:
        """Row groups of the files of one topic.

        Args:
            folder: Its folder.
            known: Row groups of files that are open already, by name; gets the others.
        """
        try:
            found = files.names(folder, depth=IN_TOPIC - 1)
        except FileNotFoundError:
            return
        except OSError as error:
            problem = f"The tables in {folder} cannot be read: {error}."
            raise (exhausted(error.errno, f"reading {folder}") or StoreError(problem)) from error
        for name in sorted(found):
            if not name.endswith(SUFFIX):
                continue
            if known is not None and name in known:
                yield from known[name]
                continue
            file = ParquetFileReader(folder / name)
            segment = max(map(int, file.about.segments), default=0)
            if not name.startswith(topic_file(file.about.schema, segment).removesuffix(SUFFIX)):
                raise StoreError(f"The table {folder / name} has the name of another one.")
            parts = [
                TablePart(file, group, 0, rows, (keys[0], keys[1]), (keys[2], keys[3]))
                for group, (rows, *keys) in enumerate(file.about.bounds)
            ]
            if known is not None:
                known[name] = parts
            yield from parts

    def _small_parts(self, path: Path, topic: str) -> Iterator[TablePart]:
        """Rows of a topic in a file of several topics."""
        file, first_rows = self._small_file(path)
        if topic not in first_rows:
            return
        begin = first_rows[topic]
        end, before = begin + file.about.topics[topic], 0
        for group, (count, *_) in enumerate(file.about.bounds):
            low, high = max(begin, before), min(end, before + count)
            if low < high:
                yield TablePart(file, group, low - before, high - low, _FIRST, _LAST)
            before += count

    def _small_file(self, path: Path) -> _SmallFile:
        with self._lock:
            if path in self._small:
                return self._small[path]
        file = ParquetFileReader(path)
        counts = file.about.topics
        begins = accumulate(counts.values(), initial=0)
        found = _SmallFile(file, dict(zip(counts, begins, strict=False)))
        with self._lock:
            self._small[path] = found
            while len(self._small) > files.most_open(_OPEN_FILES):
                self._small.popitem(last=False)
        return found


def _confirm(file: ParquetFileReader, recording: RecordingEntry, topic: str, schema: str) -> None:
    """Compare the description of a file with the catalog.

    Raises:
        StoreError: they differ.
    """
    about = file.about
    if about.recording != recording.id or topic not in about.topics or about.schema != schema:
        raise StoreError(f"The table {file.path} belongs to other data.")
    if not about.segments.items() <= recording.digests.items():
        raise StoreError(f"Segments of the table {file.path} are missing.")


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
    return rows.take(np.lexsort((seq, t)))


def _leaves(schema: Any) -> Iterator[_Leaf]:
    for top in schema:
        is_own = top.name in _OWN
        for names, _ in leaves_of(pa.schema([_renamed(top)])):
            yield _Leaf(top.name, is_own, names)


def _renamed(field: Any) -> Any:
    """A column under the name of its field, including all columns inside it."""
    kind = field.type
    if pa.types.is_struct(kind):
        kind = pa.struct([_renamed(kind.field(number)) for number in range(kind.num_fields)])
    elif pa.types.is_list(kind) or pa.types.is_large_list(kind):
        kind = pa.list_(_renamed(kind.value_field))
    elif pa.types.is_fixed_size_list(kind):
        kind = pa.list_(_renamed(kind.value_field), kind.list_size)
    return pa.field(original_name(field), kind)


def _only(field: Any, chosen: Collection[_Leaf], above: tuple[str, ...], top: str) -> Any | None:
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
    return field if _Leaf(top, False, names) in chosen else None


def _records(columns: list[Any], named: Sequence[Any], rows: int) -> Any:
    """Columns as fields of messages, under their own names."""
    if not columns:
        return structs({}, rows)
    fields = [field.with_type(column.type) for field, column in zip(named, columns, strict=True)]
    return records_of(pa.StructArray.from_arrays(columns, fields=fields))


def _names(path: str) -> tuple[str, ...]:
    return tuple(path.replace("[]", "").split("."))


def _is_wanted(names: tuple[str, ...], wanted: Sequence[tuple[str, ...]] | None) -> bool:
    return wanted is None or any(names[: len(path)] == path for path in wanted)
