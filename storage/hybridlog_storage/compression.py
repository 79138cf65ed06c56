"""Compressing chunks that gain from it, and decompressing what cannot be trusted.

A size that a file claims is compared with a limit, and with what its codec can reach
at all, before a byte is allocated for it.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Literal

import lz4.frame
import zstandard

from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hybridlog_storage.messages import Buffer

MAX_UNCOMPRESSED = 1 << 30
"""Largest chunk, in uncompressed bytes, that is decompressed unless told otherwise."""

# What one compressed byte can become at most: an RLE block of zstd spends 4 bytes on
# 128 KiB, a run of lz4 one byte on 255. A claim beyond that is a lie, whatever follows.
_MAX_RATIO = {"zstd": 1 << 15, "lz4": 255}
_RATIO_SLACK = 1 << 17

_PIECE = 1 << 18
# In a hurry: what shrinks to this share is compressed sooner than it is written whole,
_WORTH_IT = 0.2
_FAST = 1  # at this level of either codec, which samples are tried with, too.

_per_thread = threading.local()


def decompress(
    compression: str, data: Buffer, uncompressed_size: int, *, limit: int = MAX_UNCOMPRESSED
) -> bytes | memoryview:
    """The content of a chunk.

    Args:
        compression: MCAP name of the codec: `zstd`, `lz4`, or empty for none.
        data: What the codec made.
        uncompressed_size: Bytes that must come out.
        limit: Most bytes that may come out.

    Returns:
        `uncompressed_size` bytes; for no codec, a view of `data`.

    Raises:
        SegmentError: The codec is not known, the size is above the limit or differs
            from what comes out, or the data is damaged.
    """
    if uncompressed_size > limit:
        raise SegmentError(
            f"it claims {uncompressed_size} bytes uncompressed, more than the limit of {limit}"
        )
    if compression == "":
        if len(data) != uncompressed_size:
            raise SegmentError(f"it holds {len(data)} bytes, not {uncompressed_size} as it claims")
        return memoryview(data)
    if compression not in _MAX_RATIO:
        raise SegmentError(
            f"its compression {compression[:32]!r} is not known; rewrite the file with zstd"
        )
    if uncompressed_size > len(data) * _MAX_RATIO[compression] + _RATIO_SLACK:
        raise SegmentError(
            f"it claims {uncompressed_size} bytes uncompressed, which {len(data)} bytes "
            f"of {compression} cannot hold"
        )
    try:
        if compression == "zstd":
            return _unpack_zstd(data, uncompressed_size)
        return _unpack_lz4(data, uncompressed_size)
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise SegmentError(f"its {compression} data is damaged ({error})") from error


def decompress_prefix(
    compression: str, data: Buffer, uncompressed_size: int, *, limit: int = MAX_UNCOMPRESSED
) -> bytes | memoryview:
    """What can be decompressed of data whose end is missing or damaged.

    Args:
        compression: MCAP name of the codec.
        data: The beginning of what the codec made.
        uncompressed_size: Bytes that the whole would give.
        limit: Most bytes that may come out.

    Returns:
        The beginning of the content, perhaps nothing.
    """
    most = min(uncompressed_size, limit)
    if compression == "":
        return memoryview(data)[:most]
    pieces = {"zstd": _zstd_pieces, "lz4": _lz4_pieces}.get(compression)
    out = bytearray()
    if pieces is not None:
        try:
            for piece in pieces(data):
                out += piece
                if len(out) >= most:
                    break
        except (zstandard.ZstdError, RuntimeError, MemoryError):
            pass  # the pieces before it are sound
    return bytes(out[:most])


def _decompressor() -> zstandard.ZstdDecompressor:
    try:
        found: zstandard.ZstdDecompressor = _per_thread.decompressor
    except AttributeError:
        found = _per_thread.decompressor = zstandard.ZstdDecompressor()
    return found


def _unpack_zstd(data: Buffer, size: int) -> bytes | memoryview:
    claimed = zstandard.frame_content_size(data)
    if claimed > size:
        raise SegmentError(f"its zstd frame holds {claimed} bytes, not {size} as it claims")
    if claimed == size:
        return _decompressor().decompress(data, allow_extra_data=False)
    # No size in the frame, or several frames one after the other.
    out = bytearray(size)
    reader = _decompressor().stream_reader(memoryview(data), read_across_frames=True)
    view, filled = memoryview(out), 0
    while filled < size and (count := reader.readinto(view[filled:])):
        filled += count
    if filled != size or reader.read(1):
        more = "more" if filled == size else "only " + str(filled)
        raise SegmentError(f"it decompresses to {more} bytes, not {size} as it claims")
    return view.toreadonly()


def _unpack_lz4(data: Buffer, size: int) -> bytes:
    # One byte more than expected shows data that goes on.
    out: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if len(out) != size:
        more = "more" if len(out) > size else "only " + str(len(out))
        raise SegmentError(f"it decompresses to {more} bytes, not {size} as it claims")
    return out


def _zstd_pieces(data: Buffer) -> Iterator[bytes]:
    reader = _decompressor().stream_reader(memoryview(data), read_across_frames=True)
    while piece := reader.read(_PIECE):
        yield piece


def _lz4_pieces(data: Buffer) -> Iterator[bytes]:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    view = memoryview(data)
    for at in range(0, len(view), _PIECE):
        piece: bytes = decompressor.decompress(view[at : at + _PIECE], max_length=_PIECE)
        yield piece
        while not decompressor.eof and not decompressor.needs_input:
            piece = decompressor.decompress(b"", max_length=_PIECE)
            yield piece
        if decompressor.eof:
            return


class Compressor:
    """Compresses chunks, and leaves alone those that would not shrink.

    Images, and anything else that was compressed before, cost much time and gain
    nothing. So a large chunk is tried on a few samples first, and whatever gains less
    than `min_gain` is stored as it is, which spares every reader the decompression too.
    May be used by several threads at once; the interpreter lock is free meanwhile.

    Args:
        name: The codec; `none` stores everything as it is.
        level: Level of the codec: 1 to 22 for zstd (negative: faster), 0 to 16 for lz4.
        sample_size: Bytes of one sample.
        samples: Number of samples, spread evenly over the chunk.
        min_gain: Share of the size that compressing must save, 0 to 1.

    Raises:
        ValueError: The codec is not known or the level not allowed.
    """

    def __init__(
        self,
        name: Literal["zstd", "lz4", "none"] = "zstd",
        level: int = 1,
        *,
        sample_size: int = 8192,
        samples: int = 6,
        min_gain: float = 0.03,
    ) -> None:
        if name not in {"zstd", "lz4", "none"}:
            raise ValueError(f"compression {name!r} is not known; use zstd, lz4 or none")
        if name == "zstd" and level > zstandard.MAX_COMPRESSION_LEVEL:
            raise ValueError(f"zstd has levels up to {zstandard.MAX_COMPRESSION_LEVEL}")
        if name == "lz4" and level > lz4.frame.COMPRESSIONLEVEL_MAX:
            raise ValueError(f"lz4 has levels up to {lz4.frame.COMPRESSIONLEVEL_MAX}")
        self.name = name
        self.level = level
        self._sample_size = sample_size
        self._samples = samples
        self._keep_above = 1.0 - min_gain
        self._own = threading.local()  # a ZstdCompressor must not be shared by threads

    def compress(self, data: Buffer, *, hurried: bool = False) -> tuple[str, Buffer]:
        """Compress a chunk if that is worth it.

        Args:
            data: Content of the chunk.
            hurried: Whether there is time only for what shrinks to a fifth or less, as its
                samples say, and for no level above 1.

        Returns:
            MCAP name of the codec and the compressed bytes, or the empty name and `data`
            itself.
        """
        bound = _WORTH_IT if hurried else self._keep_above
        if self.name == "none" or len(data) == 0 or not self._promising(data, bound):
            return "", data
        packed = self._pack(data, min(self.level, _FAST) if hurried else self.level)
        if len(packed) > len(data) * self._keep_above:
            return "", data
        return self.name, packed

    def _promising(self, data: Buffer, bound: float) -> bool:
        """Whether samples shrink to a share; always for data hardly larger than the samples."""
        tried = self._sample_size * self._samples
        if len(data) < 4 * tried:
            return True
        view = memoryview(data)
        step = (len(data) - self._sample_size) // (self._samples - 1) if self._samples > 1 else 0
        sample = b"".join(
            view[i * step : i * step + self._sample_size] for i in range(self._samples)
        )
        return len(self._pack(sample, _FAST)) <= len(sample) * bound

    def _pack(self, data: Buffer, level: int) -> bytes:
        if self.name == "lz4":
            packed: bytes = lz4.frame.compress(data, compression_level=level, store_size=True)
            return packed
        compressors: dict[int, zstandard.ZstdCompressor] = self._own.__dict__.setdefault("by", {})
        compressor = compressors.get(level)
        if compressor is None:
            compressor = compressors[level] = zstandard.ZstdCompressor(level=level)
        return compressor.compress(data)
