"""Answers by reading and decoding messages."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.chunk_scan import ChunkScan, RecordingScan, RowSelection, ScanPlan
from hybridlog.query.engines import MatchColumns, Need, Values
from hybridlog.schema.codec import columns_of

if TYPE_CHECKING:
    from hybridlog.query.chunk_scan import ChunkTask, MessageRun
    from hybridlog.query.counters import Counters
    from hybridlog.query.engines import Objects
    from hybridlog.query.message_filter import MessageFilter
    from hybridlog.query.question import Part, RecordedChannel
    from hybridlog.schema.codec import Decoded
    from hybridlog.session import Session
    from hybridlog_storage.messages import Batch

_START_S = 1e-3  # seconds to start
_CHUNK_S = 5e-4  # seconds to read a chunk with other topics in it
_BYTE_S = 2e-9  # seconds to read and decompress a byte
_ROW_S = 1.5e-6  # seconds to decode a message by columns
_OBJECT_S = 20e-6  # seconds to make a Python object of a message
_BY_COLUMNS = {"ros1", "cdr"}


class PayloadScan:
    """Reads the chunks of the parts; needs only the segments."""

    def __init__(self, session: Session, counters: Counters) -> None:
        self.session = session
        self._counters = counters

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float:
        """By chunks, bytes and messages."""
        size = sum(stats.payload_bytes for stats in part.stats)
        encodings = {channel.encoding for channel in part.channels}
        message_s = _ROW_S if encodings <= _BY_COLUMNS else _OBJECT_S
        each = _BYTE_S * size + message_s * part.messages
        return _START_S + _CHUNK_S * part.chunks + part.share * each

    def count(self, parts: Sequence[Part]) -> int:
        """Read the messages and count those that match."""
        scan = ChunkScan(self.plan(parts), self.session)
        return sum(len(run.batch) for run in scan.unordered())

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """Read the messages in order and decide on each."""
        from hybridlog.index.indexing import rows_by_channel

        plan = self.plan([part], filtered=False)
        decide = _filter_of(part)
        for run in ChunkScan(plan, self.session).runs():
            holds = np.ones(len(run.batch), np.bool_)
            if decide is not None:
                for index, rows in rows_by_channel(run.batch.channel):
                    found = decide.matches(
                        plan.channels[index], run.batch.take(rows), run.seq[rows]
                    )
                    holds[rows] = found.holds
                    self._counters.unreadable += found.unreadable
                    self._counters.without_arrays += found.expired
            yield MatchColumns(run.batch.log_time, run.seq, holds)

    def values(self, part: Part, fields: Collection[str] | None) -> Iterator[Values]:
        """Read the messages that match in order and decode the fields."""
        return self.values_of(self.plan([part]), fields)

    def values_of(self, plan: ScanPlan, fields: Collection[str] | None) -> Iterator[Values]:
        """Fields of the messages of a plan, in order."""
        for channel, run in self._by_channel(plan):
            batch = run.batch
            decoded = self._decoded(channel, batch, fields)
            good = decoded.rows
            yield Values(batch.log_time[good], run.seq[good], decoded.arrow())

    def objects_of(self, plan: ScanPlan) -> Iterator[Objects]:
        """The messages of a plan as plain objects, in order."""
        for channel, run in self._by_channel(plan):
            batch = run.batch
            found = self._decoded(channel, batch)
            yield batch.log_time[found.rows], found.plain()

    def _decoded(
        self, channel: RecordedChannel, batch: Batch, fields: Collection[str] | None = None
    ) -> Decoded:
        """The fields of messages; those that cannot be read, or lack some, are counted."""
        found = columns_of(channel.codec, batch, fields)
        self._counters.unreadable += len(batch) - len(found.rows)
        if channel.is_expired:
            from hybridlog.schema.left import without_lacking

            found, lacking = without_lacking(found)
            self._counters.leave_out(lacking, channel.state)
        return found

    def _by_channel(self, plan: ScanPlan) -> Iterator[tuple[RecordedChannel, MessageRun]]:
        """The messages of a plan with fields in order, those of one channel at a time."""
        for run in ChunkScan(plan, self.session).runs():
            changes = np.flatnonzero(np.diff(run.batch.channel)) + 1
            for own in map(run.take, np.split(np.arange(len(run.batch)), changes)):
                channel = plan.channels[int(own.batch.channel[0])]
                if not channel.is_typed:
                    self._counters.reduced += len(own.batch)
                elif len(own.batch):
                    yield channel, own

    def select(self, parts: Sequence[Part], tasks: Sequence[ChunkTask]) -> RowSelection:
        """No selection: nothing is known before the messages are read."""
        return RowSelection({})

    def plan(self, parts: Sequence[Part], *, filtered: bool = True) -> ScanPlan:
        """The plan for reading some parts."""
        channels: list[RecordedChannel] = []
        filters: dict[int, MessageFilter] = {}
        of_recording: dict[str, tuple[Part, dict[int, int]]] = {}
        for part in parts:
            _, indexes = of_recording.setdefault(part.recording.id, (part, {}))
            decide = _filter_of(part) if filtered else None
            for channel in part.channels:
                indexes[channel.channel_id] = len(channels)
                if decide is not None:
                    filters[len(channels)] = decide
                channels.append(channel)
        scans = [self._scan(part, indexes) for part, indexes in of_recording.values()]
        clock = parts[0].clock if parts else "log"
        return ScanPlan(channels, scans, clock, filters=filters, counters=self._counters)

    def _scan(self, part: Part, indexes: dict[int, int]) -> RecordingScan:
        """The chunks of a recording that may hold wanted messages."""
        bounds, clock = part.bounds, part.clock
        if part.windows is not None and part.is_by_log_time:
            windows = part.log_windows
            bounds, clock = (0, 0), "log"
            if len(windows):
                bounds = int(windows[0, 0]), int(windows[-1, 1])
        is_empty = bounds is not None and bounds[0] >= bounds[1]
        chunks = (
            [] if is_empty else self.session.chunks(part.recording, list(indexes), bounds, clock)
        )
        return RecordingScan(part.recording, indexes, part.bounds, chunks, part.windows)


def _filter_of(part: Part) -> MessageFilter | None:
    if part.predicate is None:
        return None
    from hybridlog.query.message_filter import MessageFilter

    return MessageFilter(part.predicate, part.field_types)
