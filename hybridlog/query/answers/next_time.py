"""The log time of the next message, without reading messages."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry

_FIRST_LOOK: Final = 1 << 30  # ns, about a second


def next_time(session: Session, recording: RecordingEntry, topic: str, moment: int) -> int | None:
    """The least log time of a topic's messages that is not before a time, ns; None without any.

    Chunk tables tell it, and the message indexes of chunks that hold the time itself. Damaged
    ones are left out.

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
        parts = session.parts(recording, channels, (moment, end))
        found = parts.first[parts.first >= moment].tolist()
        cut = parts.take((parts.first < moment) & (parts.last >= moment))
        for segment, chunk, channel in zip(*(c.tolist() for c in cut[:3]), strict=True):
            with suppress(SegmentError):
                times = session.times(recording, segment, chunk)[channel]
                found.append(int(times[np.searchsorted(times, moment)]))
        # Chunks that were not looked at hold nothing before the end.
        if found and min(found) < end:
            return int(min(found))
        if end > last:
            return None
        width *= 4
