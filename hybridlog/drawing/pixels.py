"""Images of any encoding as grey or coloured pixels, and pixels as PNG."""

from __future__ import annotations

import struct
from itertools import starmap
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from isal import isal_zlib

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LUMA: Final = {"yuv422_yuy2": 0, "yuyv": 0, "yuv422": 1, "uyvy": 1}
"""YUV 4:2:2: the channel with the brightness; the other one has a colour."""
_PLANES: Final = {"nv12": ("uv", 2), "nv21": ("vu", 2), "nv24": ("uv", 1)}
"""Order of the colours, and pixels that share one, in each direction."""
_BAYER: Final = "bayer_"


def pixels(image: NDArray[Any], encoding: str = "rgb8", *, deep: bool = False) -> NDArray[Any]:
    """The pixels of an image, as of `Message.to_numpy`, as grey or red, green and blue.

    YUV is converted by ITU-R BT.601, Bayer patterns are interpolated. Values of other types than
    `uint8` are spread between the least and the greatest finite one; missing ones (NaN) are black.
    Shape (height, width) or (height, width, 3), uint8. `deep` ones keep values of uint16 as they
    are, and transparency: (height, width, 4).
    """
    encoding = encoding.strip().lower()
    if encoding in _PLANES:
        return _from_planes(image, *_PLANES[encoding])
    if encoding in _LUMA:
        return _from_pairs(image, _LUMA[encoding])
    if encoding.startswith(_BAYER):
        return _in_range(_from_bayer(image, encoding.removeprefix(_BAYER)[:4]), deep=deep)
    if image.ndim == 3:
        has_alpha = deep and image.shape[2] == 4 and encoding[:4] in {"rgba", "bgra"}
        colours = image[..., :3] if image.shape[2] >= 3 else image[..., 0]
        if encoding.startswith("bgr"):
            colours = colours[..., ::-1]
        image = np.dstack([colours, image[..., 3]]) if has_alpha else colours
    return _in_range(image, deep=deep)


def _from_pairs(image: NDArray[Any], bright: int) -> NDArray[np.uint8]:
    """YUV 4:2:2: two pixels in a row share their colour."""
    luma, colour = image[..., bright], image[..., 1 - bright]
    at = np.arange(image.shape[1]) // 2 * 2
    # The last pixel of an odd row has no second colour.
    second = np.minimum(at + 1, max(image.shape[1] - 1, 0))
    return _from_yuv(luma, colour[:, at], colour[:, second])


def _from_planes(image: NDArray[Any], order: str, shared: int) -> NDArray[np.uint8]:
    """Brightness in a plane, then pairs of colours."""
    height = image.shape[0] * 2 // 3 if shared == 2 else image.shape[0] // 3
    width = image.shape[1]
    luma = image[:height]
    if not luma.size:
        return np.empty(luma.shape, np.uint8)
    colours = image[height:].reshape(-(-height // shared), -1)
    rows = np.arange(height) // shared
    at = np.minimum(np.arange(width) // shared * 2, colours.shape[1] - 2)
    planes = dict(
        zip(order, (colours[np.ix_(rows, at)], colours[np.ix_(rows, at + 1)]), strict=True)
    )
    return _from_yuv(luma, planes["u"], planes["v"])


def _from_yuv(y: NDArray[Any], u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.uint8]:
    luma = 1.164 * (y.astype(np.float32) - 16)
    blue, red = u.astype(np.float32) - 128, v.astype(np.float32) - 128
    found = np.empty((*y.shape, 3), np.uint8)
    for place, values in enumerate(
        (luma + 1.596 * red, luma - 0.392 * blue - 0.813 * red, luma + 2.017 * blue)
    ):
        found[..., place] = np.rint(np.clip(values, 0, 255))
    return found


def _from_bayer(mosaic: NDArray[Any], order: str) -> NDArray[Any]:
    """Colours of a mosaic: known samples stay, others are means of their neighbours."""
    values = mosaic.astype(np.float32)
    found = np.empty((*mosaic.shape, 3), mosaic.dtype)
    for place, colour in enumerate("rgb"):
        is_known = np.zeros(mosaic.shape, np.bool_)
        for cell, name in enumerate(order):
            if name == colour:
                is_known[cell // 2 :: 2, cell % 2 :: 2] = True
        weights = _spread(is_known.astype(np.float32))
        means = np.rint(_spread(np.where(is_known, values, 0)) / np.maximum(weights, 1))
        found[..., place] = np.where(is_known, mosaic, means)
    return found


def _spread(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over 3 x 3 neighbours with weights 1, 2, 1 in each direction."""
    padded = np.pad(values, 1)
    rows = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    found: NDArray[np.float32] = rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]
    return found


def _in_range(values: NDArray[Any], *, deep: bool) -> NDArray[Any]:
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    if deep and values.dtype.newbyteorder("=") == np.uint16:
        return np.ascontiguousarray(values, np.uint16)
    numbers = values.astype(np.float64)
    finite = np.isfinite(numbers)
    found: NDArray[np.uint8] = np.zeros(values.shape, np.uint8)
    if finite.any():
        # Halved, so that the range of the greatest numbers is finite, too.
        low, high = numbers[finite].min() / 2, numbers[finite].max() / 2
        share = (numbers[finite] / 2 - low) / (high - low if high > low else 1)
        found[finite] = (share * 255).astype(np.uint8)
    return found


_COLOURS: Final = {1: 0, 3: 2, 4: 6}
"""The number of each kind of pixel in a PNG file, by channels."""
_UP: Final = 2
"""Filter of PNG: each byte less the one above it."""


def png(pixels: NDArray[Any]) -> bytes:
    """A PNG file of pixels, (height, width) or with 3 or 4 channels; uint8 or uint16; not none."""
    height, width = pixels.shape[:2]
    samples = (
        pixels.astype(pixels.dtype.newbyteorder(">"), copy=False).view(np.uint8).reshape(height, -1)
    )
    rows = np.empty((height, 1 + samples.shape[1]), np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = samples[0]
    np.subtract(samples[1:], samples[:-1], out=rows[1:, 1:])
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    depth = 8 * pixels.dtype.itemsize
    header = struct.pack(">IIBBBBB", width, height, depth, _COLOURS[channels], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", isal_zlib.compress(rows.data, 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(starmap(_chunk, chunks))


def _chunk(name: bytes, data: bytes) -> bytes:
    checksum = isal_zlib.crc32(data, isal_zlib.crc32(name))
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)
