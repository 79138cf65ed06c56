"""The marks that somebody set, as messages: a log in memory beside the files of a recording.

Marks are lines of the manifest. Questions find them as one more segment; tables and the index,
which are derived from files, never have them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace

from hybridlog.record.marks import MARKS, MARKS_SEGMENT, mark_channel, mark_payload
from hybridlog_storage.catalog import channel_entry, channel_totals
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import hasher
from hybridlog_storage.messages import MARKS_CHANNEL, Batch
from hybridlog_storage.segments.chunk import StoredChunk
from hybridlog_storage.segments.chunk_table import CHUNK, PART, ChunkTable
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.walk import Flushed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.manifest import Mark
    from hybridlog_storage.segments.chunk_table import ChunkPlace

_ARRIVALS: Final = 1 << 52  # the first arrival number, behind those of all messages
_CHUNK: Final = 1000  # marks


class _MarksLog(SegmentReader):
    """Reads marks as chunks of messages.

    Args:
        marks: The marks.

    Attributes:
        flushed: What the log has.
    """

    def __init__(self, marks: Sequence[Mark]) -> None:
        self.path, self.number = Path(MARKS), MARKS_SEGMENT
        self.size = self.bytes_read = 0
        self._fd = -1
        self._chunks = [marks[at : at + _CHUNK] for at in range(0, len(marks), _CHUNK)]
        chunks, parts = (np.zeros(len(self._chunks), dtype) for dtype in (CHUNK, PART))
        digest = hasher()
        for row, own in enumerate(self._chunks):
            for one in own:
                digest.update(one.id.encode())
            # Other marks have other places, so what was read before is never taken for them.
            chunks["offset"][row] = int(digest.hexdigest()[:15], 16)
            parts["payload_bytes"][row] = sum(map(len, _payloads(own)))
            for edge, choose in (("first", min), ("last", max)):
                parts[edge][row] = chunks[edge][row] = choose(one.time for one in own)
                parts[f"{edge}_publish"][row] = chunks[edge][row]
        chunks["parts"] = 1
        parts["channel"] = MARKS_CHANNEL
        parts["messages"] = [*map(len, self._chunks)]
        table = ChunkTable(chunks, parts)
        self.flushed = Flushed(table, (), (), self)

    def read_chunk(self, place: ChunkPlace) -> StoredChunk:
        """Some marks.

        Raises:
            SegmentError: They were changed.
        """
        offsets = self.flushed.table.chunks["offset"].tolist()
        if place.offset not in offsets[place.number : place.number + 1]:
            raise SegmentError("Marks were set or removed meanwhile. Ask again.")
        own = self._chunks[place.number]
        payloads, times = _payloads(own), np.array([one.time for one in own], np.int64)
        lengths = [*map(len, payloads)]
        batch = Batch(
            b"".join(payloads),
            np.array([0, *accumulate(lengths[:-1])], np.int64),
            np.array(lengths, np.int64),
            np.full(len(own), MARKS_CHANNEL, np.int32),
            times,
            times,
            np.zeros(len(own), np.uint32),
        )
        seq = _ARRIVALS + place.number * _CHUNK + np.arange(len(own))
        return StoredChunk(MARKS_SEGMENT, place, batch, seq)

    def read_times(self, place: ChunkPlace) -> dict[int, NDArray[np.int64]]:
        """Their log times, as of a segment."""
        return {MARKS_CHANNEL: np.sort(self.read_chunk(place).batch.log_time)}

    def fetch(self, places: Iterable[ChunkPlace]) -> None:
        """Do nothing: they are in memory."""


def _payloads(marks: Iterable[Mark]) -> list[bytes]:
    return [mark_payload(one.text, one.tags, one.end) for one in marks]


def beside(entry: RecordingEntry) -> RecordingEntry:
    """The entry of a recording's files, and of its marks."""
    flushed = _MarksLog(entry.manifest.marks).flushed
    channel = channel_entry(MARKS_CHANNEL, replace(mark_channel(), is_indexed=False))
    channel.stats = channel_totals(flushed.table)[MARKS_CHANNEL]
    span = int(flushed.table.parts["first"].min()), int(flushed.table.parts["last"].max())
    return replace(
        entry,
        channels=[*entry.channels, channel],
        spans=[*entry.spans, (MARKS_SEGMENT, *span)],
        flushed={**entry.flushed, MARKS_SEGMENT: flushed},
    )


def without(entry: RecordingEntry, known: Collection[str]) -> RecordingEntry:
    """The entry without the marks of some ids, which have been told before."""
    left = [one for one in entry.manifest.marks if one.id not in known]
    return replace(entry, flushed={**entry.flushed, MARKS_SEGMENT: _MarksLog(left).flushed})
