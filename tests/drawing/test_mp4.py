"""`--format mp4`: times and pictures, as PyAV reads the files."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import hybridlog as hl
from hybridlog.cli.answers import write_answer
from hybridlog.formats import OUTPUTS
from hybridlog.formats.mp4 import _Video
from hybridlog.formats.writing import Answer
from hybridlog.maintenance.keep import expire
from hybridlog.message import Message
from hybridlog.query.query import Query
from hybridlog_storage.errors import DiskFullError, PayloadError, TimeError, UsageError
from hybridlog_storage.messages import Channel, Schema
from tests.calls import Calls
from tests.cli.running import run
from tests.cli.within import answer
from tests.odd_messages import ros_channel
from tests.ros_values import ROS1

from .test_video import (
    BASE,
    COUNT,
    DECODERS,
    ENCODERS,
    GROUP,
    JSON,
    MS,
    STEP,
    decoded,
    drawn,
    encode,
    encoded,
    payload,
    psnr,
    write,
)

av = pytest.importorskip("av")

ODD = [0, 10 * MS + 700, 10 * MS + 700, 35 * MS + 123_456, 3000 * MS, 4000 * MS]
"""Times of images after `BASE`, two of them equal."""


def read(path: Path) -> tuple[str, list[int], list[NDArray[Any]]]:
    """Codec, log times of the pictures as the file has them, and the pictures."""
    with av.open(str(path)) as file:
        begin = int(file.metadata["comment"].removeprefix("log_time_ns="))
        track = file.streams.video[0]
        frames = [*file.decode(track)]
        times = [begin + round(frame.pts * track.time_base * 10**9) for frame in frames]
        name = track.codec_context.name
        return name, times, [frame.to_ndarray(format="rgb24") for frame in frames]


def to_mp4(query: Query, path: Path) -> None:
    write_answer(query, "mp4", path)


def reordered(form: str) -> list[bytes]:
    """Frames with others between them that are shown before; in the order of decoding."""
    name, key, quiet = {
        "h264": ("libx264", "x264-params", ""),
        "h265": ("libx265", "x265-params", ":log-level=none"),
    }[form]
    return encode(name, {"preset": "fast", key: f"repeat-headers=1:annexb=1{quiet}"}, between=2)


def write_image_topics(store: hl.Store) -> None:
    types = ROS1.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = types["std_msgs/msg/Header"](seq=1, stamp=stamp, frame_id="camera")
    with store.start("images") as recording:

        def add(topic: str, picture: NDArray[Any], time: int, encoding: str) -> None:
            if encoding == "jpeg":
                kind = "sensor_msgs/msg/CompressedImage"
                file = io.BytesIO()
                Image.fromarray(picture).save(file, "JPEG", quality=95)
                data = np.frombuffer(file.getvalue(), np.uint8)
                message = types[kind](header, format="jpeg", data=data)
            else:
                kind = "sensor_msgs/msg/Image"
                size, row = picture.shape[:2], picture.nbytes // len(picture)
                message = types[kind](header, *size, encoding, 0, row, picture.reshape(-1))
            raw = bytes(ROS1.serialize_ros1(message, kind))
            recording.write(ros_channel(topic, kind, 1), raw, log_time=BASE + time)

        for n, time in enumerate(ODD):
            picture = drawn()[n]
            add("/odd", np.ascontiguousarray(picture[:47, :63]), time, "rgb8")
            add("/compressed", picture, time, "jpeg")
            mixed = picture[..., 0] if n % 2 else picture[..., ::-1]
            add("/mixed", np.ascontiguousarray(mixed), time, "mono8" if n % 2 else "bgr8")
            add("/grows", picture if n < 3 else picture.repeat(2, 0), time, "rgb8")
            add("/far", picture, time * 1000, "rgb8")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A recording a format, one with frames in another order, one of images."""
    path = tmp_path_factory.mktemp("mp4")
    with hl.open(path / "store", create=True, mongo="none") as store:
        for form in ENCODERS:
            topics: dict[str, Any] = {"/cam": ("cdr", encoded(form))}
            if form == "h264":
                frames = encoded(form)
                topics["/gap"] = ("json", [*frames[:7], None, *frames[8:]])
                topics["/empty"] = ("cdr", [*frames[:7], b"", *frames[8:]])
                topics["/none"] = ("json", [b"no video"] * 2)
            if form != "av1":
                topics["/b"] = ("protobuf", reordered(form))
            write(path / f"{form}.mcap", topics, form)
            store.record(path / f"{form}.mcap", name=form)
        write_image_topics(store)
        yield store


