"""Rows of a topic of one recording: from tables that hold what is asked, else from chunks.

A table answers what its columns can decide, for the segments that it covers. What a running
recording has written since, and what no table can tell, is decoded from chunks. Counts and
times without a predicate come from chunk tables and message indexes.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridlog.query.chunk_scan import ChunkKey, ChunkScan, RecordingScan, ScanPlan
from hybridlog.query.predicate.tree import is_meta
from hybridlog.record.losses import lost_spans
from hybridlog.schema.kinds import SINGLE, element_of, width_of
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.errors import HybridlogError, ResourceError, SegmentError, StoreError
from hybridlog_storage.times import BEGIN, END, inside, placed

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.columns.topic_table import TableRows, TopicTable
    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.query.message_filter import MessageFilter
    from hybridlog.query.question import Counters, Part, RecordedChannel
    from hybridlog.schema.left import LeftFields
    from hybridlog.session import Session

_MARK = re.compile(r"[.\[]")
_WHOLE = 32  # elements; longer arrays are summaries in tables
_IN_FULL = SINGLE - {"uint8", "byte", "char"}  # elements of arrays in tables with arrays


class UndecidedError(HybridlogError):
    """The columns of a table cannot decide a predicate."""


TABLE_ERRORS = (ResourceError, StoreError, UndecidedError)
"""Failures of a table after which chunks answer."""


class MatchColumns(NamedTuple):
    """Result of a predicate for each message, in order of log time and arrival.

    Attributes:
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers; 0 where only times are read.
        holds: bool[n], true where the message matches.
    """

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    holds: NDArray[np.bool_]


class Values(NamedTuple):
    """Fields of matching messages, nested as these are, in order of log time (ns) and arrival."""

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    records: pa.StructArray


class Tabled(NamedTuple):
    """A part of a question that has a table.

    Attributes:
        part: The part in the segments that the table covers.
        rest: The part in other segments, whose messages are all later; None if there is none.
        segments: Numbers of the segments that it covers; None for all.
    """

    table: TopicTable
    part: Part
    rest: Part | None = None
    segments: frozenset[int] | None = None


class Rows:
    """Rows for the parts of one question."""

    def __init__(self, session: Session, counters: Counters) -> None:
        self.session = session
        self._counters = counters
        self._tabled: dict[Part, Tabled | None] = {}
        self._counts: dict[Part, tuple[int, int]] = {}  # matching ones, and unreadable ones

    # The rule.

    def tabled(self, part: Part, fields: Collection[str] | None = ()) -> Tabled | None:
        """The part with its table, if that has the fields (None: all).

        Whether it decides the predicate shows when it is read.
        """
        if part not in self._tabled:
            self._tabled[part] = self._find(part)
        found = self._tabled[part]
        return found if found is not None and _holds(found, fields) else None

    def leave_table(self, part: Part) -> bool:
        """Read a part from chunks from now on; False if it is read from them already."""
        had = self._tabled.get(part) is not None
        self._tabled[part] = None
        return had

    def _find(self, part: Part) -> Tabled | None:
        asks_fields = part.predicate is not None and part.predicate.asks_fields
        if not part.is_by_log_time or (asks_fields and not part.has_fields):
            return None
        asks_publish = part.predicate is not None and "_meta.pub" in part.predicate.fields()
        if asks_publish and len({c.channel.has_publish_time for c in part.channels}) > 1:
            return None  # the table does not say which messages have one
        if any(True for _ in lost_spans(part.recording)):
            return None  # lost rows must not answer
        if part.recording.status in UNFINISHED:
            found = self._of_sealed(part)
        else:
            table = self.session.table(part.recording, part.topic)
            found = None if table is None else Tabled(table, part)
        if found is None:
            return None
        if found.table.unreadable and part.predicate is None:
            return None  # fields of such messages are not in the table
        # A table may be older than the package that reads the messages.
        is_older = not found.table.has_fields and any(c.codec.indexed for c in part.channels)
        return None if is_older else found

    def _of_sealed(self, part: Part) -> Tabled | None:
        """A part of a running recording; None if no segment has a table, or times overlap."""
        ids = [channel.channel_id for channel in part.channels]
        held = self.session.parts(part.recording, ids, (BEGIN, END))
        messages: Counter[int] = Counter()
        for segment, number in held[["segment", "messages"]].tolist():
            messages[segment] += number
        made = self.session.tables.of_sealed(part.recording, part.topic, messages)
        if made is None:
            return None
        table, segments = made
        is_sealed = np.isin(held["segment"], [*segments])
        early, late = held["last"][is_sealed], held["first"][~is_sealed]
        if not len(early) or (len(late) and early.max() >= late.min()):
            return None
        rest = _within(part, messages.keys() - segments)
        return Tabled(table, _within(part, segments), rest, segments)

    # Answers.

    def count(self, parts: Sequence[Part]) -> int:
        """Number of matching messages in all parts."""
        total = 0
        in_chunks: list[Part] = []
        self._count_by_file([part for part in parts if part.predicate is not None])
        for part in parts:
            number: int = 0
            left: Part | None = part
            with suppress(*TABLE_ERRORS):
                number, left = self._count_of(part)
            total += number
            if left is not None:
                in_chunks.append(left)
        return total + (self.count_in_chunks(in_chunks) if in_chunks else 0)

    def fitting(self, parts: Sequence[Part]) -> list[Part]:
        """The parts without those of which a file of tables tells that nothing matches."""
        asked = [part for part in parts if part.predicate is not None and not part.needs_index]
        self._count_by_file(asked)
        return [part for part in parts if self._counts.get(part) != (0, 0)]

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """For each message of the part's topic and time, whether it matches."""
        found = self.tabled(part)
        left: Part | None = part
        if found is not None:
            for rows, holds in self._answers(found):
                yield MatchColumns(rows.t, rows.seq, holds)
            left = found.rest
        if left is None:
            return
        if left.predicate is None and left.is_by_log_time:
            with suppress(SegmentError):
                time = self._times(left, self._held(left))
                left = None
        if left is None:
            yield MatchColumns(time, np.zeros_like(time), np.ones(len(time), np.bool_))
        else:
            yield from self._outcomes_in_chunks(left)

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Fields of the matching messages."""
        for found, _ in self._values(part, self.tabled(part, fields), fields):
            yield found

    def columns(
        self, part: Part, fields: Collection[str] | None, *, partial: bool = False
    ) -> Iterator[Values]:
        """The same by dotted path, as tables have them; also summaries of arrays.

        With `partial`, also of messages that have lost arrays with their payloads: null there.
        """
        from hybridlog.frames.columns import flat, with_summaries
        from hybridlog.schema.arrow_columns import structs

        summaries = summaries_in(fields, part.field_types)
        found = self.tabled(part, None if fields is None else {*fields} - summaries)
        if found is not None and not all(map(found.table.has, summaries)):
            found = None
        for (times, seq, records), left in self._values(
            part, found, fields, summaries, partial=partial
        ):
            made = {} if left is None else left.statistics(summaries)
            leaves = with_summaries(flat(records), fields, made)
            yield Values(times, seq, structs(leaves, len(times)))

    def _values(
        self,
        part: Part,
        found: Tabled | None,
        fields: Collection[str] | None,
        summaries: Collection[str] = (),
        *,
        partial: bool = False,
    ) -> Iterator[tuple[Values, LeftFields | None]]:
        """Fields of the matching messages, of a table or decoded, and what is left of them."""
        from hybridlog.schema.arrow_types import converted

        rest: Part | None = part
        if found is not None:
            kind = None if fields is None else found.table.fields(fields)
            for rows, holds in self._answers(found, fields):
                chosen = rows if holds.all() else rows.take(np.flatnonzero(holds))
                if len(chosen):
                    # Without the columns that only the predicate needs.
                    records = chosen.records
                    records = records if kind is None else converted(records, kind, drops=True)
                    yield Values(chosen.t, chosen.seq, records), None
            rest = found.rest
        arrays = {path.rpartition(".")[0] for path in summaries}
        wanted = None if fields is None else {*fields} - {*summaries} | arrays
        for channel, run in self._by_channel(self.plan([rest])) if rest is not None else ():
            decoded = channel.codec.columns_of(run.batch, wanted)
            self._counters.unreadable += len(run.batch) - len(decoded.rows)
            left: LeftFields | None = None
            if channel.is_reduced:
                from hybridlog.schema.left import LeftFields, without_lacking

                whole, lacking = without_lacking(decoded, arrays.difference(fields or ()))
                if partial:
                    self._counters.lacking += lacking
                else:
                    decoded = whole
                    self._counters.leave_out(lacking, channel.state)
                left = decoded.records if isinstance(decoded.records, LeftFields) else None
            good = decoded.rows
            yield Values(run.batch.log_time[good], run.seq[good], decoded.arrow()), left

    # Tables.

    def _count_of(self, part: Part) -> tuple[int, Part | None]:
        """Number of matching messages without reading chunks, and what is left to read."""
        if part.predicate is None:
            if part.is_unbounded:
                return part.messages, None
            return (self._count_by_time(part), None) if part.is_by_log_time else (0, part)
        found = self.tabled(part)
        if found is None:
            return 0, part
        if found.part not in self._counts:
            counts = [
                (int(h.sum()), int(r.is_unreadable().sum())) for r, h in self._in_table(found)
            ]
            self._counts[found.part] = sum(m for m, _ in counts), sum(n for _, n in counts)
        matched, unreadable = self._counts[found.part]
        self._counters.unreadable += unreadable
        return matched, found.rest

    def _answers(
        self, found: Tabled, fields: Collection[str] | None = (), own: Collection[str] = ()
    ) -> Iterator[tuple[TableRows, NDArray[np.bool_]]]:
        """Rows of a table with the outcome for each; those that are unreadable are counted."""
        for rows, holds in self._in_table(found, fields, own):
            self._counters.unreadable += int(rows.is_unreadable().sum())
            yield rows, holds

    def _count_by_file(self, parts: Sequence[Part]) -> None:
        """Count whole parts that lie in one file: the predicate is evaluated once for all rows."""
        by_file: dict[tuple[int, bool], list[Tabled]] = defaultdict(list)
        for part in parts:
            assert part.predicate is not None
            is_whole = part not in self._counts and part.is_unbounded
            if not is_whole or any(map(is_meta, part.predicate.fields())):
                continue  # known of the part, not of a row
            found = self.tabled(part)
            if found is not None and found.segments is None and len(found.table.files) == 1:
                by_file[found.table.files[0].number, found.table.has_arrays].append(found)
        for group in by_file.values():
            if len(group) > 1:
                with suppress(UndecidedError, StoreError):  # then part by part
                    self._count_in_file(group)

    def _count_in_file(self, group: Sequence[Tabled]) -> None:
        first = group[0]
        types = first.part.field_types
        file = first.table.files[0]
        whole = self.session.tables.whole(file, arrays=first.table.has_arrays)
        matched, unreadable, before = [np.zeros(1, np.int64)], [np.zeros(1, np.int64)], [0]
        alike = [(one.part, one.table) for one in group if one.part.field_types == types]
        for rows, holds in self._in_table(first, whole=whole):
            before.append(before[-1] + len(rows))
            for found, mask in ((matched, holds), (unreadable, rows.is_unreadable())):
                found.append(found[-1][-1] + np.cumsum(mask))
        sums, bad = np.concatenate(matched), np.concatenate(unreadable)
        for part, table in alike:
            places = [(before[one.group] + one.begin, one.rows) for one in table.parts]
            self._counts[part] = (
                sum(int(sums[begin + rows] - sums[begin]) for begin, rows in places),
                sum(int(bad[begin + rows] - bad[begin]) for begin, rows in places),
            )

    def _in_table(
        self,
        found: Tabled,
        fields: Collection[str] | None = (),
        own: Collection[str] = (),
        whole: TopicTable | None = None,
    ) -> Iterator[tuple[TableRows, NDArray[np.bool_]]]:
        """Rows of the part's time in its table, with the outcome for each.

        `own` are columns of the table itself; `whole` are all rows of its file, in place of its
        table. An `UndecidedError` says that the columns cannot decide.
        """
        part, table = found.part, whole or found.table
        spans = None if part.is_unbounded else [(a, b) for a, b in part.log_windows.tolist()]
        columns = {*own}
        if part.predicate is not None and "_meta.pub" in part.predicate.fields():
            columns.add("pub")
        if part.predicate is not None and part.predicate.asks_fields and table.unreadable:
            columns.add("state")
        try:
            paths = _wanted(table, part, fields)
            size = table.size(paths, own)
            self._counters.bytes_read += int(size * min(part.share * 1.2, 1.0))
            for rows in table.scan(paths, own=columns, spans=spans):
                yield rows, _decided(part, rows) & ~rows.is_unreadable()
        except StoreError:
            if whole is None:
                self.session.reject_table(part.recording, part.topic)
            raise

    # Chunks.

    def plan(
        self, parts: Sequence[Part], *, filtered: bool = True, reverse: bool = False
    ) -> ScanPlan:
        """The plan for reading messages of some parts from chunks; if `filtered`, matching ones.

        Where a table decides, it says where they are; else filters decide on what is read.
        """
        channels: list[RecordedChannel] = []
        filters: dict[int, tuple[MessageFilter, Collection[int]]] = {}
        offsets: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
        of_recording: dict[str, tuple[Part, dict[int, int]]] = {}
        for part in parts:
            _, indexes = of_recording.setdefault(part.recording.id, (part, {}))
            decide = filter_of(part) if filtered else None
            found = None if decide is None else self._placed(part, offsets)
            covered = frozenset[int]() if found is None else found.segments
            for channel in part.channels:
                indexes[channel.channel_id] = len(channels)
                if decide is not None and covered is not None:  # None: the table has all
                    filters[len(channels)] = decide, covered
                channels.append(channel)
        return ScanPlan(
            channels,
            [self._scan(part, indexes) for part, indexes in of_recording.values()],
            parts[0].clock if parts else "log",
            filters=filters,
            offsets={key: np.concatenate(own) for key, own in offsets.items()},
            is_chosen=filtered and any(part.predicate is not None for part in parts),
            reverse=reverse,
            counters=self._counters,
        )

    def _placed(
        self, part: Part, offsets: dict[ChunkKey, list[NDArray[np.int64]]]
    ) -> Tabled | None:
        """The part with its table, which has added the places of its matching messages."""
        found = self.tabled(part)
        if found is None:
            return None
        unreadable = self._counters.unreadable
        try:
            places = [
                places_of(rows.own["ref"])[holds]
                for rows, holds in self._answers(found, own=("ref",))
            ]
        except TABLE_ERRORS:
            self._counters.unreadable = unreadable
            self.leave_table(part)
            return None
        if places:
            by_chunk = offsets_by_chunk(part.recording.id, np.concatenate(places))
            for key, own in by_chunk.items():
                offsets[key].append(own)
        return found

    def _scan(self, part: Part, indexes: dict[int, int]) -> RecordingScan:
        """The chunks of a recording that may hold wanted messages."""
        bounds, clock = part.bounds, part.clock
        if part.windows is not None and part.is_by_log_time:
            bounds, clock = part.log_span, "log"
        is_empty = bounds is not None and bounds[0] >= bounds[1]
        chunks = (
            [] if is_empty else self.session.chunks(part.recording, list(indexes), bounds, clock)
        )
        self.session.hold(part.recording, {chunk.segment for chunk in chunks})
        return RecordingScan(part.recording, indexes, part.bounds, chunks, part.windows)

    def count_in_chunks(self, parts: Sequence[Part]) -> int:
        """Read the messages of some parts and count those that match."""
        scan = ChunkScan(self.plan(parts), self.session)
        return sum(len(run.batch) for _, run, _ in scan.loaded())

    def _outcomes_in_chunks(self, part: Part) -> Iterator[MatchColumns]:
        """Read the messages in order and decide on each."""
        from hybridlog.index.indexing import rows_by_channel

        plan, decide = self.plan([part], filtered=False), filter_of(part)
        for run in ChunkScan(plan, self.session).runs():
            holds = np.ones(len(run.batch), np.bool_)
            for index, rows in rows_by_channel(run.batch.channel) if decide is not None else ():
                assert decide is not None
                found = decide.matches(plan.channels[index], run.batch.take(rows), run.seq[rows])
                holds[rows] = found.holds
                self._counters.unreadable += found.unreadable
                self._counters.without_arrays += found.expired
            yield MatchColumns(run.batch.log_time, run.seq, holds)

    def _by_channel(self, plan: ScanPlan) -> Iterator[tuple[RecordedChannel, MessageRun]]:
        """The messages of a plan with fields in order, those of one channel at a time."""
        for run in ChunkScan(plan, self.session).runs():
            changes = np.flatnonzero(np.diff(run.batch.channel)) + 1
            for own in map(run.take, np.split(np.arange(len(run.batch)), changes)):
                channel = plan.channels[int(own.batch.channel[0])]
                if len(own.batch):
                    yield channel, own

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
            reader = self.session.segment(part.recording.id, segment)
            read_before = reader.bytes_read
            found.append(self.session.times(part.recording, segment, chunk)[channel])
            self._counters.bytes_read += reader.bytes_read - read_before
        time = np.sort(np.concatenate(found))
        return time[inside(time, part.log_windows)]

    def _held(self, part: Part) -> NDArray[np.void]:
        """Messages of a part in chunks, as of `Session.parts`."""
        ids = [channel.channel_id for channel in part.channels]
        return self.session.parts(part.recording, ids, part.log_span)


def _within(part: Part, segments: Collection[int]) -> Part:
    """A part in some segments of its recording; statistics are those of all."""
    spans = [span for span in part.recording.spans if span[0] in segments]
    return replace(part, recording=replace(part.recording, spans=spans))


def summaries_in(fields: Collection[str] | None, types: Mapping[str, str] | None) -> set[str]:
    """The paths among some fields that are summaries of arrays."""
    from hybridlog.frames.names import is_summary  # a count needs no frames

    return {path for path in fields or () if is_summary(path, types or {})}


def filter_of(part: Part) -> MessageFilter | None:
    """Decides the predicate of a part on messages; None without one."""
    if part.predicate is None:
        return None
    from hybridlog.query.message_filter import MessageFilter

    return MessageFilter(part.predicate, part.field_types)


def places_of(references: Any) -> NDArray[np.int64]:
    """Segment, chunk and payload offset of messages, int64[n, 3], from a table's column `ref`."""
    columns = [references.field(n).to_numpy(zero_copy_only=False) for n in ("seg", "chunk", "off")]
    return np.stack(columns, axis=1).astype(np.int64)


