"""Log times of the messages of an answer, without the messages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from hybridlog.query.planner import Planner
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Question
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry


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
    """The times of an answer, some at a time; recordings and topics one after the other.

    Raises:
        UsageError: the question has `limit` or `every`.
        TimeError: the range is outside all recordings.
    """
    if not question.returns_all:
        raise UsageError("Times are those of all messages: leave out limit and every.")
    planner = Planner(session, question, counters)
    for part in planner.parts():
        for found in planner.outcomes(part):
            holds = found.holds
            yield MatchTimes(part.recording, part.topic, found.log_time[holds], found.seq[holds])
