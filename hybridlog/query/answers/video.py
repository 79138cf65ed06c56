"""Pictures of video topics, each decoded from the key frame before it, and their key frames."""

from __future__ import annotations

import threading
from collections import OrderedDict
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from msgspec import Struct
from msgspec.structs import replace

from hybridlog.arrays import is_video_type
from hybridlog.arrays.video import VideoDecoder, frame_of, is_key_frame
from hybridlog.message import messages_in
from hybridlog.query.answers.lost import lost_times
from hybridlog.query.planner import Planner
from hybridlog.query.question import Question
from hybridlog.schema.states import CAUSES
from hybridlog_storage.errors import DefinitionError, PayloadError, UsageError
from hybridlog_storage.times import BEGIN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from hybridlog.message import Message, PictureOf
    from hybridlog.session import Session

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
