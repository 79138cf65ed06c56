"""Answers about running recordings: by tables of sealed segments, by messages of the others."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.query.chunk_scan import RowSelection
from hybridlog.query.engines import MatchColumns, Need, Values
from hybridlog.query.engines.payload_scan import PayloadScan
from hybridlog.query.engines.tables import TablesEngine
from hybridlog.query.message_filter import MessageFilter
from hybridlog.snapshot import UNFINISHED
from hybridlog_storage.catalog import ChannelStats, channel_totals

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.topic_table import TopicTable
    from hybridlog.query.chunk_scan import ChunkKey, ChunkTask
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part
    from hybridlog.session import Session


class _Halves(NamedTuple):
    """A part in two: the segments that have tables, and later ones.

    Attributes:
        sealed: The part in the segments with tables.
        rest: The part in the others; all its messages are later.
        segments: Numbers of the segments with tables.
    """

    sealed: Part
    rest: Part
    segments: frozenset[int]


class RunningTables:
    """Reads tables where segments are sealed, and messages where they are not."""

    def __init__(self, session: Session, counters: Counters) -> None:
        self._session = session
        self._counters = counters
        self._made: dict[Part, TopicTable] = {}
        self._halves: dict[Part, _Halves | None] = {}
        self._tables = TablesEngine(session, counters, self._made.get)
        self._scan = PayloadScan(session, counters)

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """The cost of both halves; None for ended recordings, and if no table can tell."""
        if part.recording.status not in UNFINISHED or not part.is_by_log_time:
            return None
        if part not in self._halves:
            self._halves[part] = self._split(part)
        halves = self._halves[part]
        if halves is None:
            return None
        of_tables = self._tables.cost(halves.sealed, need, fields)
        of_rest = self._scan.cost(halves.rest, need, fields)
        return None if of_tables is None or of_rest is None else of_tables + of_rest

    def count(self, parts: Sequence[Part]) -> int:
        """The count of both halves."""
        halves = [self._of(part) for part in parts]
        sealed = self._tables.count([one.sealed for one in halves])
        return sealed + sum(self._scan.count([one.rest]) for one in halves)

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """The outcomes of both halves."""
        halves = self._of(part)
        return chain(self._tables.outcomes(halves.sealed), self._scan.outcomes(halves.rest))

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """The fields of both halves."""
        halves = self._of(part)
        return chain(
            self._tables.values(halves.sealed, fields), self._scan.values(halves.rest, fields)
        )

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """References by tables; chunks of other segments are read and decided on."""
        halves = [self._of(part) for part in parts]
        found = dict(self._tables.select([one.sealed for one in halves], tasks).offsets)
        rest: dict[ChunkKey, list[NDArray[np.int64]]] = defaultdict(list)
        for part, own in zip(parts, halves, strict=True):
            assert part.predicate is not None
            decide = MessageFilter(part.predicate, part.field_types)
            for task in tasks:
                is_own = task.scan.recording.id == part.recording.id
                if not is_own or task.chunk.segment in own.segments:
                    continue
                chunk = self._session.read_chunk(*task.key[:2], task.chunk.place)
                for channel in part.channels:
                    rows = np.flatnonzero(chunk.batch.channel == channel.channel_id)
                    if len(rows):
                        batch = chunk.batch.take(rows)
                        matches = decide.matches(channel, batch, chunk.seq[rows])
                        self._counters.unreadable += matches.unreadable
                        self._counters.without_arrays += matches.expired
                        rest[task.key].append(batch.places[0][matches.holds])
        found |= {key: np.sort(np.concatenate(offsets)) for key, offsets in rest.items()}
        return RowSelection(found)

    def check(self, part: Part) -> int:
        """Confirm that the tables can decide; see `TablesEngine.check`."""
        return self._tables.check(self._of(part).sealed)

    def _of(self, part: Part) -> _Halves:
        halves = self._halves[part]
        assert halves is not None
        return halves

    def _split(self, part: Part) -> _Halves | None:
        """The part in two; None if no segment has a table, or if their times overlap."""
        entry = part.recording
        ids = [channel.channel_id for channel in part.channels]
        stats: dict[int, dict[int, ChannelStats]] = {}
        for number, _, _ in entry.spans_with(ids):
            table = self._session.chunk_table(entry, number)
            rows = table.parts[np.isin(table.parts["channel"], ids)]
            stats[number] = channel_totals(replace(table, parts=rows), None)
        messages = {n: sum(one.messages for one in own.values()) for n, own in stats.items()}
        made = self._session.tables.of_sealed(entry, part.topic, Counter(messages))
        if made is None:
            return None
        table_of_topic, segments = made
        sealed = _within(part, stats, segments)
        rest = _within(part, stats, stats.keys() - segments)
        lasts = [one.last for one in sealed.stats if one.last is not None]
        firsts = [one.first for one in rest.stats if one.first is not None]
        if not lasts or (firsts and max(lasts) >= min(firsts)):
            return None
        self._made[sealed] = table_of_topic
        return _Halves(sealed, rest, segments)


def _within(
    part: Part, stats: dict[int, dict[int, ChannelStats]], segments: Collection[int]
) -> Part:
    """A part in some segments of its recording.

    Args:
        part: The part.
        stats: Statistics of its channels in each segment, by number and id.
        segments: Numbers of the segments.
    """
    totals = {channel.channel_id: ChannelStats() for channel in part.channels}
    for number in segments:
        for channel_id, own in stats.get(number, {}).items():
            totals[channel_id].add(own)
    spans = [span for span in part.recording.spans if span[0] in segments]
    recording = replace(part.recording, spans=spans)
    channels = tuple(
        replace(channel, recording=recording, stats=totals[channel.channel_id])
        for channel in part.channels
    )
    return replace(part, recording=recording, channels=channels)
