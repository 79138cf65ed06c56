"""Writes a topic's pictures as a video in an MP4 file, each at its time.

Frames of H.264, H.265 and AV1 are copied; images become H.264. Time 0 is the log time of the first
picture, which is in the file's `comment`.
"""

from __future__ import annotations

import contextlib
import io
import os
from datetime import UTC, datetime
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.arrays import is_video_type
from hybridlog.arrays.video import VideoDecoder, frame_of, is_key_frame, pyav
from hybridlog.drawing.images import shown_pixels
from hybridlog.formats.writing import Answer, Sink, Target, Whole, failures, path_of
from hybridlog.query.times import format_time
from hybridlog_storage.errors import (
    DefinitionError,
    MissingDependencyError,
    PayloadError,
    UsageError,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message

_TICKS: Final = 10**6
"""Units of time in a second. With more of them, two frames could not be far from each other."""
_MAX_STEP: Final = 2**31 - 1
"""Ticks from one frame to the next, 35 minutes."""
_ONLY_STEP: Final = _TICKS // 10
"""Duration of a picture that is alone."""
_STREAMS: Final = {"h264": "h264", "h265": "hevc", "av1": "obu"}
"""Names of streams of frames by the format of a message."""
_ENCODER: Final = {"preset": "veryfast", "crf": "18"}
_BT601: Final = 6
_BETWEEN: Final = 3  # the kind of pictures that refer to later ones


def write_mp4(answer: Answer, target: Target) -> None:
    """Write a video; messages that are unreadable are left out."""
    with _Video(path_of(target, "mp4", "a file")) as video:
        for message in answer.messages:
            try:
                video.write(message)
            except (PayloadError, DefinitionError) as error:
                answer.unreadable.append(error)


class _Video(Whole):
    """Writes a video."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._av = pyav()
        self._sink = Sink(path)
        self._file: Any = self._av.open(
            str(self._sink.path),
            "w",
            format="mp4",
            options={"video_track_timescale": str(_TICKS), "movie_timescale": str(_TICKS)},
        )
        self._track: Any = None
        self._size = (0, 0)
        self._copied = ""  # the format of frames that are copied
        self._source = ("", "")
        self._form = ""
        self._decoder: VideoDecoder | None = None
        self._begin: int | None = None
        self._last = self._tick = 0
        self._step = _ONLY_STEP

    def write(self, message: Message) -> None:
        """Append the picture of a message."""
        source = (message.recording, message.topic)
        if self._track is not None and source != self._source:
            raise UsageError(
                "An MP4 is of one topic in one recording: choose one, or `hybridlog export` a file "
                "for each with --split-by recording."
            )
        self._source = source
        with failures(self._sink.name):
            if is_video_type(message.type):
                self._add_frame(message)
            else:
                self._encode(shown_pixels(message), message.log_time_ns)

    def _add_frame(self, message: Message) -> None:
        form, data = frame_of(message.decode())
        is_key = is_key_frame(form, data)
        if self._decoder is None or self._decoder.is_over or (is_key and form != self._form):
            if not is_key:
                raise PayloadError(
                    "a frame of video cannot be decoded: there is no key frame before it"
                )
            self._form, self._decoder = form, VideoDecoder(form)
        if form == "av1":
            message.to_numpy()  # the frames themselves do not tell that one is lost
        time = message.log_time_ns
        opened: Any = contextlib.nullcontext()
        if is_key:
            opened = self._av.open(io.BytesIO(data), format=_STREAMS[form])
        with opened as stream:
            is_between = is_key and stream.streams.video[0].codec_context.has_b_frames
            pictures = [] if is_between else self._decoder.take(form, data)
            if is_between or any(int(one.pict_type) == _BETWEEN for one in pictures):
                what = "frames in another order than they are shown"
                raise UsageError(self._changed(what, time))
            if len(pictures) != 1:
                raise PayloadError("a frame of video has no picture")
            if self._track is None:
                self._copied = form
                template = stream.streams.video[0]
                self._track = self._file.add_stream_from_template(template, opaque=True)
        if form != self._copied:
            raise UsageError(self._changed(f"{self._copied}, then other frames", time))
        packet = self._av.Packet(data)
        packet.pts = packet.dts = self._tick_at(time, (pictures[0].width, pictures[0].height))
        packet.is_keyframe = is_key
        self._mux(packet)

    def _encode(self, pixels: NDArray[np.uint8], time: int) -> None:
        height, width = pixels.shape[:2]
        # H.264 has an even number of rows and columns.
        even = [(0, height % 2), (0, width % 2), (0, 0)][: pixels.ndim]
        pixels = np.ascontiguousarray(np.pad(pixels, even, mode="edge"))
        size = (pixels.shape[1], pixels.shape[0])
        if self._track is None:
            self._track = self._encoder(size)
        form = "gray" if pixels.ndim == 2 else "rgb24"
        tick = self._tick_at(time, size)
        frame = self._av.VideoFrame.from_ndarray(pixels, format=form).reformat(format="yuv420p")
        frame.pts, frame.time_base = tick, Fraction(1, _TICKS)
        for packet in self._track.encode(frame):
            self._mux(packet)

    def _encoder(self, size: tuple[int, int]) -> Any:
        try:
            track = self._file.add_stream("libx264", rate=30, options=_ENCODER)
        except (self._av.FFmpegError, ValueError) as error:
            raise MissingDependencyError("this PyAV cannot encode H.264") from error
        track.width, track.height = size
        track.pix_fmt = "yuv420p"
        context = track.codec_context
        context.time_base, context.max_b_frames, context.gop_size = Fraction(1, _TICKS), 0, 60
        context.colorspace = _BT601
        return track

    def _tick_at(self, time: int, size: tuple[int, int]) -> int:
        """The time of the next picture in the file, which begins with the first one."""
        if self._begin is None:
            self._begin = self._last = time
            self._size, self._track.time_base = size, Fraction(1, _TICKS)
            moment = datetime.fromtimestamp(time // 10**9, UTC)
            self._file.metadata["creation_time"] = f"{moment:%Y-%m-%dT%H:%M:%SZ}"
            self._file.metadata["comment"] = f"log_time_ns={time}"
        if size != self._size:
            sizes = [f"{width} x {height}" for width, height in (self._size, size)]
            raise UsageError(self._changed(f"pictures of {sizes[0]}, then of {sizes[1]}", time))
        if time < self._last:
            raise UsageError("An MP4 is in the order of time: leave out --reverse.")
        tick = (time - self._begin + 500) // 1000
        if time > self._begin or self._tick:
            tick = max(tick, self._tick + 1)
            if tick - self._tick > _MAX_STEP:
                raise UsageError(self._changed("no picture for more than 35 minutes", time))
            self._step = tick - self._tick
        self._last, self._tick = time, tick
        return tick

    def _mux(self, packet: Any) -> None:
        packet.stream, packet.time_base = self._track, Fraction(1, _TICKS)
        packet.duration = self._step  # of the last one; that of others is known by the next one
        self._file.mux_one(packet)

    def _changed(self, what: str, time: int) -> str:
        return (
            f"{self._source[1]} has {what}, at {format_time(time)}; a video cannot: choose the "
            "time before or after with --between, or write --format png."
        )

    def commit(self) -> None:
        """Complete the file."""
        with failures(self._sink.name):
            if self._track is None:
                raise UsageError("There is no image in this answer.")
            if not self._copied:
                for packet in self._track.encode(None):
                    self._mux(packet)
            self._file.close()
        self._sink.commit()

    def abort(self) -> None:
        """Remove the file."""
        self._sink.abort()
        with contextlib.suppress(Exception):  # it cannot be completed
            self._file.close()
