"""What is current at a time: the last message, and what stands in front of a slice.

In front of a slice are the latched messages that a late subscriber receives, and frames of video
from the key frame on.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from hybridlog.message import messages_in
from hybridlog.query import latching
from hybridlog.query.answers.video import picture_of
from hybridlog.query.chunk_scan import (
    ChunkScan,
    MessageRun,
    RecordingScan,
    in_order,
    with_payloads,
)
from hybridlog.query.latching import KEEP_ALL, depth_of, is_key_frame, is_video, publisher_of
from hybridlog.query.planner import Planner, log_spans, resolved
from hybridlog.query.question import Counters, Question, windows_in
from hybridlog.query.times import TimeLike, parse_time
from hybridlog_storage.errors import ResourceError, SegmentError
from hybridlog_storage.messages import interleave
from hybridlog_storage.times import BEGIN, END, earlier, span_of

if TYPE_CHECKING:
    from hybridlog.message import Message
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
    planner = Planner(session, replace(question, reverse=True, limit=1), counters)
    found: dict[tuple[int, str, int], Message] = {}
    # Ask the recording that could hold the latest message first: it usually does.
    for latest, start, one in sorted(candidates, key=itemgetter(0), reverse=True):
        if found and latest < max(found)[0]:
            break
        message = _last_of(planner, one, (start, latest))
        if message is not None:
            found[message.log_time_ns, one.key, message.seq] = message
    return found[max(found)] if found else None


def _last_of(planner: Planner, summary: RecordingSummary, span: Span) -> Message | None:
    """The last message of a recording in `[start, latest]`, ns."""
    (start, latest), session = span, planner.session
    recording = session.entry_of(summary)
    ids = [one.channel_id for one in session.channels_of(recording, {*planner.question.topics})]
    begins = [first for _, first, _ in recording.spans_with(ids) if first <= latest]
    if not begins:
        return None
    # The chunk that begins last by then has a message by then, so none before it is wanted.
    firsts = session.parts(recording, ids, (max(begins), min(latest + 1, END)))["first"]
    near = int(firsts[firsts <= latest].max(initial=max(begins)))
    for begin in (near, *earlier(near, start)):
        parts = planner.parts_in(summary, windows_in(None, span_of(begin, latest)))
        for run in planner.scan([*parts], reverse=True, keeps=True).runs():
            planner.counters.add_messages(run.batch.take(slice(1)))
            return next(messages_in(run, picture_of(session)))
    return None


def in_force(
    session: Session, question: Question, counters: Counters, *, original_times: bool
) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
    """Messages from before the time range of a question, which precede its answer.

    They are the latched ones that a subscriber receives which joins then, and the frames that
    the first ones of video refer to. Their log time becomes the beginning of the range, unless
    they keep their `original_times`; the publish time remains.
    """
    for summary, begin in _beginnings(session, question):
        recording = session.entry_of(summary)
        own = _latching(session, question, recording, begin)
        run = _last_messages(session, recording, own, begin, counters)
        if run is None:
            continue
        batch = run.batch
        is_frame = np.array([is_video(one.channel) for one in own])[batch.channel]
        counters.frames += int(is_frame.sum())
        counters.latched += int((~is_frame).sum())
        if not original_times:
            has_publish_time = np.array([one.channel.has_publish_time for one in own])
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
        begins: dict[str, int] = {}
        for one, (begin, _) in log_spans(session, question):
            if begins.setdefault(one.id, begin) == begin and one.extent[0] < begin:
                yield one, begin
        return
    for one, *_ in resolved(session, question):
        if _latching(session, question, session.entry_of(one), END):
            first = replace(question, recordings=(one.id,), limit=1, every=1, reverse=False)
            for run in Planner(session, first).runs():
                yield one, int(run.batch.log_time[0])


def _latching(
    session: Session, question: Question, recording: RecordingEntry, begin: int
) -> list[RecordedChannel]:
    """The latching channels of a question with messages before a time, and those of video."""
    return [
        channel
        for channel in session.channels_of(recording, {*question.topics})
        if (depth_of(channel.channel) or is_video(channel.channel))
        and channel.stats.first is not None
        and channel.stats.first < begin
    ]


def _last_messages(
    session: Session,
    recording: RecordingEntry,
    channels: list[RecordedChannel],
    begin: int,
    counters: Counters,
) -> MessageRun | None:
    """The last messages of each publisher before a log time, in order; None without any."""
    publishers: dict[Hashable, dict[int, int]] = defaultdict(dict)
    for index, channel in enumerate(channels):
        publishers[publisher_of(channel.channel, channel.channel)][channel.channel_id] = index
    found: list[MessageRun] = []
    for indexes in publishers.values():
        chunks = session.chunks(recording, [*indexes], (BEGIN, begin), "log")
        one = RecordingScan(recording, indexes, chunks, windows_in(None, (BEGIN, begin)))
        scan = ChunkScan(session, channels, [one], counters, reverse=True, ahead=False)
        found += _of_publisher([channels[index] for index in indexes.values()], scan)
        if sum(run.batch.payload_bytes for run in found) > latching.MAX_HELD:
            raise ResourceError(
                f"What is in force at the beginning has more than {latching.MAX_HELD >> 20} MiB: "
                "leave latched messages and frames out (--no-latched)."
            )
    found = [own for run in found if len((own := with_payloads(run, counters)).batch)]
    return in_order(found) if found else None


def _of_publisher(channels: Sequence[RecordedChannel], scan: ChunkScan) -> list[MessageRun]:
    """The last messages of publishers that displace one another, or of video from a key frame."""
    is_of_video = is_video(channels[0].channel)
    left = KEEP_ALL if is_of_video else max(depth_of(one.channel) for one in channels)
    found: list[MessageRun] = []
    size = 0
    for run in scan.runs():
        rows = range(len(run.batch))
        key = next(filter(partial(_is_key, run), rows), None) if is_of_video else None
        chosen = np.array(rows if key is None else rows[: key + 1])[:left]
        batch = interleave([run.batch.take(chosen)], np.arange(len(chosen)))  # not its chunk
        found.append(MessageRun(batch, run.seq[chosen], run.channels))
        left -= len(chosen)
        size += batch.payload_bytes
        if key is not None or left == 0 or size > latching.MAX_HELD:
            return found
    return [] if is_of_video else found


def _is_key(run: MessageRun, row: int) -> bool:
    channel = run.channels[int(run.batch.channel[row])].channel
    return is_key_frame(channel, run.batch.payload(row))


def next_time(session: Session, recording: RecordingEntry, topic: str, moment: int) -> int | None:
    """The least log time of a topic's messages from a time on, ns; None without any.

    No payload is read for it. A damaged chunk is left out.
    """
    ids = [one.channel_id for one in session.channels_of(recording, [topic])]
    held = session.parts(recording, ids, (moment, END))
    found: list[int] = held["first"][held["first"] >= moment].tolist()
    begun = held[held["first"] < moment]
    for segment, chunk, channel in begun[["segment", "chunk", "channel"]].tolist():
        with suppress(SegmentError):
            times = session.times(recording, segment, chunk)[channel]
            found += times[times >= moment][:1].tolist()
    return min(found, default=None)