def offsets_by_chunk(
    recording: str, places: NDArray[np.int64]
) -> dict[ChunkKey, NDArray[np.int64]]:
    """Payload offsets of messages by chunk, sorted; places are as of `places_of`, in any order."""
    places = places[np.lexsort((places[:, 2], places[:, 1], places[:, 0]))]
    edges = np.flatnonzero(np.any(places[1:, :2] != places[:-1, :2], axis=1)) + 1
    return {
        (recording, int(group[0, 0]), int(group[0, 1])): group[:, 2]
        for group in np.split(places, edges)
        if len(group)
    }


def _decided(part: Part, rows: TableRows) -> NDArray[np.bool_]:
    predicate = part.predicate
    if predicate is None:
        return np.ones(len(rows), np.bool_)
    from hybridlog.query.message_filter import mask_of

    times = rows.t, rows.seq, rows.own.get("pub")
    found = mask_of(predicate, part.field_types, rows.records, part.channels[0], *times)
    if found is None:
        raise UndecidedError(f"The table of {part.topic} cannot tell.")
    return found


def _holds(found: Tabled, fields: Collection[str] | None) -> bool:
    """True if a table holds some fields, or all, in full: no array that may be a summary."""
    types = found.part.field_types
    if types is None:
        return fields is not None and not fields
    above = {path[: mark.start()] for path in types for mark in _MARK.finditer(path)}
    below = [*types]
    if fields is not None:
        begins = tuple(f"{field}{mark}" for field in fields for mark in ".[")
        below = [path for path in types if path in fields or path.startswith(begins)]
        if not all(field in above or field in types for field in fields):
            return False
    for name in below:
        kind, width, element = types[name], width_of(types[name]), element_of(types[name])
        is_short = width is not None and width <= _WHOLE and element in SINGLE
        has_fields = name in above
        is_full = found.table.has_arrays and (element in _IN_FULL or (has_fields and element))
        if not (kind in SINGLE or is_short or is_full) and not (has_fields and element is None):
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
