"""The message that was current at a time: the last one not after it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.message import messages_in
from hybridlog.query.answers.video import picture_of
from hybridlog.query.chunk_scan import MessageRun
from hybridlog.query.planner import Planner
from hybridlog.query.times import TimeLike, is_relative, parse_time
from hybridlog_storage.times import END, earlier, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Batch


def message_at(
    session: Session, question: Question, counters: Counters, moment: TimeLike
) -> Message | None:
    """The last message not after a time, in any recording; None if none exists."""
    snapshot = session.look(question.recordings)
    places = session.chosen(question)
    start, end = snapshot.begin[places], snapshot.end[places]
    latest = np.minimum(_moments(moment, start, end), np.where(end == END, END, end - 1))
    latest[(start >= end) | (start > latest)] = -1
    best: tuple[tuple[int, str, int], Message] | None = None
    # Ask the recording that could hold the latest message first: it usually does.
    while len(latest):
        row = int(latest.argmax())
        now = int(latest[row])
        if now < 0 or (best is not None and now < best[0][0]):
            break
        latest[row] = -1
        recording = session.entry_of(snapshot.summaries[places[row]])
        found = _last_of(session, question, counters, recording, (int(start[row]), now))
        if found is not None:
            place = found.log_time_ns, recording.key, found.seq
            if best is None or place > best[0]:
                best = place, found
    return best[1] if best is not None else None


def _moments(
    moment: TimeLike, start: NDArray[np.int64], end: NDArray[np.int64]
) -> NDArray[np.int64]:
    """A time in each of some recordings, ns."""
    if not is_relative(moment):
        return np.full(len(start), parse_time(moment, start=None, end=None), np.int64)
    spans = zip(start.tolist(), end.tolist(), strict=True)
    return np.array([parse_time(moment, start=a, end=b) for a, b in spans], np.int64)


def just_before(question: Question, recording: str, begin: int, latest: int) -> Question:
    """The question about the last message of a recording in `[begin, latest]`, ns."""
    return replace(
        question,
        recordings=(recording,),
        bounds=span_of(begin, latest),
        clock="log",
        reverse=True,
        limit=1,
        every=1,
    )


def _last_of(
    session: Session,
    question: Question,
    counters: Counters,
    recording: RecordingEntry,
    span: Span,
) -> Message | None:
    """The last message of a recording in `[start, latest]`, ns."""
    if question.predicate is not None:
        start, latest = span
        for begin in earlier(latest, start):
            narrow = just_before(question, recording.id, begin, latest)
            for run in Planner(session, narrow, counters).runs():
                return next(messages_in(run, picture_of(session)))
        return None
    channels = session.channels_of(recording, {*question.topics})
    number = {channel.channel_id: row for row, channel in enumerate(channels)}
    best: tuple[int, int, Batch] | None = None
    for entry, last in session.chunks_before(recording, [*number], span[1]):
        if best is not None and last < best[0]:
            break
        chunk = session.chunk(recording, entry.segment, entry.place, counters.add_chunk)
        fits = chunk.batch.log_time <= span[1]
        if not number.keys() >= {*entry.place.channels}:
            fits &= np.isin(chunk.batch.channel, [*number])
        (rows,) = fits.nonzero()
        if len(rows):
            # Rows are in order of arrival: of equal times, the last one is wanted.
            row = int(rows[-1 - chunk.batch.log_time[rows][::-1].argmax()])
            place = int(chunk.batch.log_time[row]), int(chunk.seq[row])
            if best is None or place > best[:2]:
                best = *place, chunk.batch.take(slice(row, row + 1))
    if best is None:
        return None
    _, seq, batch = best
    counters.add_messages(batch)
    batch.channel = np.array([number[batch.channel.item()]], np.int32)
    run = MessageRun(batch, np.array([seq], np.int64), channels)
    return next(messages_in(run, picture_of(session)))
