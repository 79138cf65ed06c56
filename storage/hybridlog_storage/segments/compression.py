"""Compresses chunks that gain from it, and decompresses untrusted data.

A size claimed by a file is compared with a limit, and with the ratio of its codec, before
memory is allocated. Above `MAX_FREE` bytes, content may be `MAX_RATIO` times as large as its
compressed form; `Compressor` keeps to that, too.
"""

from __future__ import annotations

from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING, Literal, cast

import lz4.frame
import zstandard

from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import IO

    from hybridlog_storage.messages import Buffer

MAX_UNCOMPRESSED = 1 << 30
"""Default limit of a chunk's uncompressed size, bytes."""

MAX_FREE = 256 << 20
"""Uncompressed size up to which any ratio is believed, bytes."""

MAX_RATIO = 1000
"""Largest believed ratio above that."""

# Maximum ratio of each codec: an RLE block of zstd spends 4 bytes on 128 KiB, a run of
# lz4 one byte on 255. A larger claim is false.
_MAX_RATIO = {"zstd": 1 << 15, "lz4": 255}
_RATIO_SLACK = 1 << 17

_PIECE = 1 << 18
_SAMPLE = 8192  # bytes of one sample of a chunk
_SAMPLES = 6
_MAX_SHARE = 0.97  # of its size that a compressed chunk may have
# In a hurry: compressing to this share or less is faster than writing uncompressed,
_WORTH_IT = 0.2
_FAST = 1  # at this level of either codec.


def decompress(
    compression: str, data: Buffer, uncompressed_size: int, *, limit: int = MAX_UNCOMPRESSED
) -> bytes | memoryview:
    """Decompress the content of a chunk; without a codec, a view of `data`.

    `compression` is its name in MCAP: `zstd`, `lz4`, or empty for none. An output of more than
    `limit` bytes, or not of `uncompressed_size`, raises `SegmentError`.
    """
    if uncompressed_size > limit:
        raise SegmentError(
            f"it claims {uncompressed_size} bytes uncompressed, more than the limit of {limit}"
        )
    if compression == "":
        if len(data) != uncompressed_size:
            raise SegmentError(f"it holds {len(data)} bytes, not {uncompressed_size} as it claims")
        return memoryview(data)
    check_size(compression, uncompressed_size, len(data))
    if is_implausible(uncompressed_size, len(data)):
        raise SegmentError(
            f"it claims {uncompressed_size} bytes uncompressed, more than {MAX_RATIO} times "
            f"its {len(data)} bytes of {compression}"
        )
    try:
        if compression == "zstd" and zstandard.frame_content_size(data) == uncompressed_size:
            return _decompressor(get_ident()).decompress(data, allow_extra_data=False)
        view = memoryview(data)
        part = FilePart(lambda at, size: view[at : at + size], 0, len(view))
        return _joined(decompress_pieces(compression, part), uncompressed_size)
    except MemoryError as error:
        raise SegmentError(f"there is no memory for its {uncompressed_size} bytes") from error
    except zstandard.ZstdError as error:
        raise SegmentError(f"its {compression} data is damaged ({error})") from error


def _joined(pieces: Iterator[bytes], size: int) -> memoryview:
    """The content of a frame that does not say its size, or of several."""
    out, filled = memoryview(bytearray(size)), 0
    for piece in pieces:
        filled += len(piece)
        if filled > size:
            raise SegmentError(f"it decompresses to more bytes, not {size} as it claims")
        out[filled - len(piece) : filled] = piece
    if filled != size:
        raise SegmentError(f"it decompresses to only {filled} bytes, not {size} as it claims")
    return out.toreadonly()


def check_size(compression: str, uncompressed_size: int, size: int) -> None:
    """Raise `SegmentError` if compressed data cannot hold what it claims to hold."""
    if compression not in _MAX_RATIO:
        raise SegmentError(
            f"its compression {compression[:32]!r} is not known; rewrite the file with zstd"
        )
    if uncompressed_size > size * _MAX_RATIO[compression] + _RATIO_SLACK:
        raise SegmentError(
            f"it claims {uncompressed_size} bytes uncompressed, which {size} bytes "
            f"of {compression} cannot hold"
        )


def is_implausible(uncompressed_size: int, size: int) -> bool:
    """True if this much content of so few compressed bytes is not believed."""
    return uncompressed_size > MAX_FREE and uncompressed_size > size * MAX_RATIO