def rounded(times: Sequence[int]) -> list[int]:
    """Times after the first one to a microsecond, none equal."""
    made: list[int] = []
    for time in times:
        tick = times[0] + (time - times[0] + 500) // 1000 * 1000
        made.append(max(tick, made[-1] + 1000) if made else tick)
    return made


@pytest.mark.parametrize("form", ENCODERS)
def test_frames_are_copied(store: hl.Store, form: str, tmp_path: Path) -> None:
    out = tmp_path / "cam.mp4"
    answer("fetch", "-t", "/cam", "-r", form, "-o", out, store=store.directory.path)
    codec, times, pictures = read(out)
    assert codec == DECODERS[form]
    assert times == [BASE + n * STEP for n in range(COUNT)]
    assert np.array_equal(pictures, decoded(form))
    with av.open(str(out)) as file:
        keys = [packet.is_keyframe for packet in file.demux(video=0) if packet.size]
    assert keys == [n % GROUP == 0 for n in range(COUNT)]
    slices = tmp_path / "slice.mp4"
    for begin, first in ((7, 5), (5, 5)):
        asked = ("-t", "/cam", "-r", form, "--between", BASE + begin * STEP, BASE + 9 * STEP)
        done = answer("fetch", *asked, "-o", slices, "--force", store=store.directory.path)
        assert ("2 frames of video in front" in done.err) == (begin == 7)
        _, times, pictures = read(slices)
        assert times == [BASE + n * STEP for n in range(first, 9)]
        assert np.array_equal(pictures, decoded(form)[first:9])
    asked = ("-t", "/cam", "-r", form, "--between", BASE + 7 * STEP, BASE + 12 * STEP)
    done = answer(
        "fetch", *asked, "--no-latched", "-o", slices, "--force", store=store.directory.path
    )
    assert "3 messages left out; the first: a frame of video" in done.err
    assert read(slices)[1] == [BASE + n * STEP for n in (10, 11)]


