"""What is current at a time: the last message, what stands in front of a slice, pictures of video.

In front of a slice are the latched messages that a late subscriber receives, and frames of video
from the key frame on. A picture is decoded from the key frame before it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, defaultdict
from collections.abc import Hashable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from hybridlog.arrays import is_video_type
from hybridlog.arrays.video import VideoDecoder, frame_of, is_key_frame
from hybridlog.message import Message, PictureOf, messages_in
from hybridlog.query import latching
from hybridlog.query.answers.completeness import lost_times
from hybridlog.query.chunk_scan import (
    ChunkScan,
    MessageRun,
    RecordingScan,
    in_order,
    with_payloads,
)
from hybridlog.query.latching import KEEP_ALL, depth_of, is_video, publisher_of
from hybridlog.query.planner import Planner, log_spans, resolved
from hybridlog.query.question import Counters, Question, RecordedChannel, Span, windows_in
from hybridlog.query.times import TimeLike, parse_time
from hybridlog.schema.states import CAUSES
from hybridlog_storage.errors import (
    DefinitionError,
    PayloadError,
    ResourceError,
    SegmentError,
    UsageError,
)
from hybridlog_storage.messages import Batch, interleave
from hybridlog_storage.times import BEGIN, END, earlier, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry, RecordingSummary


_MAX_OPEN = 4
_MAX_BYTES = 256 << 20  # between two key frames
_SIZE = 16 << 20  # of the pictures of some topics, about


def frames_in_front(session: Session, question: Question) -> list[Message]:
    """The frames before a range that its first frame refers to: from the last key frame on.

    There are none before a key frame, nor before messages that are no frames.
    """
    of_first = replace(question, limit=1)
    runs = Planner(session, of_first).runs()
    first = next((message for run in runs for message in messages_in(run)), None)
    if first is None or not is_video_type(first.type):
        return []
    windows = 0 if question.during is None else len(question.during)
    is_range = question.is_by_log_time and question.predicate is None and windows < 2
    if not is_range or question.every > 1:
        raise UsageError(
            f"The frames of {first.topic} refer to one another, so a video has all of a range of "
            "log time: leave out --every, --where and --clock, or write --format png."
        )
    with suppress(PayloadError, DefinitionError):
        if not is_key_frame(*frame_of(first.decode())):
            return [message for message, *_ in back_to_key(session, first)][:0:-1]
    return []


def back_to_key(
    session: Session, message: Message, stop: tuple[int, int] | None = None
) -> Iterator[tuple[Message, str, bytes]]:
    """A frame and those before it, the latest first, with format and bytes: back to a key frame.

    Or back to a frame (log time and arrival number) to `stop` at, which is not among them.
    """
    last, picture = _place(message), picture_of(session)
    bounds = (None, message.log_time_ns + 1)
    question = Question((message.topic,), (message.recording,), bounds, reverse=True)
    size = 0
    for run in Planner(session, question).runs():
        for each in messages_in(run, picture):
            if _place(each) > last:
                continue
            if _place(each) == stop:
                return
            if each.is_reduced:
                raise PayloadError(
                    "a frame of video cannot be decoded: the payload of one between it and "
                    f"the key frame before it was {CAUSES[each.state]}"
                )
            form, data = frame_of(each.decode())
            yield each, form, data
            if is_key_frame(form, data):
                return
            size += len(data)
            if size > _MAX_BYTES:
                raise PayloadError(
                    "a frame of video cannot be decoded: there is no key frame in the "
                    f"{_MAX_BYTES >> 20} MiB before it"
                )
    raise PayloadError("a frame of video cannot be decoded: there is no key frame before it")


class _Playing(Struct):
    """A decoder, and the frame that it has taken last: log time, arrival number, picture."""

    decoder: VideoDecoder
    place: tuple[int, int]
    picture: NDArray[Any]


class VideoPictures:
    """Decodes frames of video topics. Those in a row are decoded once each."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._playing: OrderedDict[tuple[str, str], _Playing] = OrderedDict()

    def picture(self, session: Session, message: Message) -> NDArray[Any]:
        """The picture of a frame, red first; read-only."""
        with self._lock:
            key, place = (message.recording, message.topic), _place(message)
            playing = self._playing.pop(key, None)
            if playing is None or playing.place != place:
                playing = self._decoded(session, message, playing)
                playing.picture.flags.writeable = False
            self._playing[key] = playing
            if len(self._playing) > _MAX_OPEN:
                self._playing.popitem(last=False)
            return playing.picture

    def _decoded(self, session: Session, message: Message, playing: _Playing | None) -> _Playing:
        if playing is not None and playing.decoder.is_over:
            playing = None
        stop = None if playing is None else playing.place
        frames = [*back_to_key(session, message, stop)][::-1]
        first, form, data = frames[0]
        if playing is None or is_key_frame(form, data):
            begin, decoder = first.log_time_ns, None
        else:
            begin, decoder = playing.place[0], playing.decoder
        self._check_whole(session, message, frames[-1][1], begin)
        decoder = decoder or VideoDecoder(form)
        for each, form, data in frames:
            picture = decoder.decode(form, data, is_wanted=each is frames[-1][0])
        assert picture is not None
        return _Playing(decoder, _place(message), picture)

    def _check_whole(self, session: Session, message: Message, form: str, begin: int) -> None:
        """Refuse a frame that may refer to a lost one."""
        # Losses are noted from the last message before them to the first one behind them.
        if begin + 1 < message.log_time_ns:
            bounds = (begin + 1, message.log_time_ns)
            question = Question((message.topic,), (message.recording,), bounds)
            lost = lost_times(session, question)
            # H.264 and H.265 tell themselves what is missing: an unknown time is enough for AV1.
            if any(form == "av1" or one.begin_ns > BEGIN for one in lost):
                raise PayloadError(
                    "a frame of video cannot be decoded: messages are lost between it and the "
                    "key frame before it"
                )


def picture_of(session: Session) -> PictureOf:
    """Decodes frames of video of an open store."""

    def picture(message: Message) -> NDArray[Any]:
        pictures = session.cache.made("videos", make=VideoPictures, size_of=lambda _: _SIZE)
        found: NDArray[Any] = pictures.picture(session, message)
        return found

    return picture


def _place(message: Message) -> tuple[int, int]:
    return message.log_time_ns, message.seq


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
        chunks = session.chunks(recording, [*indexes], (BEGIN, begin))
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
    return latching.is_key_frame(channel, run.batch.payload(row))


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
