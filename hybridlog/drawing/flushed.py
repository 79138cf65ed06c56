"""Messages that a running recording has flushed, and that queries do not see yet.

A query sees sealed segments. Here a segment is read while it is written, as far as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import pyarrow as pa

from hybridlog.frames.columns import flat, with_summaries
from hybridlog.frames.names import FIELD
from hybridlog.indexing import rows_by_channel
from hybridlog.message import messages_in
from hybridlog.query.chunk_scan import MessageRun
from hybridlog.query.question import RecordedChannel
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.open_segment import OpenSegment, open_segment

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog.query.question import Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.segment_reader import ChunkPlace


END: Final = 1 << 63
"""Later than any log time, ns."""
_RECORDINGS: Final = 4  # that are followed


class _Chunk(NamedTuple):
    """A chunk with messages of the topic, and their least and greatest log time, ns."""

    segment: OpenSegment
    place: ChunkPlace
    first: int
    last: int


class _Segment:
    """A segment and, for each of its chunks, least and greatest log time by channel, ns."""

    def __init__(self, opened: OpenSegment) -> None:
        self.opened = opened
        self.spans: list[dict[int, Span]] = []

    def advance(self) -> None:
        """See the chunks that were written since."""
        with suppress(SegmentError):  # the file was removed
            self.opened.advance()
        for place in self.opened.chunks[len(self.spans) :]:
            times: dict[int, NDArray[np.int64]] = {}
            with suppress(SegmentError):  # it is in the ledger when its segment is sealed
                times = self.opened.read_times(place)
            found = {n: (int(own[0]), int(own[-1])) for n, own in times.items() if len(own)}
            self.spans.append(found)


class FlushedMessages:
    """Follows the segments that running recordings write. Thread safe.

    Args:
        session: The open store.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._segments: dict[str, dict[int, _Segment]] = {}
        self._lock = threading.Lock()

    def of(self, recording: RecordingEntry, topic: str) -> Flushed:
        """The flushed messages of a topic, as they are now.

        Args:
            recording: The recording; nothing is flushed of one that has ended.
            topic: Full name.
        """
        with self._lock:
            segments = self._follow(recording)
            return Flushed(recording, topic, segments)

    def _follow(self, recording: RecordingEntry) -> list[_Segment]:
        """The segments that the entry does not have yet, also those sealed since."""
        known = self._segments.pop(recording.id, {})
        if recording.status != "open":
            return []
        folder = self._session.directory.recording(recording.label)
        listing = self._session.directory.listing(recording.label)
        found: dict[int, _Segment] = {}
        for number, name in sorted({**listing.open, **listing.sealed}.items()):
            if str(number) in recording.digests:
                continue
            segment = known.get(number)
            if segment is None:
                opened = None
                with suppress(SegmentError):  # its head may not be written yet
                    opened = open_segment(folder / name, number)
                if opened is None:
                    continue
                segment = _Segment(opened)
            segment.advance()
            found[number] = segment
        self._segments[recording.id] = found
        while len(self._segments) > _RECORDINGS:
            self._segments.pop(next(iter(self._segments)))
        return list(found.values())