@pytest.mark.parametrize("form", ["h264", "h265"])
def test_frames_in_another_order_are_refused(store: hl.Store, form: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="/b has frames in another order than they are shown"):
        to_mp4(store.query(["/b"], [form]), tmp_path / "b.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("topic", ["/odd", "/compressed", "/mixed"])
def test_images_are_encoded(store: hl.Store, topic: str, tmp_path: Path) -> None:
    out = tmp_path / "images.mp4"
    answer("fetch", "-t", topic, "-o", out, store=store.directory.path)
    codec, times, pictures = read(out)
    assert codec == "h264"
    assert times == rounded([BASE + time for time in ODD])
    for n, picture in enumerate(pictures):
        assert picture.shape == (48, 64, 3)  # rows and columns are even
        shown, wanted = picture, drawn()[n]
        if topic == "/odd":
            shown, wanted = picture[:47, :63], wanted[:47, :63]
        if topic == "/mixed" and n % 2:
            wanted = np.repeat(wanted[..., :1], 3, axis=2)
        assert psnr(shown, wanted) > 20


def test_frames_that_cannot_be_decoded_are_left_out(store: hl.Store, tmp_path: Path) -> None:
    kept = [n for n in range(COUNT) if n not in {7, 8, 9}]
    for topic in ("/gap", "/empty"):
        out = tmp_path / f"{topic[1:]}.mp4"
        done = answer("fetch", "-t", topic, "-r", "h264", "-o", out, store=store.directory.path)
        assert "left out; the first: a frame of video" in done.err
        _, times, pictures = read(out)
        assert times == [BASE + n * STEP for n in kept]
        assert np.array_equal(pictures, [decoded("h264")[n] for n in kept])


def test_frames_whose_payloads_have_expired(tmp_path: Path) -> None:
    write(tmp_path / "log.mcap", {"/cam": ("json", [*encoded("h264")])}, "h264")
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        entry = store.record(tmp_path / "log.mcap", name="cam").entry
        expire(store.directory, entry.id, [*map(int, entry.digests)])
    with (
        hl.open(tmp_path / "store", mongo="none") as store,
        pytest.raises(PayloadError, match=r"12 messages have no payload.*there is no picture"),
    ):
        to_mp4(store.topic("/cam"), tmp_path / "out.mp4")
    assert not (tmp_path / "out.mp4").exists()
    one = ("fetch", "cam", "--at", "+0s", "-o", tmp_path / "a.png")
    told = run(*one, store=tmp_path / "store", code=PayloadError.exit_code).err
    assert "1 message has no payload, which was deleted to make room" in told


def test_what_is_no_video(store: hl.Store, tmp_path: Path) -> None:
    """Each refusal says why, and leaves no file."""
    images = store.query(["/odd"], ["images"])
    cam = store.query(["/cam"], ["h264"])
    refused: list[tuple[Query, type[Exception], str]] = [
        (store.query(["/grows"], ["images"]), UsageError, "64 x 48, then of 64 x 96, at 2025-"),
        (store.query(["/far"], ["images"]), UsageError, "no picture for more than 35 minutes"),
        (store.query(["/cam"], ["h264", "h265"]), UsageError, "--split-by recording"),
        (store.query(["/odd", "/mixed"], ["images"]), UsageError, "one topic in one recording"),
        (images.reverse(), UsageError, "--reverse"),
        (cam.every(2), UsageError, "refer to one another"),
        (cam.where("format == 'h264'"), UsageError, "refer to one another"),
        (cam.clock("publish").between("+0s", "+1s"), UsageError, "refer to one another"),
        (store.query(["/none"], ["h264"]), PayloadError, "video"),
        (images.between("+1s", "+2s"), UsageError, "no image in this answer"),
        (images.between(1, 2), TimeError, "."),
    ]
    for query, error, text in refused:
        with pytest.raises(error, match=text):
            to_mp4(query, tmp_path / "out.mp4")
        assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="name a file with -o"):
        OUTPUTS["mp4"].write(Answer(), io.BytesIO())
    to_mp4(images.every(2), tmp_path / "out.mp4")
    assert len(read(tmp_path / "out.mp4")[1]) == 3


def test_frames_of_another_size_or_format(tmp_path: Path) -> None:
    video = Channel("/cam", "json", Schema("foxglove.CompressedVideo", "jsonschema", JSON))
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        with store.start("cam") as recording:
            for n, form in enumerate(("h264", "h265")):
                frame = payload("json", form, encoded(form)[0])
                recording.write(video, frame, log_time=BASE + n * STEP)
        with pytest.raises(UsageError, match="/cam has h264, then other frames, at 2025-"):
            to_mp4(store.topic("/cam"), tmp_path / "out.mp4")
        assert [one.name for one in tmp_path.iterdir()] == ["store"]


def test_files_that_are_not_completed(
    store: hl.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    """Aborted, stopped, or on a full disk: nothing stays, and nothing is said twice."""

    def messages() -> Iterator[Message]:
        yield from store.query(["/odd"], ["images"])
        raise KeyError

    with pytest.raises(KeyError):
        OUTPUTS["mp4"].write(Answer(messages=messages()), tmp_path / "out.mp4")
    assert not list(tmp_path.iterdir())

    query = store.query(["/cam"], ["h264"])
    no_space = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    for error, wanted in ((KeyboardInterrupt(), KeyboardInterrupt), (no_space, DiskFullError)):
        calls.fail(_Video, "_mux", error)
        with pytest.raises(wanted):
            to_mp4(query, tmp_path / "out.mp4")
        assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    calls.fail(os, "fsync", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with pytest.raises(DiskFullError):
        to_mp4(query, tmp_path / "out.mp4")
    assert not list(tmp_path.iterdir())
