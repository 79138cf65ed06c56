"""The log time of the next message, mostly without reading it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from hybridlog.session import Session
    from hybridlog_storage.catalog import ChunkEntry, RecordingEntry
    from hybridlog_storage.chunk import StoredChunk

_FIRST_LOOK: Final = 1 << 30  # ns, about a second


def next_time(session: Session, recording: RecordingEntry, topic: str, moment: int) -> int | None:
    """The least log time of a topic's messages that is not before a time, ns; None without any.

    Chunks tell it, but for those that hold the time itself. Damaged ones are left out.

    Args:
        session: The open store.
        recording: The recording.
        topic: Full name.
        moment: The time, ns.
    """
    channels = [c.channel_id for c in session.channels(recording) if c.channel.topic == topic]
    if recording.span is None or not channels:
        return None
    first, last = recording.span
    moment = max(moment, first)
    width = _FIRST_LOOK
    while True:
        end = moment + width
        found: int | None = None
        for entry in session.chunks(recording, channels, (moment, end), "log"):
            time = _in_chunk(session, recording, entry, channels, moment)
            if time is not None and (found is None or time < found):
                found = time
        # Chunks that were not looked at hold nothing before the end.
        if found is not None and found < end:
            return found
        if end > last:
            return None
        width *= 4


def _in_chunk(
    session: Session,
    recording: RecordingEntry,
    entry: ChunkEntry,
    channels: list[int],
    moment: int,
) -> int | None:
    spans = [
        (stats.first, stats.last)
        for stats in entry.stats_of(channels)
        if stats.first is not None and stats.last is not None
    ]
    later = [first for first, last in spans if last >= moment]
    if not later or min(later) >= moment:
        return min(later, default=None)

    def load() -> StoredChunk:
        return session.segment(recording.id, entry.segment).read_chunk(entry.place)

    key = recording.id, entry.segment, entry.number
    try:
        batch = session.recent_chunks.get(key, load).batch
    except SegmentError:
        return None
    times = batch.log_time[np.isin(batch.channel, channels) & (batch.log_time >= moment)]
    return int(times.min()) if len(times) else None
