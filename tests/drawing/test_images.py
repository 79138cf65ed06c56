"""Pictures of images of every encoding, and as `fetch` writes them, read back by Pillow."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Pillow

from hybridlog.arrays.message_arrays import IMAGES, VIDEOS, to_numpy
from hybridlog.drawing.images import Picture, picture, pixels
from hybridlog_storage.errors import MissingDependencyError, PayloadError
from tests.calls import Calls
from tests.cli.within import Answer, answer

from .conftest import BASE, FILES, MS, SEEN, Drive, encoded

RNG = np.random.default_rng(3)
GREY = RNG.integers(0, 256, (5, 7), np.uint8)
COLOURS = RNG.integers(0, 256, (5, 7, 4), np.uint8)


class Sent:
    """A message that is decoded already."""

    def __init__(self, kind: str, **fields: Any) -> None:
        self.type = kind
        self._fields = SimpleNamespace(**fields)

    def decode(self) -> SimpleNamespace:
        return self._fields

    def to_numpy(self) -> Any:
        return to_numpy(self.type, self._fields)


def raw(encoding: str, array: NDArray[Any], *, height: int | None = None, **other: Any) -> Any:
    fields = {
        "encoding": encoding,
        "height": len(array) if height is None else height,
        "width": array.shape[1],
        "step": array.strides[0],
        "is_bigendian": int(array.dtype.byteorder == ">"),
        "data": np.frombuffer(array.tobytes(), np.uint8),
    }
    return Sent("sensor_msgs/msg/Image", **(fields | other))


def compressed(form: str, data: bytes, kind: str = "sensor_msgs/msg/CompressedImage") -> Any:
    return Sent(kind, format=form, data=np.frombuffer(data, np.uint8))


def seen(found: Picture) -> NDArray[Any]:
    assert (found.media_type, found.suffix) == ("image/png", ".png")
    with Pillow.open(io.BytesIO(found.data)) as image:
        assert image.format == "PNG"
        return np.asarray(image)


def chunks_of(data: bytes) -> dict[bytes, bytes]:
    found: dict[bytes, bytes] = {}
    at = 8
    while at < len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        found[data[at + 4 : at + 8]] = data[at + 8 : at + 8 + size]
        at += 12 + size
    return found


@pytest.mark.parametrize(
    ("encoding", "array", "want"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("rgb8", COLOURS[..., :3], COLOURS[..., :3]),
        ("bgr8", COLOURS[..., :3], COLOURS[..., 2::-1]),
        ("rgba8", COLOURS, COLOURS),
        ("bgra8", COLOURS, COLOURS[..., [2, 1, 0, 3]]),
        ("8UC3", COLOURS[..., :3], COLOURS[..., :3]),
        ("8UC4", COLOURS, COLOURS[..., :3]),
        ("8UC2", COLOURS[..., :2], COLOURS[..., 0]),
        ("mono16", GREY.astype(np.uint16) * 257, GREY.astype(np.uint16) * 257),
        ("16UC1", (GREY.astype(np.uint16) * 9).astype(">u2"), GREY.astype(np.uint16) * 9),
        ("8SC1", np.array([[-128, 0, 127]], np.int8), [[0, 128, 255]]),
        ("16SC1", np.array([[-5, 0, 5]], np.int16), [[0, 127, 255]]),
        ("32SC1", np.array([[-5, 5]], ">i4"), [[0, 255]]),
        ("32FC1", np.array([[np.nan, 1, 2, 3, np.inf]], np.float32), [[0, 0, 127, 255, 0]]),
        ("64FC1", np.array([[7.0, 7.0]]), [[0, 0]]),
        ("32FC3", np.array([[[0, 1, 2]]], np.float32), [[[0, 127, 255]]]),
    ],
)
def test_encodings(encoding: str, array: NDArray[Any], want: Any) -> None:
    got = seen(picture(raw(encoding, np.ascontiguousarray(array))))
    assert np.array_equal(got, want)


@pytest.mark.parametrize("encoding", ["rgb16", "bgr16", "rgba16", "bgra16"])
def test_colours_of_16_bits_are_kept(encoding: str) -> None:
    """Pillow reads no such file whole, so the pixels are looked for in it."""
    import zlib

    channels = len(encoding) - 2
    array = RNG.integers(0, 1 << 16, (3, 4, channels)).astype(np.uint16)
    for order in "<>":
        found = picture(raw(encoding, array.astype(f"{order}u2")))
        chunks = chunks_of(found.data)
        head = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
        assert head == (4, 3, 16, {3: 2, 4: 6}[channels], 0, 0, 0)
        rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(3, -1)
        assert rows[:, 0].tolist() == [2, 2, 2]
        plain = np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8)
        got = plain.view(">u2").reshape(3, 4, channels)
        at = [2, 1, 0, 3][:channels] if encoding.startswith("b") else [*range(channels)]
        assert np.array_equal(got, array[..., at])
    with Pillow.open(io.BytesIO(found.data)) as image:
        image.load()  # its checksums and sizes are right


def from_yuv(y: float, u: float, v: float) -> list[int]:
    """A pixel by the inverse of the matrix of BT.601 with a range of 16 to 235."""
    red, blue = 0.299, 0.114
    green = 1 - red - blue
    forward = np.array(
        [
            [red, green, blue],
            [-red / (2 - 2 * blue), -green / (2 - 2 * blue), 0.5],
            [0.5, -green / (2 - 2 * red), -blue / (2 - 2 * red)],
        ]
    )
    rgb = np.linalg.inv(forward) @ [(y - 16) / 219, (u - 128) / 224, (v - 128) / 224]
    return [round(float(np.clip(value, 0, 1)) * 255) for value in rgb]


YUV = RNG.integers(0, 256, (3, 6, 8), np.uint8)  # y, u, v


@pytest.mark.parametrize(
    "encoding", ["yuv422", "uyvy", "yuv422_yuy2", "YUYV", "nv12", "nv21", "nv24"]
)
def test_yuv(encoding: str) -> None:
    y, u, v = YUV.astype(int)
    rows, columns = {"nv12": (2, 2), "nv21": (2, 2), "nv24": (1, 1)}.get(encoding, (1, 2))
    u, v = (plane[::rows, ::columns] for plane in (u, v))
    if encoding.startswith("nv"):
        first, second = (v, u) if encoding == "nv21" else (u, v)
        colours = np.dstack([first, second]).reshape(-1, 8)
        message = raw(encoding, np.vstack([y, colours]).astype(np.uint8), height=6)
    else:
        pairs = np.empty((6, 8), np.uint8)
        pairs[:, ::2], pairs[:, 1::2] = u, v
        bright = encoding.lower() in {"yuv422_yuy2", "yuyv"}
        channels = np.dstack([y, pairs] if bright else [pairs, y])
        message = raw(encoding, channels.astype(np.uint8, "C"))
    got = seen(picture(message)).astype(int)
    want = [
        [
            from_yuv(y[i, j], u[i // rows, j // columns], v[i // rows, j // columns])
            for j in range(8)
        ]
        for i in range(6)
    ]
    assert np.abs(got - want).max() <= 1


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer(order: str, bits: int) -> None:
    mosaic = RNG.integers(0, 1 << bits, (5, 6)).astype(f"u{bits // 8}")
    found = picture(raw(f"bayer_{order}{bits}", mosaic))
    want = np.empty((5, 6, 3))
    for i in range(5):
        for j in range(6):
            for place, colour in enumerate("rgb"):
                near = [
                    (float(mosaic[k, m]), (2 - abs(k - i)) * (2 - abs(m - j)))
                    for k in range(max(i - 1, 0), min(i + 2, 5))
                    for m in range(max(j - 1, 0), min(j + 2, 6))
                    if order[k % 2 * 2 + m % 2] == colour
                ]
                own = order[i % 2 * 2 + j % 2] == colour
                total = sum(weight for _, weight in near)
                mean = sum(value * weight for value, weight in near) / total
                want[i, j, place] = mosaic[i, j] if own else round(mean)
    got = pixels(mosaic, f"bayer_{order}{bits}", deep=True)
    assert got.dtype == mosaic.dtype
    assert np.array_equal(got, want)
    assert chunks_of(found.data)[b"IHDR"][8:10] == bytes([bits, 2])


@pytest.mark.parametrize(
    ("form", "media_type", "suffix", "is_shown"),
    [
        ("JPEG", "image/jpeg", ".jpg", True),
        ("PNG", "image/png", ".png", True),
        ("WEBP", "image/webp", ".webp", True),
        ("GIF", "image/gif", ".gif", True),
        ("BMP", "image/bmp", ".bmp", True),
        ("TIFF", "image/tiff", ".tif", False),
    ],
)
def test_compressed_images_as_they_came(
    form: str, media_type: str, suffix: str, *, is_shown: bool
) -> None:
    """Bytes say what they are, whatever the message says."""
    data = encoded(GREY, form)
    for kind in sorted(IMAGES - VIDEOS):
        if "Compressed" in kind:
            found = picture(compressed("png", data, kind))
            assert found == Picture(media_type, suffix, data)
    shown = picture(compressed("png", data), raw=False)
    if is_shown:
        assert shown == found
    else:
        assert np.array_equal(seen(shown), GREY)
        assert picture(compressed("png", data), raw=False, form="jpg").suffix == ".jpg"


@pytest.mark.parametrize(
    ("start", "suffix"),
    [
        (b"MM\0*rest", ".tif"),
        (b"\0\0\0\x1cftypavif", ".avif"),
        (b"\0\0\0\x0cjP  \r\n\x87\n", ".jp2"),
        (b"\0\0\0\x0cJXL \r\n\x87\n", ".jxl"),
        (b"\xff\x0a\0", ".jxl"),
    ],
)
def test_formats_by_their_first_bytes(start: bytes, suffix: str) -> None:
    found = picture(compressed("", start))
    assert (found.suffix, found.data) == (suffix, start)


def test_compressed_depth() -> None:
    depth = np.array([[1000, 0], [2500, 65535]], np.uint16)
    data = encoded(depth, "png")
    kept = picture(compressed("16UC1; compressedDepth png", bytes(12) + data))
    assert kept == Picture("image/png", ".png", data)
    shown = seen(picture(compressed("16UC1; compressedDepth png", bytes(12) + data), raw=False))
    assert shown.tolist() == [[3, 0], [9, 255]]
    # Of floats, the file has the inverse of the depth: 1 / (value - 10) * 100 is 2, 5 and 10.
    inverse = np.array([[60, 30, 20, 0]], np.uint16)
    message = compressed(
        "32FC1; compressedDepth", struct.pack("<iff", 0, 100, 10) + encoded(inverse, "png")
    )
    for found in (picture(message), picture(message, raw=False)):
        assert seen(found).tolist() == [[0, 95, 255, 0]]
    with pytest.raises(PayloadError, match="only PNG"):
        picture(compressed("16UC1; compressedDepth rvl", bytes(99)))


def test_foxglove_images() -> None:
    message = Sent(
        "foxglove.RawImage", encoding="mono8", height=5, width=7, step=7, data=GREY.tobytes()
    )
    assert np.array_equal(seen(picture(message)), GREY)


def test_jpeg() -> None:
    smooth = np.dstack([np.linspace(0, 255, 64, dtype=np.uint8)[None].repeat(64, 0)] * 3)
    found = picture(raw("rgb8", smooth), form="jpg")
    assert (found.media_type, found.suffix) == ("image/jpeg", ".jpg")
    with Pillow.open(io.BytesIO(found.data)) as image:
        assert image.format == "JPEG"
        assert np.abs(np.asarray(image).astype(int) - smooth).max() < 8
    assert picture(raw("mono16", GREY.astype(np.uint16)), form="jpg").data[:2] == b"\xff\xd8"
    assert picture(raw("rgba8", COLOURS), form="jpg").data[:2] == b"\xff\xd8"
    with pytest.raises(PayloadError, match="cannot be JPEG"):
        picture(raw("mono8", np.zeros((1, 70_000), np.uint8)), form="jpg")


def test_jpeg_without_pillow(calls: Calls) -> None:
    calls.missing("PIL")
    assert picture(raw("mono8", GREY)).suffix == ".png"
    assert picture(compressed("", b"\xff\xd8\xff")).suffix == ".jpg"
    with pytest.raises(MissingDependencyError, match=r"pip install 'hybridlog\[images\]'"):
        picture(raw("mono8", GREY), form="jpg")


SCAN = Sent(
    "sensor_msgs/LaserScan", ranges=[1.0], intensities=[1.0], angle_min=0, angle_increment=1
)


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        (raw("mono8", np.empty((0, 4), np.uint8)), "without pixels"),
        (raw("nv12", np.empty((0, 4), np.uint8)), "without pixels"),
        (raw("bayer_rggb8", np.empty((4, 0), np.uint8), step=0), "without pixels"),
        (raw("yuyv", np.empty((2, 0, 2), np.uint8), step=0), "without pixels"),
        (compressed("png", b""), "without pixels"),
        (compressed("h264", b"RIFF1234WAVE"), "no known format; it says that it is 'h264'"),
        (compressed("", b"BMx"), "no known format"),
        (compressed("32FC1; compressedDepth", b""), "without pixels"),
        (raw("hsv99", GREY), "unknown encoding"),
        (raw("mono8", GREY, height=50), "needs"),
        (SCAN, "is no image"),
        (Sent("std_msgs/String", data="x"), "is no image"),
    ],
)
def test_no_pictures(message: Any, problem: str) -> None:
    with pytest.raises(PayloadError, match=problem):
        picture(message)


@pytest.mark.parametrize("side", [8200, 14_000])  # Pillow itself refuses the latter
def test_a_small_file_with_very_many_pixels_is_no_picture_for_the_eye(side: int) -> None:
    file = io.BytesIO()
    Pillow.new("1", (side, side)).save(file, "PNG")
    vast = compressed("png", file.getvalue())
    assert len(file.getvalue()) < 1 << 17
    with pytest.raises(PayloadError, match="too many pixels to be shown"):
        picture(vast, raw=False)
    assert picture(vast).data == file.getvalue()


def fetch(drive: Drive, *arguments: object, code: int = 0) -> Answer:
    return answer("fetch", *arguments, store=drive.directory, code=code)


def index_of(directory: Path) -> list[dict[str, Any]]:
    lines = (directory / "index.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_raw_images_become_png(drive: Drive, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    done = fetch(drive, "-t", "front", "-F", "png", "-o", out)
    assert "1 message left out; the first: an image has rows of 18 bytes" in done.err
    assert sorted(p.name for p in out.iterdir()) == ["front", "index.jsonl"]
    names = [f"{BASE + n * MS}.png" for n in (0, 2, 3)]
    assert sorted(p.name for p in (out / "front").iterdir()) == names
    for name, wanted in zip(names, SEEN[[0, 2, 3]], strict=True):
        with Pillow.open(out / "front" / name) as shown:
            assert np.array_equal(np.asarray(shown), wanted)
    first = index_of(out)[0]
    assert first["file"] == f"front/{names[0]}"
    assert (first["topic"], first["media_type"]) == ("/front", "image/png")
    assert (first["log_time_ns"], first["publish_time_ns"]) == (BASE, BASE)
    assert first["length"] == (out / first["file"]).stat().st_size


def test_compressed_images_are_fetched_as_they_came(drive: Drive, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    fetch(drive, "-t", "rear/*", "-F", "png", "-o", out)
    # Two of the same nanosecond have names of their own.
    names = [f"{BASE}.jpg", f"{BASE}-1.webp", f"{BASE + 1}.jpg"]
    assert [row["file"] for row in index_of(out)] == [f"rear__compressed/{n}" for n in names]
    assert [(out / row["file"]).read_bytes() for row in index_of(out)] == FILES


def test_one_image(drive: Drive, tmp_path: Path) -> None:
    front = ("-t", "front", "--at", "+2.5ms", "-o")
    for name in ("x.png", "x.jpg", "x.JPEG"):
        fetch(drive, *front, tmp_path / name)
        with Pillow.open(tmp_path / name) as picture:
            assert picture.format == ("PNG" if name == "x.png" else "JPEG")
    with Pillow.open(tmp_path / "x.png") as picture:
        assert np.array_equal(np.asarray(picture), SEEN[2])
    shown = fetch(drive, "-t", "front", "-n", "1", "-F", "png", "-q").raw
    with Pillow.open(io.BytesIO(shown)) as picture:
        assert np.array_equal(np.asarray(picture), SEEN[0])
    rear = ("-t", "rear/compressed", "-n", "1", "-o")
    fetch(drive, *rear, tmp_path / "y.jpg")
    assert (tmp_path / "y.jpg").read_bytes() == FILES[0]
    assert fetch(drive, *rear, tmp_path / "y.png", code=2).out == ""
    assert not (tmp_path / "y.png").exists()
    fetch(drive, "-t", "front", "-o", tmp_path / "z.png", code=2)
    fetch(drive, "-t", "front", "--limit", 0, "-o", tmp_path / "z.png", code=2)
    fetch(drive, "-t", "drive", "-F", "png", "-o", tmp_path / "z", code=2)
    fetch(drive, "-t", "broken", "-F", "png", "-o", tmp_path / "z", code=PayloadError.exit_code)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.JPEG", "x.jpg", "x.png", "y.jpg"]
