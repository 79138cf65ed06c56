"""Compressed video: key frames, whether a frame follows another, and decoding with PyAV.

The bytes are untrusted. At most `_MAX_UNITS` headers of a frame are looked at, and the few bits
behind them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from hybridlog.arrays.message_arrays import attributes, byte_array
from hybridlog_storage.errors import MissingDependencyError, PayloadError, extra

if TYPE_CHECKING:
    from numpy.typing import NDArray

CODECS: Final[Mapping[str, str]] = {"h264": "h264", "h265": "hevc", "av1": "libdav1d"}
"""Names of decoders by the format of a message."""

_MAX_PIXELS = 1 << 26
_MAX_UNITS = 64
_MAX_HEADER = 64  # bytes of a unit that are parsed
_HIGH_PROFILES = {44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244}


def frame_of(decoded: Any) -> tuple[str, bytes]:
    """The format, one of `CODECS`, and the bytes of a decoded message."""
    try:
        message = attributes(decoded)
        form, data = str(message.format).lower(), byte_array(message.data).tobytes()
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise PayloadError(f"a frame of video has unusual fields: {error}") from error
    if form not in CODECS:
        raise PayloadError(f"video in {form[:40]!r} cannot be read: {', '.join(CODECS)} can")
    return form, data


def is_key_frame(form: str, data: bytes) -> bool:
    """True if decoding can begin with a frame: it has all parameters, and refers to no other."""
    if form == "av1":
        return _is_av1_key(data)
    parameters = False
    for unit in _units(data):
        kind = unit[0] & 31 if form == "h264" else unit[0] >> 1 & 63
        parameters |= kind == (7 if form == "h264" else 33)
        if form == "h264" and 1 <= kind <= 5:
            return parameters and kind == 5
        if form == "h265" and kind < 32:
            return parameters and 16 <= kind <= 21
    return False


class FrameOrder:
    """Tells whether frames of H.264 follow one another; frames of other formats seem to.

    H.264 counts the frames that others refer to, so a lost one shows.
    """

    def __init__(self) -> None:
        self._bits: int | None = None  # of a frame's number
        self._last: int | None = None

    def follows(self, form: str, data: bytes) -> bool:
        """False if a frame is lost between the last one and this one."""
        if form != "h264":
            return True
        try:
            return self._follows(data)
        except ValueError:
            return True  # cut short: the decoder refuses it

    def _follows(self, data: bytes) -> bool:
        for unit in _units(data):
            kind = unit[0] & 31
            if kind == 7:
                self._bits = _number_bits(_Bits(unit[1:]))
                self._last = None
            elif kind in {1, 5} and self._bits is not None:
                bits = _Bits(unit[1:])
                for _ in range(3):
                    bits.golomb()
                number, last = bits.take(self._bits), self._last
                if unit[0] & 0x60:
                    self._last = number
                expected = {last, ((last or 0) + 1) % (1 << self._bits)}
                return kind == 5 or last is None or number in expected
        return True


def _number_bits(bits: _Bits) -> int | None:
    """Length of the frame number according to a sequence parameter set; None if unknown."""
    profile = bits.take(24) >> 16
    bits.golomb()
    if profile in _HIGH_PROFILES:
        if bits.golomb() == 3:
            return None  # planes may be separate
        bits.golomb()
        bits.golomb()
        if bits.take(2) & 1:
            return None  # scaling lists, which video for viewing lacks
    length = bits.golomb() + 4
    return length if length <= 16 else None


class _Bits:
    """Reads bits of a unit, without the bytes that keep start codes out of it."""

    def __init__(self, data: bytes) -> None:
        self._bits = "".join(f"{byte:08b}" for byte in data.replace(b"\0\0\3", b"\0\0"))
        self._at = 0

    def take(self, count: int) -> int:
        """The next `count` bits as a number; ValueError if the unit ends before."""
        self._at += count
        if self._at > len(self._bits):
            raise ValueError
        return int(self._bits[self._at - count : self._at], 2)

    def golomb(self) -> int:
        zeros = self._bits.index("1", self._at) - self._at
        self._at += zeros
        return self.take(zeros + 1) - 1


def _units(data: bytes) -> Iterator[bytes]:
    """The beginnings of the units of H.264 or H.265 between start codes."""
    at = data.find(b"\0\0\1")
    for _ in range(_MAX_UNITS):
        if at < 0 or at + 3 >= len(data):
            return
        end = data.find(b"\0\0\1", at + 3)
        stop = at + 3 + _MAX_HEADER
        yield data[at + 3 : stop if end < 0 else min(end, stop)] or b"\0"
        at = end


def _is_av1_key(data: bytes) -> bool:
    at, is_still, parameters = 0, False, False
    for _ in range(_MAX_UNITS):
        if at + 1 >= len(data):
            return False
        head = data[at]
        kind = head >> 3 & 15
        at += 2 if head & 4 else 1
        size = len(data) - at
        if head & 2:
            size, at = _leb128(data, at)
        first = data[at : at + 1]
        if kind == 1 and first:
            parameters, is_still = True, bool(first[0] & 8)
        if kind in {3, 6} and first:
            # Neither shown again nor of another kind than "key", and shown.
            return parameters and (is_still or first[0] >> 4 == 1)
        at += size
    return False


def _leb128(data: bytes, at: int) -> tuple[int, int]:
    """A length, and where it ends; longer than the data if it is damaged."""
    value = 0
    for shift in range(0, 56, 7):
        if at >= len(data):
            break
        value |= (data[at] & 127) << shift
        at += 1
        if data[at - 1] < 128:
            return value, at
    return len(data), at


def pyav() -> Any:
    """The module of PyAV, or a `MissingDependencyError`."""
    with extra("video", "pictures of video need PyAV"):
        import av
    return av


class VideoDecoder:
    """Decodes the frames of a topic, of a form in `CODECS`; the first one is a key frame.

    Each picture comes with its frame. One that `is_over` cannot take further frames.
    """

    def __init__(self, form: str) -> None:
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
            "flags": "low_delay",
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
