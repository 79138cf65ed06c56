"""Image messages of any encoding as pixels, and as files that viewers and browsers show."""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Sequence
from contextlib import suppress
from itertools import starmap
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from isal import isal_zlib
from msgspec import Struct

from hybridlog.arrays.message_arrays import COMPRESSED_IMAGES, IMAGES, depth_picture
from hybridlog_storage.errors import PayloadError, extra

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message


class Picture(Struct, frozen=True):
    """An image as the content of a file, with a suffix (`.png`) and a type (`image/png`)."""

    media_type: str
    suffix: str
    data: bytes


MAX_SHOWN: Final = 1 << 26
"""Most pixels of a compressed picture that is for the eye."""
# Media type, suffix, whether browsers show it, and what it begins with: bytes at offsets.
_KINDS: Final[Sequence[tuple[str, str, bool, dict[int, bytes]]]] = (
    ("image/jpeg", ".jpg", True, {0: b"\xff\xd8\xff"}),
    ("image/png", ".png", True, {0: b"\x89PNG\r\n\x1a\n"}),
    ("image/webp", ".webp", True, {0: b"RIFF", 8: b"WEBP"}),
    ("image/gif", ".gif", True, {0: b"GIF8"}),
    ("image/avif", ".avif", True, {4: b"ftypavif"}),
    ("image/bmp", ".bmp", True, {0: b"BM", 6: bytes(4)}),
    ("image/tiff", ".tif", False, {0: b"II*\0"}),
    ("image/tiff", ".tif", False, {0: b"MM\0*"}),
    ("image/jp2", ".jp2", False, {4: b"jP  \r\n\x87\n"}),
    ("image/jxl", ".jxl", False, {4: b"JXL \r\n\x87\n"}),
    ("image/jxl", ".jxl", False, {0: b"\xff\x0a"}),
)
_DEEP_GREY: Final = b"\x10\x00"
"""16 bits, one channel: bytes 24 and 25 of a PNG file."""


def picture(message: Message, *, raw: bool = True, form: Literal["png", "jpg"] = "png") -> Picture:
    """An image message, of one of the types `IMAGES`, as a file.

    A compressed image is returned as it came; its bytes say what it is, not its `format`. The depth
    image of `compressedDepth` is PNG with 16 bits, or with 8 from least to greatest where it is of
    floats. An uncompressed image is encoded in the given form: YUV and Bayer patterns become
    colours, and `mono16` and the like keep 16 bits in PNG; other values than `uint8` and `uint16`
    are spread from least to greatest.

    One that is not `raw` is for the eye, and every browser shows it: formats which browsers lack
    are encoded anew, and 16 bits are spread over 8.
    """
    kind = message.type.replace("/msg/", "/")
    if kind not in IMAGES:
        raise PayloadError(f"{message.type} is no image; {', '.join(sorted(IMAGES))} are.")
    decoded = message.decode()
    if kind in COMPRESSED_IMAGES:
        found = _as_it_came(decoded, raw=raw)
        if found is not None:
            return found
    shown = shown_pixels(message, deep=raw and form == "png")
    if form == "jpg":
        return Picture("image/jpeg", ".jpg", _jpeg(shown))
    return Picture("image/png", ".png", png(shown))


def shown_pixels(message: Message, *, deep: bool = False) -> NDArray[Any]:
    """The pixels of an image message, as `pixels` gives them."""
    image, encoding = message.to_numpy(), getattr(message.decode(), "encoding", "rgba8")
    shown = pixels(image, str(encoding), deep=deep)
    if not shown.size:
        raise PayloadError("an image without pixels cannot be a picture")
    return shown


def _as_it_came(message: Any, *, raw: bool) -> Picture | None:
    """A compressed image unchanged; None if it has to be encoded anew."""
    data, form = bytes(message.data), str(message.format)
    if "compressedDepth" in form:
        data = depth_picture(form, data) or b""
    if not data:
        return None
    for media_type, suffix, is_shown, marks in _KINDS:
        if all(data.startswith(mark, at) for at, mark in marks.items()):
            is_deep = suffix == ".png" and data[24:26] == _DEEP_GREY
            if not raw and (is_deep or not is_shown):
                return None
            if not raw:
                _check_size(data)
            return Picture(media_type, suffix, data)
    raise PayloadError(
        f"a compressed image begins like no known format; it says that it is {form[:40]!r}"
    )


def _check_size(data: bytes) -> None:
    """Refuse a small file that would fill the memory of the program that shows it."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        return  # then nothing is decoded here, and the browser has its own bounds
    with (
        warnings.catch_warnings(action="ignore"),
        suppress(UnidentifiedImageError, OSError, ValueError, SyntaxError, struct.error),
    ):
        try:
            with Image.open(io.BytesIO(data)) as image:
                is_large = image.width * image.height > MAX_SHOWN
        except Image.DecompressionBombError:
            is_large = True
        if is_large:
            raise PayloadError(
                "an image has too many pixels to be shown; `hybridlog fetch --format png` writes "
                "it to a file"
            )


def _jpeg(shown: NDArray[np.uint8]) -> bytes:
    with extra("images", "JPEG needs Pillow"):
        from PIL import Image

    file = io.BytesIO()
    try:
        Image.fromarray(shown).save(file, "JPEG", quality=90)
    except OSError as error:
        raise PayloadError(f"an image cannot be JPEG: {error}") from error
    return file.getvalue()


# Pixels.

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