class Flushed:
    """The flushed messages of one topic of a running recording at one moment.

    Args:
        recording: The recording.
        topic: Full name.
        segments: The segments that queries do not see yet.

    Attributes:
        channels: Channels of the topic.
        count: Number of messages.
    """

    def __init__(self, recording: RecordingEntry, topic: str, segments: Sequence[_Segment]) -> None:
        defined: dict[int, RecordedChannel] = {}
        for segment in segments:
            for number, channel in segment.opened.channels.items():
                if channel.topic == topic:
                    found = RecordedChannel(recording, number, channel, ChannelStats(), None)
                    defined.setdefault(number, found)
        self._ids = np.array(sorted(defined), np.int64)
        self.channels: Sequence[RecordedChannel] = [defined[n] for n in sorted(defined)]
        self.count = sum(segment.opened.messages[n] for segment in segments for n in defined)
        chunks = []
        for segment in segments:
            for place, spans in zip(segment.opened.chunks, segment.spans, strict=False):
                own = [spans[n] for n in defined if n in spans]
                if own:
                    first, last = min(begin for begin, _ in own), max(end for _, end in own)
                    chunks.append(_Chunk(segment.opened, place, first, last))
        self._chunks = sorted(chunks, key=lambda chunk: chunk.first)

    @property
    def span(self) -> Span | None:
        """Log time `[begin, end)` of all messages, ns; None without any."""
        chunks = self._chunks
        return (chunks[0].first, max(c.last for c in chunks) + 1) if chunks else None

    def runs(self, span: Span, *, reverse: bool = False) -> Iterator[MessageRun]:
        """The messages with a log time in `[begin, end)`, ns, in order, some at a time.

        Chunks that a writer has removed or damaged since are left out.
        """
        groups = self._groups(span)
        for group in reversed(groups) if reverse else groups:
            parts = [part for chunk in group if (part := self._read(chunk, span)) is not None]
            if len(parts) == 1:
                yield _ordered(parts[0], reverse=reverse)
            elif parts:
                yield from _merged(parts, reverse=reverse)

    def messages(self, span: Span, *, reverse: bool = False) -> Iterator[Message]:
        """The same, one by one."""
        for run in self.runs(span, reverse=reverse):
            yield from messages_in(run)

    def tables(self, fields: Sequence[str], span: Span) -> Iterator[pa.Table]:
        """Fields of the same messages, with a column `log_time`; others are named by metadata.

        Messages that cannot be read are left out.

        Args:
            fields: Paths, also of summaries.
            span: Log time `[begin, end)`, ns.
        """
        for run in self.runs(span):
            for number, rows in rows_by_channel(run.batch.channel):
                batch = run.batch.take(rows)
                codec = self.channels[number].codec
                decoded = codec.arrow(batch.buffer, batch.offset, batch.length, None)
                leaves = with_summaries(flat(decoded.records), fields)
                times = pa.array(batch.log_time[decoded.rows], pa.timestamp("ns"))
                schema = [pa.field("log_time", times.type)] + [
                    pa.field(f"_{n}", array.type, metadata={FIELD: path.encode()})
                    for n, (path, array) in enumerate(leaves.items())
                ]
                yield pa.table([times, *leaves.values()], schema=pa.schema(schema))

    def _groups(self, span: Span) -> list[list[_Chunk]]:
        """Chunks whose times overlap, together."""
        found: list[list[_Chunk]] = []
        latest = -1
        for chunk in self._chunks:
            if chunk.last < span[0] or chunk.first >= span[1]:
                continue
            if found and chunk.first <= latest:
                found[-1].append(chunk)
            else:
                found.append([chunk])
            latest = max(latest, chunk.last)
        return found

    def _read(self, chunk: _Chunk, span: Span) -> MessageRun | None:
        try:
            stored = chunk.segment.reader.read_chunk(chunk.place)
        except SegmentError:
            return None
        times = stored.batch.log_time
        is_wanted = np.isin(stored.batch.channel, self._ids)
        rows = np.flatnonzero(is_wanted & (times >= span[0]) & (times < span[1]))
        batch = stored.batch.take(rows)
        batch.channel = np.searchsorted(self._ids, batch.channel).astype(np.int32)
        return MessageRun(batch, stored.seq[rows], self.channels)


def _ordered(run: MessageRun, *, reverse: bool) -> MessageRun:
    order = np.lexsort((run.seq, run.batch.log_time))
    return run.take(order[::-1] if reverse else order)


def _merged(parts: Sequence[MessageRun], *, reverse: bool) -> Iterator[MessageRun]:
    """The messages of several chunks in order, as runs of one message or more of one chunk."""
    part = np.repeat(np.arange(len(parts)), [len(run.seq) for run in parts])
    row = np.concatenate([np.arange(len(run.seq)) for run in parts])
    times = np.concatenate([run.batch.log_time for run in parts])
    order = np.lexsort((np.concatenate([run.seq for run in parts]), times))
    order = order[::-1] if reverse else order
    begins = np.flatnonzero(np.diff(part[order])) + 1
    for piece in np.split(order, begins):
        if len(piece):
            yield parts[part[piece[0]]].take(row[piece])