class FilePart:
    """A part of a file, or of memory, that is read piece by piece.

    `read` takes an offset and a length. All of its `size` bytes are there.
    """

    def __init__(self, read: Callable[[int, int], Buffer], start: int, size: int) -> None:
        self._read = read
        self._start = start
        self._size = size
        self._at = 0

    def __len__(self) -> int:
        return self._size

    def again(self) -> FilePart:
        """The same part from its start."""
        return self.section(0, self._size)

    def section(self, start: int, size: int) -> FilePart:
        """Some of its bytes, as a part of the same file."""
        return FilePart(self._read, self._start + start, size)

    def read(self, size: int = -1) -> bytes:
        """The next bytes: at most `size`, all without it; none at the end."""
        left = self._size - self._at
        data = bytes(self._read(self._start + self._at, left if size < 0 else min(size, left)))
        self._at += len(data)
        return data


def decompress_pieces(compression: str, data: FilePart) -> Iterator[bytes]:
    """Decompress in pieces of up to 256 KiB, in memory independent of the size.

    Pieces before damage are intact. A missing end is no error.
    """
    data = data.again()
    if compression == "":
        while piece := data.read(_PIECE):
            yield piece
        return
    check_size(compression, 0, len(data))
    try:
        yield from _zstd_pieces(data) if compression == "zstd" else _lz4_pieces(data)
    except (zstandard.ZstdError, RuntimeError) as error:
        raise SegmentError(f"its {compression} data is damaged ({error})") from error


@lru_cache(maxsize=64)
def _decompressor(_thread: int) -> zstandard.ZstdDecompressor:
    return zstandard.ZstdDecompressor()  # which threads must not share


@lru_cache(maxsize=64)
def _compressor(_thread: int, level: int, *, check: bool) -> zstandard.ZstdCompressor:
    return zstandard.ZstdCompressor(level=level, write_checksum=check)


def checked_frame(data: Buffer) -> bytes:
    """Data as one zstd frame with a checksum of its content."""
    return _compressor(get_ident(), 1, check=True).compress(data)


def _zstd_pieces(data: FilePart) -> Iterator[bytes]:
    source = cast("IO[bytes]", data)  # of which a reader needs only `read`
    whole = _decompressor(get_ident())
    reader = whole.stream_reader(source, read_across_frames=True, closefd=False)
    while piece := reader.read(_PIECE):
        yield piece


def _lz4_pieces(data: FilePart) -> Iterator[bytes]:
    frame = lz4.frame.LZ4FrameDecompressor()
    while rest := data.read(_PIECE):
        while rest:
            piece: bytes = frame.decompress(rest, max_length=_PIECE)
            while piece or not (frame.eof or frame.needs_input):
                if piece:
                    yield piece
                piece = b"" if frame.eof else frame.decompress(b"", max_length=_PIECE)
            rest = b""
            if frame.eof:
                rest = frame.unused_data or b""
                frame = lz4.frame.LZ4FrameDecompressor()


class Compressor:
    """Compresses chunks, except those that would not shrink.

    Compressed images and the like cost much time and gain nothing. So a few samples of a large
    chunk are tried first, and a chunk that gains less than 3 % is stored uncompressed. Thread safe;
    compression releases the interpreter lock.

    The codec `none` stores everything as it is. `level` is zstd's.
    """

    def __init__(self, name: Literal["zstd", "lz4", "none"] = "zstd", level: int = 1) -> None:
        self.name = name
        self.level = level

    def compress(self, data: Buffer, *, hurried: bool = False) -> tuple[str, Buffer]:
        """Compress a chunk if it gains enough: name of the codec and bytes, else empty and `data`.

        `hurried` compresses only if samples shrink to a fifth or less, and at level 1 at most.
        """
        bound = _WORTH_IT if hurried else _MAX_SHARE
        level = min(self.level, _FAST) if hurried else self.level
        if self.name == "none" or len(data) == 0 or not self._promising(data, level, bound):
            return "", data
        packed = self._pack(data, level)
        if len(packed) > len(data) * _MAX_SHARE or is_implausible(len(data), len(packed)):
            return "", data
        return self.name, packed

    def _promising(self, data: Buffer, level: int, bound: float) -> bool:
        """True if samples shrink to a share, or the data is hardly larger than the samples.

        They are compressed as the chunk would be: level 1 finds nothing in a noisy picture
        of which level 3 saves a third.
        """
        if len(data) < 4 * _SAMPLE * _SAMPLES:
            return True
        view = memoryview(data)
        step = (len(data) - _SAMPLE) // (_SAMPLES - 1)
        sample = b"".join(view[i * step : i * step + _SAMPLE] for i in range(_SAMPLES))
        return len(self._pack(sample, level)) <= len(sample) * bound

    def _pack(self, data: Buffer, level: int) -> bytes:
        if self.name == "lz4":
            packed: bytes = lz4.frame.compress(data, compression_level=level, store_size=True)
            return packed
        return _compressor(get_ident(), level, check=False).compress(data)
