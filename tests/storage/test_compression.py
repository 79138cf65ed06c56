"""Chunks come out as they went in, lies about their size are refused before allocation."""

from __future__ import annotations

import os

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import Compressor, decompress
from tests.calls import Calls

TEXT = b"".join(b"%d: the robot is at %d\n" % (i, i * 7919) for i in range(40_000))
NOISE = os.urandom(1 << 20)


def packed(name: str, data: bytes) -> bytes:
    if name == "zstd":
        return zstandard.ZstdCompressor().compress(data)
    if name == "lz4":
        return lz4.frame.compress(data)
    return data


@given(
    st.lists(st.binary(max_size=3000), max_size=20).map(b"".join),
    st.sampled_from(["zstd", "lz4", "none"]),
    st.integers(1, 9),
)
def test_compressor_and_decompress_are_inverse(data: bytes, name: str, level: int) -> None:
    compression, out = Compressor(name, level).compress(data)  # type: ignore[arg-type]
    assert bytes(decompress(compression, out, len(data))) == data
    assert len(out) <= len(data)


@pytest.mark.parametrize("name", ["zstd", "lz4"])
def test_text_is_compressed_and_noise_is_stored_as_it_is(name: str) -> None:
    compressor = Compressor(name)  # type: ignore[arg-type]
    compression, out = compressor.compress(TEXT)
    assert compression == name
    assert len(out) < len(TEXT) / 2
    compression, out = compressor.compress(NOISE)
    assert compression == ""
    assert out is NOISE


def test_noise_is_never_given_to_the_codec_as_a_whole(calls: Calls) -> None:
    compressor = Compressor()
    sizes: list[int] = []
    calls(compressor, "_pack", lambda data, _: sizes.append(len(data)))
    compressor.compress(NOISE)
    assert sum(sizes) <= len(NOISE) // 16
    sizes.clear()
    compressor.compress(TEXT)
    assert max(sizes) == len(TEXT)


def test_a_noisy_picture_is_compressed_at_the_level_that_shrinks_it() -> None:
    noise = np.random.default_rng(1).integers(0, 4, (4, 480, 640))
    picture = (2 * np.arange(640) + np.arange(480)[:, None] + noise).astype(np.uint8).tobytes()
    assert Compressor(level=1).compress(picture) == ("", picture)
    compression, out = Compressor(level=3).compress(picture)
    assert (compression, len(out) < 0.7 * len(picture)) == ("zstd", True)
    assert Compressor(level=3).compress(picture, hurried=True) == ("", picture)


@pytest.mark.parametrize("name", ["zstd", "lz4"])
@pytest.mark.parametrize("offset", [-1, 1, -1000, 1000])
def test_a_size_that_is_not_what_comes_out_is_an_error(name: str, offset: int) -> None:
    with pytest.raises(SegmentError, match="claims"):
        decompress(name, packed(name, TEXT[:5000]), 5000 + offset)


def test_zstd_frames_without_size_are_read() -> None:
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(TEXT)
    assert bytes(decompress("zstd", packed, len(TEXT))) == TEXT
    for size in (0, len(TEXT) - 1, len(TEXT) + 1):
        with pytest.raises(SegmentError):
            decompress("zstd", packed, size)
    with pytest.raises(SegmentError, match="damaged"):  # a second frame
        decompress("zstd", packed + packed, len(TEXT))


@pytest.mark.parametrize("name", ["zstd", "lz4"])
@given(data=st.data())
def test_damaged_data_is_an_error_or_the_content(name: str, data: st.DataObject) -> None:
    good = packed(name, TEXT[:2000])
    at = data.draw(st.integers(0, len(good) - 1))
    bad = bytearray(good)
    bad[at] ^= data.draw(st.integers(1, 255))
    try:
        out = decompress(name, bytes(bad), 2000)
    except SegmentError:
        return
    assert len(out) == 2000  # only a checksum can tell more
