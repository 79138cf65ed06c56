"""Small pictures of image messages, as PNG."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIDE = 160
"""Most pixels of a side."""
_YUV_LUMA = {"yuv422_yuy2": 0, "yuyv": 0, "yuv422": 1, "uyvy": 1}
"""The channel with the brightness."""
_PLANAR = {"nv12": 1.5, "nv21": 1.5, "nv24": 3.0}
"""Rows of all planes for each row of the image; the brightness comes first."""


def thumbnail(image: NDArray[Any], encoding: str = "rgb8") -> bytes:
    """A picture of at most `SIDE` pixels a side, as PNG; empty for an empty image.

    Only the pixels of the picture are looked at. Values of more than 8 bits are spread between
    the least and the greatest finite one; missing ones (NaN) are black.

    Args:
        image: Shape (height, width) or (height, width, channels), as of `Message.to_numpy`.
        encoding: Encoding of the message.
    """
    encoding = encoding.strip().lower()
    height, width = image.shape[:2]
    height = int(height / _PLANAR.get(encoding, 1))
    if not height or not width:
        return b""
    step = -(-max(height, width) // SIDE)
    small = image[:height:step, ::step]
    if encoding in _YUV_LUMA:
        small = small[..., _YUV_LUMA[encoding]]
    if small.ndim == 3:
        small = small[..., :3] if small.shape[2] >= 3 else small[..., 0]
    if small.ndim == 3 and encoding.startswith("bgr"):
        small = small[..., ::-1]
    return _png(_bytes(small))


def _bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    numbers = values.astype(np.float64)
    finite = np.isfinite(numbers)
    pixels: NDArray[np.uint8] = np.zeros(values.shape, np.uint8)
    if finite.any():
        # Halved, so that the range of the greatest numbers is finite, too.
        low, high = numbers[finite].min() / 2, numbers[finite].max() / 2
        share = (numbers[finite] / 2 - low) / (high - low if high > low else 1)
        pixels[finite] = (share * 255).astype(np.uint8)
    return pixels


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """A PNG file of grey or RGB pixels, uint8."""
    height, width = pixels.shape[:2]
    colour = 2 if pixels.ndim == 3 else 0
    # Each row begins with its filter; 0 is none.
    rows = np.zeros((height, 1 + pixels[0].size), np.uint8)
    rows[:, 1:] = pixels.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
