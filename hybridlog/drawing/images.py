"""Image messages as files that viewers and browsers show."""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from msgspec import Struct

from hybridlog.arrays.message_arrays import COMPRESSED_IMAGES, IMAGES, depth_picture
from hybridlog.drawing.pixels import pixels, png
from hybridlog_storage.errors import MissingDependencyError, PayloadError

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
    """The pixels of an image message, as `hybridlog.drawing.pixels.pixels` gives them."""
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
            if not raw and is_shown and not is_deep:
                _check_size(data)
                return Picture(media_type, suffix, data)
            return Picture(media_type, suffix, data) if raw else None
    raise PayloadError(
        f"a compressed image begins like no known format; it says that it is {form[:40]!r}"
    )


def _check_size(data: bytes) -> None:
    """Refuse a small file that would fill the memory of the program that shows it."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        return  # then nothing is decoded here, and the browser has its own bounds
    size = (0, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with suppress(UnidentifiedImageError, OSError, ValueError, SyntaxError, struct.error):
            try:
                with Image.open(io.BytesIO(data)) as image:
                    size = image.size
            except Image.DecompressionBombError as error:
                raise PayloadError(f"an image is too large to be shown: {error}") from error
    if size[0] * size[1] > MAX_SHOWN:
        raise PayloadError(
            f"an image of {size[0]} x {size[1]} pixels is too large to be shown; "
            "`hybridlog fetch --format png` writes it to a file"
        )


def _jpeg(shown: NDArray[np.uint8]) -> bytes:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingDependencyError(
            "JPEG needs Pillow: pip install 'hybridlog[images]'"
        ) from error

    file = io.BytesIO()
    try:
        Image.fromarray(shown).save(file, "JPEG", quality=90)
    except OSError as error:
        raise PayloadError(f"an image cannot be JPEG: {error}") from error
    return file.getvalue()
