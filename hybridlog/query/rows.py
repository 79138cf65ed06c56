"""Rows of a topic of one recording: from tables that hold what is asked, else from chunks.

A table answers what its columns can decide. Recordings in progress have none, and what no table
can tell is decoded from chunks. Counts and times without a predicate come from chunk tables and
message indexes.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from msgspec.structs import replace

from hybridlog.query.chunk_scan import ChunkKey, ChunkScan, MessageRun, RecordingScan
from hybridlog.query.predicate.tree import is_meta
from hybridlog_storage.errors import ChangedError, SegmentError, StoreError
from hybridlog_storage.times import inside, placed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.tables import TableRows, TopicTable
    from hybridlog.query.question import Counters, Part, RecordedChannel
    from hybridlog.session import Session

_RENEWALS = 50  # of a question, while a ring lets files go
_T = TypeVar("_T")


class RowBatch(NamedTuple):
    """Some messages of a topic of a recording, in order of log time and arrival.

    Attributes:
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers; 0 where only times are read.
        holds: bool[n], true where the message matches.
        records: n rows, their fields; None where only times are asked for.
        summaries: n rows each, those that are asked for of arrays that are gone, by path.
    """

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    holds: NDArray[np.bool_]
    records: Any = None
    summaries: Mapping[str, Any] = MappingProxyType({})

    def after(self, time: int, seq: int) -> RowBatch:
        """Those behind a log time and an arrival number."""
        is_before = (self.log_time < time) | ((self.log_time == time) & (self.seq <= seq))
        begin = int(np.count_nonzero(is_before))
        records = None if self.records is None else self.records[begin:]
        summaries = {path: array[begin:] for path, array in self.summaries.items()}
        times = self.log_time[begin:], self.seq[begin:]
        return RowBatch(*times, self.holds[begin:], records, summaries)


class _UndecidedError(StoreError):
    """The columns of a table cannot decide a predicate."""


class Rows:
    """Rows for the parts of one question; `counters` count what they cost."""

    def __init__(self, session: Session, counters: Counters) -> None:
        self.session = session
        self.counters = counters
        self._tables: dict[Part, TopicTable | None] = {}
        self._counts: dict[Part, tuple[int, int]] = {}  # matching ones, and unreadable ones

    # The rule.

    def tabled(self, part: Part, fields: Collection[str] | None = ()) -> TopicTable | None:
        """The table of a part, if that has the fields (None: all).

        Whether it decides the predicate shows when it is read.
        """
        if part not in self._tables:
            self._tables[part] = self._find(part)
        found = self._tables[part]
        return found if found is not None and _holds(found, part, fields) else None

    def _find(self, part: Part) -> TopicTable | None:
        predicate = part.predicate
        asks_fields = predicate is not None and predicate.asks_fields
        asks_publish = predicate is not None and "_meta.pub" in predicate.fields()
        # A table does not say which messages have a publish time, and may be older than the
        # package that reads the messages.
        if (asks_fields and not part.has_fields) or (
            asks_publish and len({c.channel.has_publish_time for c in part.channels}) > 1
        ):
            return None
        table = self.session.table(part.recording, part.topic)
        # Without fields of unreadable messages, or older than a definition.
        if table is not None and (
            (table.unreadable and predicate is None)
            or (not table.has_fields and any(c.codec.indexed for c in part.channels))
        ):
            return None
        return table

    # Answers.

    def count_of(self, parts: Sequence[Part]) -> int:
        """Number of matching messages in all parts."""
        return self._again(self._count, parts)

    def outcomes(self, part: Part) -> Iterator[RowBatch]:
        """For each message of the part's topic and time, whether it matches."""
        return self._lasting(part, self._outcomes)

    def times(self, part: Part) -> NDArray[np.int64]:
        """Log times of the matching messages of a part, ns, ascending."""
        found = [one.log_time[one.holds] for one in self.outcomes(part)]
        return np.concatenate([np.empty(0, np.int64), *found])

    def values(
        self, part: Part, fields: Collection[str] | None, *, partial: bool = False
    ) -> Iterator[RowBatch]:
        """The matching messages with some fields, nested as these are, and summaries of arrays.

        With `partial`, also those that have lost arrays with their payloads: null there.
        """
        return self._lasting(part, lambda own: self._values(own, fields, partial=partial))

    def scan(self, parts: Sequence[Part], **how: bool) -> ChunkScan:
        """Reads the matching messages of some parts; `how` is as of `ChunkScan`."""
        parts = self.fitting(self.decided(parts))
        return self._again(lambda known: self.chunk_scan(known, **how), parts)

    def fitting(self, parts: Sequence[Part]) -> list[Part]:
        """The parts without those of which a file of tables tells that nothing matches.

        Of whole parts that lie in one file, the predicate is evaluated once for all rows.
        """
        by_file: dict[tuple[int, int], list[tuple[Part, TopicTable]]] = defaultdict(list)
        for part in parts:
            # What is meta is known of the part, not of a row.
            if (
                part.predicate is None
                or part in self._counts
                or part.windows is not None
                or part.needs_index
                or any(map(is_meta, part.predicate.fields()))
            ):
                continue
            table = self.tabled(part)
            if table is not None and len(table.files) == 1:
                by_file[table.files[0].number, id(part.predicate)].append((part, table))
        for group in by_file.values():
            if len(group) > 1:
                with suppress(StoreError):  # then part by part
                    self._count_in_file(group)
        return [part for part in parts if self._counts.get(part) != (0, 0)]

    def _count_in_file(self, group: Sequence[tuple[Part, TopicTable]]) -> None:
        first, table = group[0]
        whole = self.session.tables.whole(table.files[0])
        sums, before = [np.zeros((2, 1), np.int64)], [0]
        for rows, holds in self._scanned(first, whole):
            before.append(before[-1] + len(rows))
            both = np.stack([holds, rows.is_unreadable()])
            sums.append(sums[-1][:, -1:] + np.cumsum(both, axis=1))
        total = np.concatenate(sums, axis=1)
        for part, table in group:
            if part.field_types == first.field_types:
                begin = np.array([before[p.group] + p.begin for p in table.parts])
                end = begin + [p.rows for p in table.parts]
                matched, unreadable = (total[:, end] - total[:, begin]).sum(axis=1).tolist()
                self._counts[part] = matched, unreadable

    # Filters of MongoDB.

    def decided(self, parts: Sequence[Part]) -> list[Part]:
        """The parts with predicates for columns and messages: MongoDB is asked once for all."""
        wanted = [part for part in parts if part.needs_index]
        if not wanted:
            return [*parts]
        from hybridlog.query import index_reader

        found, documents = index_reader.decided(self.session, wanted, self.counters)
        self.counters.not_indexed += self.lacking(documents)
        decidable = dict(zip(wanted, found, strict=True))
        return [decidable.get(part, part) for part in parts]

    def lacking(self, documents: Mapping[Part, int]) -> tuple[tuple[str, int], ...]:
        """Messages that the index lacks, from the documents that it has of some parts."""
        found: Counter[str] = Counter()
        for part, number in documents.items():
            whole = replace(part, predicate=None)
            found[part.recording.name] += max(self.count_of([whole]) - number, 0)
        return tuple((name, number) for name, number in found.items() if number)

    # Files that go, and tables that cannot tell.

    def _again(self, ask: Callable[[Sequence[Part]], _T], parts: Sequence[Part]) -> _T:
        """Ask about parts; again about those whose files were replaced, or whose table failed."""
        before = replace(self.counters)
        for _ in range(_RENEWALS):
            try:
                return ask(parts)
            except ChangedError:
                parts = self._renewed(parts, before)
        return ask(parts)

    def _lasting(self, part: Part, ask: Callable[[Part], Iterator[RowBatch]]) -> Iterator[RowBatch]:
        """Rows of a part, to the end if files are replaced or a table fails meanwhile."""
        last: tuple[int, int] | None = None
        (part,) = self.decided([part])
        before = replace(self.counters)
        for left in range(_RENEWALS, -1, -1):
            try:
                for found in ask(part):
                    rest = found if last is None else found.after(*last)
                    if len(rest.log_time):
                        last = int(rest.log_time[-1]), int(rest.seq[-1])
                        yield rest
                return
            except ChangedError:
                if not left:
                    raise
                (part,) = self._renewed([part], before)

    def _renewed(self, parts: Sequence[Part], before: Counters) -> list[Part]:
        """The parts with their recordings as they are now; counters go back to `before`."""
        self.counters.unreadable = before.unreadable
        self.counters.without_arrays = before.without_arrays
        found = []
        for part in parts:
            recording = self.session.entry(part.recording.id)
            if recording is not part.recording:
                channels = self.session.channels_of(recording, [part.topic])
                part = replace(part, recording=recording, channels=tuple(channels))  # noqa: PLW2901
            found.append(part)
        return found

    # Rows of tables, then those of chunks.

    def _count(self, parts: Sequence[Part]) -> int:
        total = 0
        left: list[Part] = []
        for part in parts:
            if part.predicate is None:
                total += part.messages if part.windows is None else self._count_by_time(part)
            elif part in self._counts:
                matched, unreadable = self._counts[part]
                total += matched
                self.counters.unreadable += unreadable
            else:
                table = self.tabled(part)
                total += sum(int(holds.sum()) for _, holds in self._in_table(part, table))
                left += [part] if table is None else []
        return total + (self.count_in_chunks(left) if left else 0)

    def count_in_chunks(self, parts: Sequence[Part]) -> int:
        """Read the messages of some parts and count those that match."""
        scan = self.chunk_scan(parts, tabled=False)
        return sum(len(run.batch) for run, _ in scan.loaded())

    def _outcomes(self, part: Part) -> Iterator[RowBatch]:
        table = self.tabled(part)
        for rows, holds in self._in_table(part, table):
            yield RowBatch(rows.t, rows.seq, holds)
        if table is not None:
            return
        if part.predicate is None:
            with suppress(SegmentError):
                time = self._times(part, self._held(part))
                yield RowBatch(time, np.zeros_like(time), np.ones(len(time), np.bool_))
                return
        for run in self.chunk_scan([part], tabled=False, marks=True).runs():
            assert run.holds is not None
            yield RowBatch(run.batch.log_time, run.seq, run.holds)

    def _values(
        self, part: Part, fields: Collection[str] | None, *, partial: bool
    ) -> Iterator[RowBatch]:
        from hybridlog.schema.arrow_types import converted

        summaries = summaries_in(fields, part.field_types)
        wanted = None if fields is None else {*fields} - summaries
        table = self.tabled(part, wanted)
        if table is not None and not all(map(table.has, summaries)):
            table = None
        kind = None if fields is None or table is None else table.fields(fields)
        for rows, holds in self._in_table(part, table, fields):
            chosen = rows if holds.all() else rows.take(np.flatnonzero(holds))
            # Without the columns that only the predicate needs.
            records = chosen.records
            records = records if kind is None else converted(records, kind, drops=True)
            yield RowBatch(chosen.t, chosen.seq, holds[holds], records)
        arrays = {path.rpartition(".")[0] for path in summaries}
        wanted = None if wanted is None else wanted | arrays
        for channel, own in self._by_channel(part) if table is None else ():
            decoded, made = channel.codec.columns_of(own.batch, wanted), {}
            self.counters.unreadable += len(own.batch) - len(decoded.rows)
            if channel.is_reduced:
                from hybridlog.columns.rows import LeftFields, without_lacking

                whole, lacking = without_lacking(decoded, arrays.difference(fields or ()))
                if partial:
                    self.counters.lacking += lacking
                else:
                    decoded = whole
                    self.counters.leave_out(lacking, channel.state)
                if isinstance(decoded.records, LeftFields):
                    made = decoded.records.statistics(summaries)
            good = decoded.rows
            times = own.batch.log_time[good], own.seq[good]
            yield RowBatch(*times, np.ones(len(good), np.bool_), decoded.arrow(), made)

    def _by_channel(self, part: Part) -> Iterator[tuple[RecordedChannel, MessageRun]]:
        """The matching messages of a part in chunks, in order, of one channel at a time."""
        for run in self.chunk_scan([part], tabled=False).runs():
            edges = [0, *(np.flatnonzero(np.diff(run.batch.channel)) + 1), len(run.batch)]
            for begin, end in pairwise(edges):
                own = run if len(edges) == 2 else run.take(np.arange(begin, end))
                yield own.channels[int(own.batch.channel[0])], own

    # Tables.

    def _in_table(
        self,
        part: Part,
        table: TopicTable | None,
        fields: Collection[str] | None = (),
        own: Collection[str] = (),
    ) -> Iterator[tuple[TableRows, NDArray[np.bool_]]]:
        """Rows of a part's time in its table, with the outcome for each; None without a table.

        `own` are columns of the table itself. Unreadable ones are counted. Of a table that is
        damaged or cannot tell, a `ChangedError` says that it is left.
        """
        if table is None:
            return
        try:
            for rows, holds in self._scanned(part, table, fields, own):
                self.counters.unreadable += int(rows.is_unreadable().sum())
                yield rows, holds
        except StoreError as error:
            self._tables[part] = None
            if not isinstance(error, _UndecidedError):
                self.session.tables.reject(part.recording, part.topic)
            raise ChangedError(f"The table of {part.topic} is left. Ask again.") from error

    def _scanned(
        self,
        part: Part,
        table: TopicTable,
        fields: Collection[str] | None = (),
        own: Collection[str] = (),
    ) -> Iterator[tuple[TableRows, NDArray[np.bool_]]]:
        """Rows of a part's time in a table, with the outcome for each."""
        spans = None if part.windows is None else [(a, b) for a, b in part.log_windows.tolist()]
        columns = {*own}
        if part.predicate is not None:
            columns |= {"pub"} if "_meta.pub" in part.predicate.fields() else set()
            columns |= {"state"} if part.predicate.asks_fields and table.unreadable else set()
        names = (path.replace("[]", "") for path in fields or ())
        paths = None if fields is None else {*_paths(table, part), *names}
        size = table.size(paths, own)
        for rows in table.scan(paths, own=columns, spans=spans):
            self.counters.bytes_read += size * len(rows) // max(table.rows, 1)
            yield rows, _decided(part, rows)

    # Chunks.

    def chunk_scan(self, parts: Sequence[Part], *, tabled: bool = True, **how: bool) -> ChunkScan:
        """Reads the matching messages of some parts from chunks.

        Where a table decides, it says where they are; else, and without `tabled`, filters decide
        on what is read. `how` is as of `ChunkScan`.
        """
        channels: list[RecordedChannel] = []
        filters: dict[int, Part] = {}
        offsets: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
        of_recording: dict[str, tuple[Part, dict[int, int]]] = {}
        for part in parts:
            _, indexes = of_recording.setdefault(part.recording.id, (part, {}))
            asks = part.predicate is not None
            table = self.tabled(part) if asks and tabled else None
            for key, own in self._offsets(part, table).items():
                offsets[key].append(own)
            for channel in part.channels:
                indexes[channel.channel_id] = len(channels)
                if asks and table is None:
                    filters[len(channels)] = part
                channels.append(channel)
        return ChunkScan(
            self.session,
            channels,
            [self._scan(part, indexes) for part, indexes in of_recording.values()],
            self.counters,
            filters,
            {key: np.concatenate(own) for key, own in offsets.items()},
            not how.get("marks") and any(part.predicate is not None for part in parts),
            **how,
        )

    def _offsets(self, part: Part, table: TopicTable | None) -> dict[ChunkKey, NDArray[np.int64]]:
        """Payload offsets of the matching messages that a table has, by chunk, sorted."""
        columns = [np.empty((3, 0), np.int64)]
        for rows, holds in self._in_table(part, table, own=("ref",)):
            ref = rows.own["ref"]
            own = [ref.field(n).to_numpy(zero_copy_only=False) for n in ("seg", "chunk", "off")]
            columns.append(np.stack(own).astype(np.int64)[:, holds])
        places = np.concatenate(columns, axis=1)
        segment, chunk, offset = places[:, np.lexsort(places[::-1])]
        edges = np.flatnonzero((np.diff(segment) != 0) | (np.diff(chunk) != 0)) + 1
        return {
            (part.recording.id, int(segment[own[0]]), int(chunk[own[0]])): offset[own]
            for own in np.split(np.arange(len(offset)), edges)
            if len(own)
        }

    def _scan(self, part: Part, indexes: dict[int, int]) -> RecordingScan:
        """The chunks of a recording that may hold wanted messages."""
        session, ids = self.session, [*indexes]
        chunks = session.chunks(part.recording, ids, part.log_span)
        session.hold(part.recording, {chunk.segment for chunk in chunks})
        return RecordingScan(part.recording, indexes, chunks, part.windows)

    # Times alone.

    def _count_by_time(self, part: Part) -> int:
        """Number of messages in the windows of a part."""
        edges = part.log_windows.ravel()
        held = self._held(part)
        low, high = (edges.searchsorted(placed(held[n]), "right") for n in ("first", "last"))
        is_whole = low == high  # in one window, or between two
        times = self._times(part, held[~is_whole])
        return int(held["messages"][is_whole & (low % 2 == 1)].sum()) + len(times)

    def _times(self, part: Part, held: NDArray[np.void]) -> NDArray[np.int64]:
        """Log times in the windows of a part that some parts of chunks have, sorted."""
        found = [np.empty(0, np.int64)]
        for segment, chunk, channel in held[["segment", "chunk", "channel"]].tolist():
            reader = self.session.segment(part.recording, segment)
            read_before = reader.bytes_read
            found.append(self.session.times(part.recording, segment, chunk)[channel])
            self.counters.bytes_read += reader.bytes_read - read_before
        time = np.sort(np.concatenate(found))
        return time[inside(time, part.log_windows)]

    def _held(self, part: Part) -> NDArray[np.void]:
        """Messages of a part in chunks, as of `Session.parts`."""
        ids = [channel.channel_id for channel in part.channels]
        return self.session.parts(part.recording, ids, part.log_span)


def summaries_in(fields: Collection[str] | None, types: Mapping[str, str] | None) -> set[str]:
    """The paths among some fields that are summaries of arrays."""
    from hybridlog.frames.names import is_summary  # a count needs no frames

    return {path for path in fields or () if is_summary(path, types or {})}


def _decided(part: Part, rows: TableRows) -> NDArray[np.bool_]:
    readable = ~rows.is_unreadable()
    if part.predicate is None:
        return readable
    from hybridlog.query.predicate.evaluate import verdict_of

    times = rows.t, rows.seq, rows.own.get("pub")
    found = verdict_of(part, part.channels[0], rows.records, *times, left=True)
    if (found.open & readable).any():
        raise _UndecidedError
    return found.holds & readable


def _holds(table: TopicTable, part: Part, fields: Collection[str] | None) -> bool:
    """True if a table holds some fields, or all, in full: no array that is a summary there."""
    from hybridlog.schema.column import names_of

    types = part.field_types
    if fields is not None and not fields:
        return True
    if types is None or summaries_in(fields, types):
        return False
    return not any(table.is_cut(names_of(one) if one else ()) for one in fields or [""])


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
