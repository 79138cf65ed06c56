"""What is current at a time: the last message, and what stands in front of a slice.

In front of a slice are the latched messages that a late subscriber receives, and frames of video
from the key frame on.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.message import messages_in
from hybridlog.query.answers.video import picture_of
from hybridlog.query.chunk_scan import ChunkScan, MessageRun, RecordingScan, ScanPlan, with_payloads
from hybridlog.query.latching import depth_of, is_key_frame, is_video, publisher_of
from hybridlog.query.planner import Planner
from hybridlog.query.question import Counters, Question
from hybridlog.query.ranges import RangeResolver
from hybridlog.query.times import TimeLike, parse_time
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.times import END, earlier, span_of

if TYPE_CHECKING:
    from hybridlog.message import Message
    from hybridlog.query.chunk_columns import Chunk
    from hybridlog.query.question import RecordedChannel, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.messages import Batch
    from hybridlog_storage.summary import RecordingSummary


def message_at(
    session: Session, question: Question, counters: Counters, moment: TimeLike
) -> Message | None:
    """The last message not after a time, in any recording; None if none exists."""
    candidates = []
    for one in session.summaries_of(question):
        start, end = one.extent
        latest = min(parse_time(moment, start=start, end=end), end if end == END else end - 1)
        if start < end and start <= latest:
            candidates.append((latest, start, one))
    best: tuple[tuple[int, str, int], Message] | None = None
    # Ask the recording that could hold the latest message first: it usually does.
    for latest, start, one in sorted(candidates, key=itemgetter(0), reverse=True):
        if best is not None and latest < best[0][0]:
            break
        recording = session.entry_of(one)
        found = _last_of(session, question, counters, recording, (start, latest))
        if found is not None:
            place = found.log_time_ns, recording.key, found.seq
            if best is None or place > best[0]:
                best = place, found
    return best[1] if best is not None else None


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


_FIRST_LOOK = 1 << 30  # ns, about a second
_Key = tuple[int, int]
"""Log time, ns, and arrival number of a message."""

_FIRST: _Key = (-1, -1)
"""Before any message."""


def in_force(
    session: Session, question: Question, counters: Counters, *, original_times: bool
) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
    """Messages from before the time range of a question, which precede its answer.

    They are the latched ones that a subscriber receives which joins then, and the frames that
    the first ones of video refer to: those from the last key frame on.
    Their log time becomes the beginning of the range, which keeps the slice within the
    range. The publish time remains the time at which they were sent.

    Args:
        session: The open store.
        question: The question.
        counters: Count the messages, as `latched` and `frames`, and what is read.
        original_times: The messages keep their log time.
    """
    for summary, begin in _beginnings(session, question):
        recording = session.entry_of(summary)
        channels = _latching(session, question, recording)
        for batch, own in _LatchedScan(session, recording, begin, counters).read(channels):
            frames = np.array([is_video(c.channel) for c in own])[batch.channel].sum()
            counters.frames += int(frames)
            counters.latched += len(batch) - int(frames)
            if not original_times:
                has_publish_time = np.array([c.channel.has_publish_time for c in own])
                batch.publish_time = np.where(
                    has_publish_time[batch.channel], batch.publish_time, batch.log_time
                )
                batch.log_time = np.full(len(batch), begin, np.int64)
            yield batch, own


def _beginnings(session: Session, question: Question) -> Iterator[tuple[RecordingSummary, int]]:
    """Recordings that begin before the range does, and the log time at which it begins, ns.

    By another clock, the range begins with the first message of the answer.
    """
    if question.is_by_log_time:
        yield from RangeResolver(session, question).beginnings()
        return
    for summary, _, _ in RangeResolver(session, question).resolve():
        if _latching(session, question, session.entry_of(summary)):
            first = replace(question, recordings=(summary.id,), limit=1, every=1, reverse=False)
            for run in Planner(session, first).runs():
                yield summary, int(run.batch.log_time[0])


def _latching(
    session: Session, question: Question, recording: RecordingEntry
) -> list[RecordedChannel]:
    """The latching channels of a question in a recording, and those of video."""
    return [
        channel
        for channel in session.channels_of(recording, {*question.topics})
        if depth_of(channel.channel) or is_video(channel.channel)
    ]


class _LatchedScan:
    """Reads the last messages of each publisher before a log time, in order.

    The first pass goes back from that time, one publisher after the other, and finds the
    first message in force. The second one reads from there on, so memory is bounded by the
    chunks that overlap in time, whatever the depth.
    """

    def __init__(
        self, session: Session, recording: RecordingEntry, begin: int, counters: Counters
    ) -> None:
        self._session = session
        self._recording = recording
        self._begin = begin
        self._counters = counters

    def read(
        self, channels: Sequence[RecordedChannel]
    ) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
        """The messages in force on some latching channels."""
        publishers: dict[Hashable, list[RecordedChannel]] = defaultdict(list)
        for channel in channels:
            first = channel.stats.first
            if first is not None and first < self._begin:
                publishers[publisher_of(channel.channel)].append(channel)
        own: list[RecordedChannel] = []
        cuts: list[_Key] = []
        scans: list[RecordingScan] = []
        for group in publishers.values():
            cut = self._cut(group)
            if cut is None:
                continue
            scans.append(self._scan(group, cut[0], len(own)))
            own += group
            cuts += [cut] * len(group)
        if not own:
            return
        times, numbers = np.array(cuts, np.int64).T
        plan = ScanPlan(own, [_merged_scan(scans)], counters=self._counters)
        for run in ChunkScan(plan, self._session).runs():
            of, time = run.batch.channel, run.batch.log_time
            at = times[of]
            keep = (time > at) | ((time == at) & (run.seq >= numbers[of]))
            if keep.any():
                found = with_payloads(run.take(keep), self._counters)
                if len(found.batch):
                    yield found.batch, own

    def _cut(self, group: Sequence[RecordedChannel]) -> _Key | None:
        """The first message in force, of publishers that displace one another or of video."""
        is_of_video = is_video(group[0].channel)
        left = max(depth_of(channel.channel) for channel in group)
        if not is_of_video and left >= sum(channel.stats.messages for channel in group):
            return _FIRST
        plan = ScanPlan([*group], [self._scan(group, 0, 0)], reverse=True, counters=self._counters)
        for run in ChunkScan(plan, self._session, ahead=False).runs():
            row = None if left > len(run.batch) else left - 1
            if is_of_video:
                row = next(filter(partial(_is_key, run), range(len(run.batch))), None)
            if row is not None:
                return int(run.batch.log_time[row]), int(run.seq[row])
            left -= len(run.batch)
        return None if is_of_video else _FIRST

    def _scan(self, group: Sequence[RecordedChannel], begin: int, first: int) -> RecordingScan:
        """The scan of some channels from a log time on; their indexes begin with `first`."""
        indexes = {channel.channel_id: first + row for row, channel in enumerate(group)}
        bounds = max(begin, 0), self._begin
        chunks = self._session.chunks(self._recording, [*indexes], bounds, "log")
        return RecordingScan(self._recording, indexes, bounds, chunks)


def _is_key(run: MessageRun, row: int) -> bool:
    channel = run.channels[int(run.batch.channel[row])].channel
    return is_key_frame(channel, run.batch.payload(row))


def _merged_scan(scans: Sequence[RecordingScan]) -> RecordingScan:
    """One scan of everything, which reads each chunk once."""
    chunks: dict[tuple[int, int], Chunk] = {}
    for chunk in (chunk for scan in scans for chunk in scan.chunks):
        key = chunk.segment, chunk.number
        known = chunks.setdefault(key, chunk)
        first, last = min(known.first, chunk.first), max(known.last, chunk.last)
        chunks[key] = known._replace(first=first, last=last)
    bounds = [scan.bounds for scan in scans if scan.bounds is not None]
    return RecordingScan(
        scans[0].recording,
        {channel: index for scan in scans for channel, index in scan.channels.items()},
        (min(begin for begin, _ in bounds), bounds[0][1]),
        [*chunks.values()],
    )


def next_time(session: Session, recording: RecordingEntry, topic: str, moment: int) -> int | None:
    """The least log time of a topic's messages that is not before a time, ns; None without any.

    No payload is read for it. A time with a damaged chunk is left out.

    Args:
        session: The open store.
        recording: The recording.
        topic: Full name.
        moment: The time, ns.
    """
    planner = Planner(session, Question((topic,), (recording.id,)))
    if recording.span is None or not session.channels_of(recording, [topic]):
        return None
    begin, stop = min(max(moment, recording.span[0]), END - 1), span_of(*recording.span)[1]
    width = _FIRST_LOOK
    for part in planner.split():
        while begin < stop:
            end = min(begin + width, END)
            with suppress(SegmentError):
                times = planner.times(replace(part, bounds=(begin, end)))
                times = times[times >= moment]  # ranges place the last time before another one
                if len(times):
                    return int(times[0])
            begin, width = end, 4 * width
    return None
