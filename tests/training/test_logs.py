"""Training sets of real logs with cameras, of the demo, of damaged and of dropped recordings."""

from __future__ import annotations

import json
import shutil
from bisect import bisect_right
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import hybridlog as hl
from benchmarks.simulator.topics import RobotConfig
from benchmarks.simulator.write import write_bag
from hybridlog.drawing.images import shown_pixels
from hybridlog.training.feature_map import FeatureMap
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer
from tests.data import DATA, needs_data
from tests.training.test_lerobot import about, episodes_of

FPS = 10
FRONT = "/camera/front/image_raw"
ROBOT = RobotConfig(image_size=(64, 48), scan_beams=30, cloud_columns=20)
ALIKE = 12
"""Greatest mean difference of the colours of a picture and the one in the log, of 255."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with 8 seconds of the demo's robot."""
    place = tmp_path_factory.mktemp("demo")
    write_bag(place / "robot.bag", duration_s=8, config=ROBOT)
    with hl.open(place / "store", create=True, mongo="none") as store:
        store.record(place / "robot.bag", settings=SegmentSettings(chunk_size=96 << 10))
    return place / "store"


def proposed(store: Path, place: Path) -> str:
    answer("export", str(place), "-F", "lerobot", "--propose-map", "-q", store=store)
    return place.read_text()


def check_pictures(store: hl.Store, path: Path, features: FeatureMap, fps: int) -> int:
    """Each frame shows the last picture that is not later; returns the number of frames."""
    frames = 0
    for name, topic in features.images.items():
        messages = list(store.topic(topic))
        times = [one.log_time_ns for one in messages]
        files = sorted((path / f"videos/observation.images.{name}").rglob("*.mp4"))
        shown = [
            frame.to_ndarray(format="rgb24")
            for file in files
            for frame in av.open(str(file)).decode(video=0)
        ]
        number = 0
        lengths = [one["length"] for one in episodes_of(path)]
        for episode, length in zip(about(path)["episodes"], lengths, strict=True):
            for frame in range(length):
                time = episode["begin_ns"] + frame * 10**9 // fps
                wanted = shown_pixels(messages[bisect_right(times, time) - 1])
                wanted = np.atleast_3d(wanted)[:, :, :3].astype(np.int16)
                found = shown[number][: wanted.shape[0], : wanted.shape[1]]
                assert np.abs(found - wanted).mean() < ALIKE, (topic, frame)
                number += 1
        assert number == len(shown)
        frames += number
    return frames


@needs_data
@pytest.mark.parametrize(("log", "cameras"), [("ouster.mcap", 3), ("compressed_image.bag", 1)])
def test_real_logs_with_cameras(tmp_path: Path, log: str, cameras: int) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        store.record(DATA / "real" / log)
        text = proposed(tmp_path / "store", tmp_path / "map.yaml")
        features = FeatureMap.read(tmp_path / "map.yaml")
        assert len(features.images) == cameras, text
        names = [*features.images.values()]
        query, path = store.topic(*names), tmp_path / "set"
        report = store.to_lerobot(query, tmp_path / "map.yaml", path, fps=30, task="x")
        assert check_pictures(store, path, features, 30) == report.frames * cameras > 0


def test_a_set_of_the_demo(demo: Path, tmp_path: Path) -> None:
    proposed(demo, tmp_path / "map.yaml")
    features = FeatureMap.read(tmp_path / "map.yaml")
    assert {*features.vectors} == {"observation.state", "action"}
    with hl.open(demo, mongo="none") as store:
        report = store.to_lerobot(
            store.all_topics(), tmp_path / "map.yaml", tmp_path / "set", fps=FPS, task="drive"
        )
        assert (report.lost, report.held, report.missing) == (0, 0, 0)
        assert check_pictures(store, tmp_path / "set", features, FPS) == 2 * report.frames


def test_a_damaged_recording(demo: Path, tmp_path: Path) -> None:
    """What is lost is in the set's description; a gap is refused unless it is asked for."""
    (segment,) = places.files(demo)
    data = bytearray(segment.read_bytes())
    with hl.open(demo, mongo="none") as store:
        (entry,) = store.recordings()
        ids = [
            one.channel_id for one in store.session.channels(entry) if one.channel.topic == FRONT
        ]
        (_, (chunk, _), *_) = store.session.chunks_before(entry, ids, 2**62)
        data[chunk.place.offset + chunk.place.length // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    features = {"images": {"front": FRONT}}
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        store.record(tmp_path / "damaged.mcap")

        def export(name: str, on_gap: Any) -> dict[str, Any]:
            query = store.topic(FRONT)
            store.to_lerobot(query, features, tmp_path / name, fps=FPS, task="x", on_gap=on_gap)
            return about(tmp_path / name)

        with pytest.raises(UsageError, match=f"{FRONT} has a gap of"):
            export("refused", "refuse")
        held = export("held", "hold")["episodes"]
        assert [one["held"][FRONT] > 0 for one in held] == [True]
        assert all(one["lost"] > 0 or not one["is_lost_exact"] for one in held)
        cut = export("cut", "drop")["episodes"]
        assert len(cut) == 2
        assert not any(one["held"] for one in cut)


def test_a_recording_whose_pictures_have_expired_is_refused(demo: Path, tmp_path: Path) -> None:
    path = tmp_path / "store"
    shutil.copytree(demo, path)
    features = {"images": {"front": FRONT}}
    with hl.open(path, mongo="none") as store:
        store.keep({"topic": {FRONT: "0s"}})
        with pytest.raises(UsageError, match="cannot be shown, or has no payload"):
            store.to_lerobot(store.topic("odom"), features, tmp_path / "expired", fps=FPS, task="x")


def test_nearly_empty_topics_are_not_proposed(tmp_path: Path) -> None:
    joy = Schema("sensor_msgs/Joy", "ros1msg", b"float32[] axes\n")
    payload = (1).to_bytes(4, "little") + np.float32(1).tobytes()
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        with store.start("one") as recording:
            for time in range(20):
                for name in ("/often", *(["/seldom"] if time == 7 else [])):
                    channel = Channel(name, "ros1", joy, {})
                    recording.write(channel, payload, log_time=10**18 + time * 10**9 // 2)
    text_of_map = proposed(tmp_path / "store", tmp_path / "map.yaml")
    assert FeatureMap.read(tmp_path / "map.yaml").topics == ("/often",)
    assert text_of_map.endswith("# left out: /seldom has 1 message\n")
    words = ("export", str(tmp_path / "set"), "-F", "lerobot", "--map", str(tmp_path / "map.yaml"))
    done = answer(*words, "--task", "x", store=tmp_path / "store")
    assert "Without --fps there are 30 frames a second." in done.err
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["fps"] == 30
