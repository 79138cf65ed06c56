"""Marks: events as messages on a topic of their own, for use in questions.

Those that somebody set are lines of the manifest. Questions find them as one more segment, a log in
memory beside the files; tables and the index, which are derived from files, never have them.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace

from hybridlog_storage.catalog import RecordingEntry, channel_entry, channel_totals
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import Mark, hasher
from hybridlog_storage.messages import MARKS_CHANNEL, Batch, Channel, Schema
from hybridlog_storage.segments.chunk import StoredChunk
from hybridlog_storage.segments.chunk_table import CHUNK, PART, ChunkPlace, ChunkTable, parts_of
from hybridlog_storage.segments.segment_format import index_order
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.walk import Flushed

if TYPE_CHECKING:
    from numpy.typing import NDArray


MARKS: Final = "/hybridlog/marks"
"""Topic of marks."""
CLOCK_SET: Final = "clock"
"""Tag `cause` of marks that a recorder sets when the clock of its machine was set."""
CONTRACT: Final = "contract"
"""Tag `cause` of marks that a recorder sets while a contract is broken."""
MARK: Final = "hybridlog.Mark"
"""Type of marks."""
MARKS_SEGMENT: Final = 10**9
"""Number of the log in memory with the marks that somebody set, behind those of all files."""
_ARRIVALS: Final = 1 << 52  # the first arrival number, behind those of all messages
MARK_SCHEMA: Final = Schema(
    MARK,
    "jsonschema",
    b'{"type":"object","properties":{"text":{"type":"string"},'
    b'"tags":{"type":"object","additionalProperties":{"type":"string"}},'
    b'"end":{"type":"integer"}}}',
)


MARK_CHANNEL: Final = Channel(MARKS, "json", MARK_SCHEMA)
"""The channel of marks."""


def mark_payload(text: str, tags: Mapping[str, str], end: int | None = None) -> bytes:
    """A mark as a message, whose log time is the mark's beginning.

    Args:
        text: What happened.
        tags: Tags.
        end: Log time of its end, ns; None for a moment.
    """
    until = {} if end is None else {"end": end}
    content = json.dumps({"text": text, "tags": dict(tags), **until}, ensure_ascii=False)
    # Bytes that are not UTF-8 appear in it as JSON's own escapes.
    return content.encode("utf-8", "backslashreplace")


class _MarksLog(SegmentReader):
    """Reads marks as a chunk of messages; `flushed` is what the log has."""

    def __init__(self, marks: Sequence[Mark]) -> None:
        self.path, self.number = Path(MARKS), MARKS_SEGMENT
        self.size = self.bytes_read = 0
        self._fd = -1
        said = [mark_payload(one.text, one.tags, one.end) for one in marks]
        time = np.array([one.time for one in marks], np.int64)
        length = np.fromiter(map(len, said), np.int64, len(said))
        channel = np.full(len(marks), MARKS_CHANNEL, np.int32)
        zeros = np.zeros(len(marks), np.uint32)
        offset = length.cumsum() - length
        buffer = b"".join(said)
        self._batch = batch = Batch(buffer, offset, length, channel, time, time, zeros)
        # Other marks have another place, so what was read before is never taken for them.
        self._place = int(hasher(buffer + time.tobytes()).hexdigest()[:15], 16)
        chunks, parts = np.zeros(0, CHUNK), np.zeros(0, PART)
        if marks:
            parts, *span = parts_of(batch, index_order(channel, time))
            chunks = np.array([(self._place, 0, 0, *span, 1)], CHUNK)
        self.flushed = Flushed(ChunkTable(chunks, parts), (), (), self)

    def read_chunk(self, place: ChunkPlace) -> StoredChunk:
        """The marks; `SegmentError` if they were changed."""
        if place.offset != self._place:
            raise SegmentError("Marks were set or removed meanwhile. Ask again.")
        seq = _ARRIVALS + np.arange(len(self._batch))
        return StoredChunk(MARKS_SEGMENT, place, replace(self._batch), seq)

    def read_times(self, place: ChunkPlace) -> dict[int, NDArray[np.int64]]:
        """Their log times, as of a segment."""
        return {MARKS_CHANNEL: np.sort(self.read_chunk(place).batch.log_time)}

    def fetch(self, places: Iterable[ChunkPlace]) -> None:
        """Do nothing: they are in memory."""


def with_marks(entry: RecordingEntry) -> RecordingEntry:
    """The entry of a recording's files, and of the marks that somebody set."""
    if not entry.manifest.marks:
        return entry
    flushed = _MarksLog(entry.manifest.marks).flushed
    channel = channel_entry(MARKS_CHANNEL, replace(MARK_CHANNEL, is_indexed=False))
    channel.stats = channel_totals(flushed.table)[MARKS_CHANNEL]
    span = int(flushed.table.parts["first"].min()), int(flushed.table.parts["last"].max())
    return replace(
        entry,
        channels=[*entry.channels, channel],
        spans=[*entry.spans, (MARKS_SEGMENT, *span)],
        flushed={**entry.flushed, MARKS_SEGMENT: flushed},
    )


def without_marks(entry: RecordingEntry, known: Collection[str]) -> RecordingEntry:
    """The entry without the marks of some ids, which have been told before."""
    left = [one for one in entry.manifest.marks if one.id not in known]
    return replace(entry, flushed={**entry.flushed, MARKS_SEGMENT: _MarksLog(left).flushed})
