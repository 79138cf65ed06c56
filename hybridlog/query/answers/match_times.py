"""Log times of the messages of an answer, and of the next message, without the messages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from hybridlog.query.planner import Planner
from hybridlog_storage.errors import SegmentError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Question
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry


_FIRST_LOOK: Final = 1 << 30  # ns, about a second


class MatchTimes(NamedTuple):
    """Some messages of one topic of one recording, in order of log time and arrival.

    Attributes:
        recording: The recording.
        topic: Full name.
        log_time: int64[n], ns since the epoch.
        seq: int64[n], arrival numbers, each once in a recording.
    """

    recording: RecordingEntry
    topic: str
    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]


def match_times(session: Session, question: Question, counters: Counters) -> Iterator[MatchTimes]:
    """The times of an answer, some at a time; recordings and topics one after the other."""
    if not question.returns_all:
        raise UsageError("Times are those of all messages: leave out limit and every.")
    planner = Planner(session, question, counters)
    for part in planner.decided(planner.parts()):
        for found in planner.outcomes(part):
            holds = found.holds
            yield MatchTimes(part.recording, part.topic, found.log_time[holds], found.seq[holds])


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
    channels = [channel.channel_id for channel in session.channels_of(recording, [topic])]
    if recording.span is None or not channels:
        return None
    first, last = recording.span
    moment = max(moment, first)
    width = _FIRST_LOOK
    while True:
        end = moment + width
        parts = session.parts(recording, channels, (moment, end))
        found = parts["first"][parts["first"] >= moment].tolist()
        cut = parts[(parts["first"] < moment) & (parts["last"] >= moment)]
        for segment, chunk, channel in cut[["segment", "chunk", "channel"]].tolist():
            with suppress(SegmentError):
                times = session.times(recording, segment, chunk)[channel]
                found.append(int(times[np.searchsorted(times, moment)]))
        # Chunks that were not looked at hold nothing before the end.
        if found and min(found) < end:
            return int(min(found))
        if end > last:
            return None
        width *= 4
