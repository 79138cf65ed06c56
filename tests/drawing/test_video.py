"""Video topics: key frames, pictures, and slices, against PyAV's own decoding of what it made."""

from __future__ import annotations

import base64
import json
import random
import struct
import sys
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import foxglove.messages
import numpy as np
import pytest
from numpy.typing import NDArray

import hybridlog as hl
from hybridlog.arrays.video import FrameOrder, VideoDecoder, frame_of, is_key_frame
from hybridlog_storage.errors import MissingDependencyError, PayloadError, TopicError
from hybridlog_storage.messages import Channel, Schema
from tests.cli.within import answer
from tests.independent import write_mcap

av = pytest.importorskip("av")

MS = 10**6
BASE = 1_748_937_600 * 10**9
STEP = 100 * MS
COUNT, GROUP = 12, 5
WIDTH, HEIGHT = 64, 48
ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
    "h264": (
        "libx264",
        {"preset": "veryfast", "tune": "zerolatency", "x264-params": "repeat-headers=1:annexb=1"},
    ),
    "h265": (
        "libx265",
        {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "x265-params": f"repeat-headers=1:annexb=1:bframes=0:keyint={GROUP}:log-level=none",
        },
    ),
    "av1": (
        "libsvtav1",
        {"preset": "11", "svtav1-params": f"pred-struct=1:lp=1:keyint={GROUP}"},
    ),
}
DECODERS = {"h264": "h264", "h265": "hevc", "av1": "libdav1d"}
ENCODINGS = ("ros1", "cdr", "json", "protobuf")
ROS = b"%s timestamp\nstring frame_id\nuint8[] data\nstring format\n"
ROS2 = (
    ROS % b"builtin_interfaces/Time"
    + b"=" * 80
    + b"\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
JSON = b'{"type":"object","properties":{"data":{"type":"string","contentEncoding":"base64"}}}'
MADE = foxglove.messages.CompressedVideo.get_schema()
SCHEMAS = {
    "ros1": Schema("foxglove_msgs/CompressedVideo", "ros1msg", ROS % b"time"),
    "cdr": Schema("foxglove_msgs/msg/CompressedVideo", "ros2msg", ROS2),
    "json": Schema("foxglove.CompressedVideo", "jsonschema", JSON),
    "protobuf": Schema(MADE.name, MADE.encoding, MADE.data),
}


@cache
def drawn() -> list[NDArray[np.uint8]]:
    blocks = np.random.default_rng(1).integers(30, 220, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
    pattern = blocks.repeat(8, 0).repeat(8, 1)
    return [np.roll(pattern, 3 * n, axis=1) for n in range(COUNT)]


def encode(name: str, settings: dict[str, str], between: int = 0) -> list[bytes]:
    """Frames, a key frame every `GROUP`; those between others may refer to later ones."""
    context: Any = av.CodecContext.create(name, "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.time_base, context.framerate = Fraction(1, 10), Fraction(10)
    context.gop_size, context.max_b_frames, context.options = GROUP, between, settings
    frames: list[bytes] = []
    for number, pixels in enumerate(drawn()):
        picture = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuv420p")
        picture.pts = number
        frames += [bytes(packet) for packet in context.encode(picture)]
    frames += [bytes(packet) for packet in context.encode(None)]
    assert len(frames) == COUNT
    return frames


@cache
def encoded(form: str) -> list[bytes]:
    """Frames of a format, none of which refers to a later one."""
    try:
        return encode(*ENCODERS[form])
    except av.FFmpegError:
        pytest.skip(f"this PyAV cannot encode {form}")


@cache
def decoded(form: str) -> list[NDArray[np.uint8]]:
    """The pictures, decoded in a row by PyAV alone."""
    context: Any = av.CodecContext.create(DECODERS[form], "r")
    found = [each for data in encoded(form) for each in context.decode(av.Packet(data))]
    found += context.decode(None)
    return [each.to_ndarray(format="rgb24") for each in found]


def psnr(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    error = ((one.astype(float) - other) ** 2).mean()
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def payload(encoding: str, form: str, data: bytes) -> bytes:
    if encoding == "json":
        stamp = {"sec": 0, "nsec": 0}
        text = base64.b64encode(data).decode()
        return json.dumps({"timestamp": stamp, "data": text, "format": form}).encode()
    if encoding == "protobuf":
        return bytes(foxglove.messages.CompressedVideo(data=data, format=form).encode())
    name = form.encode()
    if encoding == "ros1":
        head = struct.pack("<II", 0, 0) + struct.pack("<I", 0)
        return head + struct.pack("<I", len(data)) + data + struct.pack("<I", len(name)) + name
    head = b"\0\1\0\0" + struct.pack("<iI", 0, 0) + struct.pack("<I", 1) + b"\0\0\0\0"
    body = struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)
    return head + body + struct.pack("<I", len(name) + 1) + name + b"\0"


def write(
    path: Path,
    topics: dict[str, tuple[str, list[bytes | None]]],
    form: str,
    order: Callable[[list[tuple[int, bytes | None]]], Iterable[tuple[int, bytes | None]]] = iter,
) -> None:
    """A log with a chunk a message; frames that are None are left out."""
    rows = []
    for topic, (encoding, frames) in topics.items():
        channel = Channel(topic, encoding, SCHEMAS[encoding])
        for n, data in order([*enumerate(frames)]):
            if data is not None:
                rows.append((channel, BASE + n * STEP, payload(encoding, form, data)))
    write_mcap(path, rows, chunk_size=1)


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A recording a format, with a topic an encoding."""
    path = tmp_path_factory.mktemp("videos")
    with hl.open(path / "store", create=True, mongo="none") as store:
        for form in ENCODERS:
            try:
                frames = encoded(form)
            except pytest.skip.Exception:
                continue
            topics: dict[str, Any] = {f"/{one}": (one, frames) for one in ENCODINGS}
            if form == "h264":
                topics["/gap"] = ("cdr", [*frames[:7], None, *frames[8:]])
                topics["/late"] = ("cdr", [None, None, *frames[2:]])
                topics["/other"] = ("json", [b"no video"] * 2)
            write(path / f"{form}.mcap", topics, form)
            store.record(path / f"{form}.mcap", name=form)
        yield store


def at(store: hl.Store, form: str, topic: str, n: int) -> NDArray[Any]:
    return store.query([topic], [form]).at(BASE + n * STEP).to_numpy()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("form", ENCODERS)
def test_pictures_at_any_time(videos: hl.Store, form: str, encoding: str) -> None:
    right = decoded(form)
    order = [7, 8, 2, 11, 11, 0, 9, *range(COUNT)]
    for n in order:
        assert np.array_equal(at(videos, form, f"/{encoding}", n), right[n]), n
        assert psnr(right[n], drawn()[n]) > 20
    every = videos.query([f"/{encoding}"], [form]).to_numpy()
    assert np.array_equal(every, right)


@pytest.mark.parametrize(("form", "encoding"), [*zip(ENCODERS, ENCODINGS, strict=False)])
def test_a_slice_begins_with_the_key_frame(
    videos: hl.Store, form: str, encoding: str, tmp_path: Path
) -> None:
    frames, right, begin = encoded(form), decoded(form), BASE + 7 * STEP
    out = tmp_path / "slice.mcap"
    asked = ("-t", f"/{encoding}", "-r", form, "--between", begin, BASE + 9 * STEP, "-o", out)
    done = answer("fetch", *asked, "-F", "mcap", store=videos.directory.path)
    assert "2 frames of video in front, from the key frame on" in done.err
    with hl.open(tmp_path / "store", create=True) as store:
        store.record(out)
        found = list(store.topic(encoding))
        assert [m.raw for m in found] == [payload(encoding, form, data) for data in frames[5:9]]
        assert [m.log_time_ns - begin for m in found] == [0, 0, 0, STEP]
        assert np.array_equal([message.to_numpy() for message in found], right[5:9])
    out = tmp_path / "bare.mcap"
    asked = ("--between", begin, BASE + 9 * STEP, "-r", form, "--no-latched")
    done = answer("export", out, *asked, store=videos.directory.path)
    assert "in front" not in done.err


@pytest.mark.parametrize("form", ENCODERS)
def test_a_recorded_slice_begins_with_the_key_frame(form: str, tmp_path: Path) -> None:
    """Also of a log that is out of order, and not without the key frame."""
    frames, right, begin = encoded(form), decoded(form), BASE + 7 * STEP
    topics: dict[str, tuple[str, list[bytes | None]]] = {one: (one, [*frames]) for one in ENCODINGS}
    topics["late"] = ("json", [None, *frames[1:4], *[None] * 2, *frames[6:]])
    write(tmp_path / "log.mcap", topics, form)
    write(tmp_path / "mixed.mcap", {"json": ("json", [*frames])}, form, order=reversed)
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        cut = {"between": (begin, BASE + 9 * STEP), "again": True}
        report = store.record(tmp_path / "log.mcap", name="slice", **cut)
        assert report.latched == 2 * len(ENCODINGS)
        for encoding in ENCODINGS:
            found = list(store.query([encoding], ["slice"]))
            assert [m.raw for m in found] == [payload(encoding, form, data) for data in frames[5:9]]
            assert [m.log_time_ns - begin for m in found] == [0, 0, 0, STEP]
            assert np.array_equal([m.to_numpy() for m in found], right[5:9])
        assert store.query(["late"], ["slice"]).count() == 2
        store.record(tmp_path / "mixed.mcap", name="mixed", original_times=True, **cut)
        times = [m.log_time_ns for m in store.query(["json"], ["mixed"])]
        assert times == [BASE + n * STEP for n in (5, 6, 7, 8)]
    answered = answer(
        "record", tmp_path / "log.mcap", "--between", begin, BASE + 9 * STEP, "--mongo", "none",
        store=tmp_path / "other",
    )  # fmt: skip
    assert ", 8 from before, " in answered.out


def refusal(store: hl.Store, topic: str, n: int) -> str:
    try:
        at(store, "h264", topic, n)
    except PayloadError as error:
        return str(error)
    return ""


def test_frames_without_those_that_they_refer_to(videos: hl.Store, tmp_path: Path) -> None:
    right = decoded("h264")
    for n in (9, 8, 6, 9, 10, 8):
        if n in {8, 9}:
            assert "one that it refers to was never received" in refusal(videos, "/gap", n)
        else:
            assert np.array_equal(at(videos, "h264", "/gap", n), right[n])
    assert all("no key frame before it" in refusal(videos, "/late", n) for n in (2, 4))
    assert np.array_equal(at(videos, "h264", "/late", 6), right[6])
    with pytest.raises(TopicError):
        at(videos, "h264", "/late", 1)
    assert refusal(videos, "/other", 1)
    out = tmp_path / "pictures"
    asked = ("fetch", "-t", "/gap", "-r", "h264", "-F", "jpg", "-o", out)
    done = answer(*asked, store=videos.directory.path)
    assert "2 messages left out; the first: a frame of video cannot be decoded" in done.err
    assert len(list((out / "gap").iterdir())) == COUNT - 3


@pytest.mark.parametrize("form", ENCODERS)
def test_frames_behind_a_loss_are_refused(form: str, tmp_path: Path) -> None:
    """A damaged chunk is in the loss ledger: what refers to it has no picture."""
    frames, right = encoded(form), decoded(form)
    path = tmp_path / "log.mcap"
    write(path, {"/cam": ("json", [*frames])}, form)
    log = bytearray(path.read_bytes())
    at_frame = log.index(struct.pack("<Q", BASE + 7 * STEP))
    log[at_frame + 80] ^= 255
    path.write_bytes(log)
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        store.record(path)
        query = store.topic("/cam")
        assert [(m.log_time_ns - BASE) // STEP for m in query] == [*range(7), *range(8, COUNT)]
        # Nobody knows when it was lost. Frames of AV1 do not tell that one is missing.
        whole = (5, 10) if form == "av1" else (6, 5, 10, 11)
        for n in whole:
            assert np.array_equal(query.at(BASE + n * STEP).to_numpy(), right[n])
        for n in {6, 8, 9, 11}.difference(whole):
            with pytest.raises(PayloadError, match=r"cannot be decoded|no picture"):
                query.at(BASE + n * STEP).to_numpy()
        assert len(query.to_numpy()) == (3 if form == "av1" else COUNT - 3)


def test_hostile_frames() -> None:
    """Any bytes are a key frame, no key frame or refused; nothing else is raised."""
    rng = random.Random(4)
    for form in ENCODERS:
        good = encoded(form)
        for _ in range(150):
            data = bytearray(rng.choice(good))
            for _ in range(rng.randrange(1, 6)):
                data[rng.randrange(min(len(data), rng.choice([12, 60, 4000])))] = rng.randrange(256)
            hostile = (
                bytes(data[: rng.randrange(len(data) + 1)]) if rng.random() < 0.5 else bytes(data)
            )
            is_key_frame(form, hostile)
            try:
                order = FrameOrder()
                order.follows(form, good[0])
                order.follows(form, hostile)
                decoder = VideoDecoder(form)
                decoder.decode(form, good[0], is_wanted=False)
                picture = decoder.decode(form, hostile, is_wanted=True)
            except PayloadError:
                continue
            assert picture is not None
            assert picture.ndim == 3
    for form in ENCODERS:
        for data in (
            b"",
            b"\0\0\1",
            b"\0\0\1" * 10**5,
            b"\x0a" * 1000,
            b"\x32\xff\xff",
            bytes(10**6),
        ):
            assert not is_key_frame(form, data)
    for fields in ({}, {"format": "h264", "data": "?"}, {"format": "vp9", "data": ""}):
        with pytest.raises(PayloadError):
            frame_of(fields)


def test_without_pyav(videos: hl.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'hybridlog\[video\]'"):
        at(videos, "h264", "/ros1", 1)
    with pytest.raises(MissingDependencyError, match="video"):
        videos.query(["/cdr"], ["h264"]).limit(1).to_numpy()
