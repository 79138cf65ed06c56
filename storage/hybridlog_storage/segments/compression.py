"""Compresses chunks that gain from it, and decompresses untrusted data.

A size claimed by a file is compared with a limit, and with the ratio of its codec, before
memory is allocated. Above `MAX_FREE` bytes, content may be `MAX_RATIO` times as large as its
compressed form; `Compressor` keeps to that, too.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING, Literal

import lz4.frame
import zstandard

from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer

MAX_UNCOMPRESSED = 1 << 30
"""Most bytes of a chunk's content."""
MAX_FREE = 256 << 20
"""Uncompressed size up to which any ratio is believed, bytes."""
MAX_RATIO = 100
"""Largest believed ratio above that."""

# Maximum ratio of each codec: an RLE block of zstd spends 4 bytes on 128 KiB, a run of
# lz4 one byte on 255. A larger claim is false.
_MAX_RATIO = {"zstd": 1 << 15, "lz4": 255}
_RATIO_SLACK = 1 << 17

_PIECE = 1 << 20  # bytes decompressed at once of a frame that is cut
_SAMPLE = 8192  # bytes of one sample of a chunk
_SAMPLES = 6
_MAX_SHARE = 0.97  # of its size that a compressed chunk may have
# In a hurry: compressing to this share or less is faster than writing uncompressed,
_WORTH_IT = 0.2
_FAST = 1  # at this level of either codec.


def decompress(compression: str, data: Buffer, uncompressed_size: int) -> bytes | memoryview:
    """Decompress the content of a chunk; without a codec, a view of `data`.

    `compression` is its name in MCAP: `zstd`, `lz4`, or empty for none. `SegmentError` if the
    output has not `uncompressed_size`, or that is more than what the data can hold.
    """
    size = uncompressed_size
    if compression == "":
        if len(data) != size:
            raise SegmentError(f"it holds {len(data)} bytes, not {size} as it claims")
        return memoryview(data)
    if compression not in _MAX_RATIO:
        raise SegmentError(
            f"its compression {compression[:32]!r} is not known; rewrite the file with zstd"
        )
    most = min(len(data) * _MAX_RATIO[compression] + _RATIO_SLACK, MAX_UNCOMPRESSED)
    if size > most or is_implausible(size, len(data)):
        raise SegmentError(
            f"it claims {size} bytes uncompressed, which is not believed of its {len(data)} "
            f"bytes of {compression}"
        )
    try:
        found = _unpacked(compression, data, size)
    except MemoryError as error:
        raise SegmentError(f"there is no memory for its {size} bytes") from error
    except (zstandard.ZstdError, RuntimeError) as error:
        raise SegmentError(f"its {compression} data is damaged ({error})") from error
    if len(found) != size:
        raise SegmentError(f"it does not decompress to {size} bytes as it claims")
    return found


def beginning(compression: str, data: Buffer, size: int) -> bytes:
    """The first bytes of a content of `size` bytes, as far as a truncated frame holds them."""
    if not compression:
        return bytes(data[:size])
    found = bytearray()
    with suppress(zstandard.ZstdError, RuntimeError):
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
        reader = zstandard.ZstdDecompressor().stream_reader(data)
        while piece := reader.read(min(size - len(found), _PIECE)):
            found += piece
    return bytes(found)


def is_implausible(uncompressed_size: int, size: int) -> bool:
    """True if this much content of so few compressed bytes is not believed."""
    return uncompressed_size > MAX_FREE and uncompressed_size > size * MAX_RATIO


def _unpacked(compression: str, data: Buffer, size: int) -> bytes:
    """The content of one frame; if that has another size, some of it."""
    if compression == "zstd":
        if zstandard.frame_content_size(data) not in {-1, size}:
            return b"" if size else b"?"
        most = max(size, 1)
        return _decompressor(get_ident()).decompress(data, most, allow_extra_data=False)
    frame = lz4.frame.LZ4FrameDecompressor()
    found: bytes = frame.decompress(data, max_length=size + 1)
    if len(found) == size and (not frame.eof or frame.unused_data):
        raise RuntimeError("it does not end where it should")
    return found


@lru_cache(maxsize=64)
def _decompressor(_thread: int) -> zstandard.ZstdDecompressor:
    return zstandard.ZstdDecompressor()  # which threads must not share


@lru_cache(maxsize=64)
def _compressor(_thread: int, level: int, *, check: bool) -> zstandard.ZstdCompressor:
    return zstandard.ZstdCompressor(level=level, write_checksum=check)


def checked_frame(data: Buffer) -> bytes:
    """Data as one zstd frame with a checksum of its content."""
    return _compressor(get_ident(), 1, check=True).compress(data)


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
