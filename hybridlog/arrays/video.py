"""Decodes frames of compressed video with PyAV."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlog.arrays.bitstream import CODECS, FrameOrder
from hybridlog_storage.errors import MissingDependencyError, PayloadError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_PIXELS = 1 << 26


def pyav() -> Any:
    """The module of PyAV, or a `MissingDependencyError`."""
    try:
        import av
    except ImportError as error:
        raise MissingDependencyError(
            "pictures of video need PyAV: pip install 'hybridlog[video]'"
        ) from error
    return av


class VideoDecoder:
    """Decodes the frames of a topic, of a form in `CODECS`; the first one is a key frame.

    If it is `in_order`, pictures come in the order in which they are shown, from `take`; else each
    with its frame, from `decode`. One that `is_over` cannot take further frames.
    """

    def __init__(self, form: str, *, in_order: bool = False) -> None:
        av = self._av = pyav()
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
            # Strictly, a decoder waits unless a stream says that nothing is out of order.
            **({"strict": "strict"} if in_order else {"flags": "low_delay"}),
        }
        self._context: Any = context

    def decode(self, form: str, data: bytes, *, is_wanted: bool) -> NDArray[Any] | None:
        """Take the next frame; returns its picture, red first, if it is wanted.

        A `PayloadError` says that it cannot be decoded, or does not follow the frames so far.
        """
        number = self._count
        found = next((one for one in self.take(form, data) if one.pts == number), None)
        if not is_wanted:
            return None
        if found is None:  # the decoder holds it back
            found = next((one for one in self.rest() if one.pts == number), None)
        if found is None:
            raise PayloadError("a frame of video has no picture")
        try:
            picture: NDArray[Any] = found.to_ndarray(format="rgb24")
        except (self._av.FFmpegError, ValueError, MemoryError) as error:
            raise PayloadError(f"a frame of video cannot be decoded: {error}") from error
        return picture

    def take(self, form: str, data: bytes) -> list[Any]:
        """Take the next frame; returns the pictures of PyAV that are ready, as a rule its own.

        Their `pts` is the number of their frame, from 0 on. Errors are as of `decode`.
        """
        self.is_over = True  # unless all is well
        if form != self._form:
            raise PayloadError(f"a frame of {form} follows one of {self._form}")
        if not data:
            raise PayloadError("a frame of video is empty")
        if not self._order.follows(form, data):
            raise PayloadError(
                "a frame of video cannot be decoded: one that it refers to was never received"
            )
        packet = self._av.Packet(data)
        packet.pts = packet.dts = self._count
        found = self._decoded(packet)
        self._count += 1
        self.is_over = False
        return found

    def rest(self) -> list[Any]:
        """The pictures that are held back, at the end."""
        self.is_over = True
        return self._decoded(None)

    def _decoded(self, packet: Any) -> list[Any]:
        try:
            found: list[Any] = self._context.decode(packet)
        except (self._av.FFmpegError, ValueError, MemoryError) as error:
            raise PayloadError(f"a frame of video cannot be decoded: {error}") from error
        if any(one.is_corrupt for one in found):
            raise PayloadError("a frame of video is damaged")
        return found
