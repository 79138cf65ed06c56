"""Decodes frames of compressed video with PyAV."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlog.arrays.bitstream import CODECS, FrameOrder
from hybridlog_storage.errors import MissingDependencyError, PayloadError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_PIXELS = 1 << 26


class VideoDecoder:
    """Decodes the frames of a topic, the first of which is a key frame.

    Args:
        form: One of `hybridlog.arrays.bitstream.CODECS`.

    Attributes:
        is_over: It cannot take further frames.

    Raises:
        MissingDependencyError: PyAV is not installed, or lacks the decoder.
    """

    def __init__(self, form: str) -> None:
        try:
            import av
        except ImportError as error:
            raise MissingDependencyError(
                "pictures of video need PyAV: pip install 'hybridlog[video]'"
            ) from error
        self._av = av
        self._form = form
        self._order = FrameOrder()
        self._count = 0
        self.is_over = False
        try:
            context = av.CodecContext.create(CODECS[form], "r")
        except av.FFmpegError as error:
            raise MissingDependencyError(f"this PyAV cannot decode {form}") from error
        context.thread_count = 1  # a picture comes with its frame
        context.options = {
            "err_detect": "explode",
            "max_pixels": str(_MAX_PIXELS),
            "flags": "low_delay",
        }
        self._context: Any = context

    def decode(self, form: str, data: bytes, *, is_wanted: bool) -> NDArray[Any] | None:
        """Take the next frame.

        Args:
            form: Its format.
            data: Its bytes.
            is_wanted: Return its picture, red first; without, None.

        Raises:
            PayloadError: It cannot be decoded, or does not follow the frames so far.
        """
        self.is_over = True  # unless all is well
        if form != self._form:
            raise PayloadError(f"a frame of {form} follows one of {self._form}")
        if not self._order.follows(form, data):
            raise PayloadError(
                "a frame of video cannot be decoded: one that it refers to was never received"
            )
        try:
            packet = self._av.Packet(data)
            packet.pts = packet.dts = self._count
            found = self._picture(self._context.decode(packet))
            is_late = found is None and is_wanted
            if is_late:  # the decoder holds it back
                found = self._picture(self._context.decode(None))
            if found is None and is_wanted:
                raise PayloadError("a frame of video has no picture")
            if found is not None and found.is_corrupt:
                raise PayloadError("a frame of video is damaged")
            picture: NDArray[Any] | None = None
            if is_wanted and found is not None:
                picture = found.to_ndarray(format="rgb24")
        except (self._av.FFmpegError, ValueError, MemoryError) as error:
            raise PayloadError(f"a frame of video cannot be decoded: {error}") from error
        self._count += 1
        self.is_over = is_late
        return picture

    def _picture(self, frames: list[Any]) -> Any:
        """The picture of the frame that was taken last, if it is among some."""
        return next((frame for frame in frames if frame.pts == self._count), None)
