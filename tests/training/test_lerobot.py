"""Training sets, read by pyarrow and PyAV, against the log; also of real and damaged logs."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

import hybridlog as hl
from hybridlog.training import lerobot
from hybridlog.training.episodes import FeatureMap, proposed
from hybridlog.training.lerobot import LerobotReport
from hybridlog_storage.errors import PayloadError, TopicError, UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer
from tests.drawing.conftest import IMAGE, image
from tests.waiting import wait_for

MS = 10**6
SECOND = 10**9
START = 1_700_000_000 * SECOND
ARM = Channel("/arm", "json", None, {})
GO = Channel("/go", "json", None, {})
SAY = Channel("/say", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"), {})
CAMERA = Channel("/cam", "ros1", Schema("sensor_msgs/Image", "ros1msg", IMAGE), {})
MAP = {
    "robot_type": "arm",
    "features": {
        "observation.state": [{"arm": ["q", "load"]}],
        "action": [{"go": "x"}],
    },
    "images": {"front": "cam"},
}
FPS = 20
HEIGHT, WIDTH = 48, 62  # an even number for each
SILENT = range(SECOND, 2 * SECOND)
ARM_STEP, GO_STEP, CAMERA_STEP = 10 * MS, 50 * MS, 100 * MS


def arm(time: int) -> list[float]:
    return [time / SECOND, -time / SECOND, time / SECOND / 2]


def grey(time: int) -> int:
    return time // CAMERA_STEP * 9 % 220 + 16


@dataclass
class Log:
    """What was said, by offset from the start of the recording."""

    length: int = 4 * SECOND
    start: int = START
    silent: range = range(0)  # of /go
    camera: tuple[int, int] = (HEIGHT, WIDTH)
    broken: int = -1  # a picture that is too short

    def write(self, store: hl.Store, name: str, **options: Any) -> None:
        said: list[tuple[int, Channel, bytes]] = []
        for time in range(0, self.length, ARM_STEP):
            q = arm(time)
            text = json.dumps({"q": q[:2], "load": q[2], "word": "x"})
            said.append((time, ARM, text.encode()))
        for time in range(30 * MS, self.length, GO_STEP):
            if time not in self.silent:
                said += [(time, GO, json.dumps({"x": time / MS}).encode())]
        for number, time in enumerate(range(0, self.length, CAMERA_STEP)):
            pixels = np.full((*self.camera, 3), grey(time), np.uint8)
            said.append((time, CAMERA, image(pixels)[: 60 if number == self.broken else None]))
        for time, words in ((0, b"first"), (2 * SECOND, b"second")):
            said.append((time, SAY, len(words).to_bytes(4, "little") + words))
        with store.start(name, **options) as recording:
            for time, channel, payload in sorted(said, key=lambda one: one[0]):
                recording.write(channel, payload, log_time=self.start + time)


Make = Callable[..., hl.Store]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def made(*logs: Log) -> hl.Store:
        store = hl.open(tmp_path / "store", create=True, mongo="none")
        for number, log in enumerate(logs):
            log.write(store, f"run{number}")
        return store

    return made


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with two recordings without gaps."""
    path = tmp_path_factory.mktemp("lerobot") / "store"
    with hl.open(path, create=True, mongo="none") as store:
        Log().write(store, "one")
        Log(length=2 * SECOND, start=START + 10 * SECOND).write(store, "two")
    return path


def export(store: hl.Store, to: Path, **options: Any) -> LerobotReport:
    query = store.topic("arm", "go", "cam")
    given: dict[str, Any] = {"fps": FPS, "task": "wave"} | options
    return store.to_lerobot(query, MAP, to, **given)


def every_file(path: Path) -> dict[str, bytes]:
    return {str(o.relative_to(path)): o.read_bytes() for o in path.rglob("*") if o.is_file()}


def rows_of(path: Path) -> list[dict[str, Any]]:
    files = sorted((path / "data").rglob("*.parquet"))
    return [row for file in files for row in pq.read_table(file).to_pylist()]


def episodes_of(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(path / "meta/episodes").to_pylist()
    return rows


def greys_of(path: Path) -> list[tuple[float, float]]:
    found = []
    for file in sorted((path / "videos/observation.images.front").rglob("*.mp4")):
        with av.open(str(file)) as opened:
            for frame in opened.decode(video=0):
                assert (frame.height, frame.width) == (HEIGHT, WIDTH)
                pixels = frame.to_ndarray(format="rgb24")
                found.append((float(frame.time), float(pixels.mean())))
    return found


def about(path: Path) -> dict[str, Any]:
    value: dict[str, Any] = json.loads((path / "meta/hybridlog.json").read_text())
    return value


def check(
    path: Path, begins: dict[int, int], lengths: list[int], *, is_silent: bool = False
) -> None:
    """Every frame is that of the log."""
    rows, pictures = rows_of(path), greys_of(path)
    assert [one["length"] for one in episodes_of(path)] == lengths
    assert len(rows) == len(pictures) == sum(lengths)
    index = 0
    for episode, length in enumerate(lengths):
        for frame in range(length):
            time = begins[episode] + frame * SECOND // FPS
            row = rows[index]
            assert (row["index"], row["frame_index"], row["episode_index"]) == (
                index,
                frame,
                episode,
            )
            assert row["timestamp"] == np.float32(frame / FPS)
            told = arm(time // ARM_STEP * ARM_STEP)
            assert row["observation.state"] == [np.float32(one) for one in told]
            go = (time - 30 * MS) // GO_STEP * GO_STEP + 30 * MS
            go = SECOND - 20 * MS if is_silent and go in SILENT else go
            assert row["action"] == np.float32(go / MS)
            assert pictures[index][0] == pytest.approx(index / FPS, abs=1e-6)
            assert abs(pictures[index][1] - grey(time)) < 3, (index, time)
            index += 1


def test_every_frame_is_that_of_the_log(plain: Path, tmp_path: Path) -> None:
    path = tmp_path / "set"
    with hl.open(plain, mongo="none") as store:
        report = export(store, path)
    # Two are 30 ms shorter than the log: there is no action before.
    lengths = [80, 40]
    assert (report.episodes, report.frames, report.lost) == (2, sum(lengths), 0)
    check(path, dict.fromkeys(range(2), 30 * MS), lengths)
    info = json.loads((path / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", FPS, 120)
    assert info["features"]["observation.state"]["names"] == ["arm.q[0]", "arm.q[1]", "arm.load"]
    assert info["features"]["observation.images.front"]["shape"] == [HEIGHT, WIDTH, 3]
    spans = [(one["dataset_from_index"], one["dataset_to_index"]) for one in episodes_of(path)]
    assert spans == [(0, 80), (80, 120)]
    key = "videos/observation.images.front"
    times = [
        (one[f"{key}/from_timestamp"], one[f"{key}/to_timestamp"]) for one in episodes_of(path)
    ]
    assert times == [(0, 4), (4, 6)]
    own = about(path)
    assert [one["name"] for one in own["episodes"]] == ["one", "two"]
    assert own["hybridlog"] == hl.__version__
    assert len(own["fingerprint"]) == 64


def test_statistics_are_those_of_the_values(plain: Path, tmp_path: Path) -> None:
    with hl.open(plain, mongo="none") as store:
        export(store, tmp_path / "set")
    rows = rows_of(tmp_path / "set")
    states = np.array([row["observation.state"] for row in rows], np.float64)
    found = json.loads((tmp_path / "set/meta/stats.json").read_text())
    mine = found["observation.state"]
    assert mine["count"] == [len(rows)]
    for name, value in (
        ("min", states.min(0)),
        ("max", states.max(0)),
        ("mean", states.mean(0)),
        ("std", states.std(0)),
        ("q01", np.quantile(states, 0.01, axis=0)),
        ("q99", np.quantile(states, 0.99, axis=0)),
    ):
        assert mine[name] == pytest.approx(value.tolist()), name
    shown = found["observation.images.front"]
    greys = [grey(n * CAMERA_STEP) / 255 for n in range(40)]
    assert np.shape(shown["mean"]) == (3, 1, 1)
    assert np.ravel(shown["min"]).tolist() == pytest.approx([min(greys)] * 3)
    assert np.ravel(shown["max"]).tolist() == pytest.approx([max(greys)] * 3)
    assert np.ravel(shown["mean"])[0] == pytest.approx(np.mean([*greys, *greys[:20]]), abs=0.01)
    (first, _) = episodes_of(tmp_path / "set")
    assert first["stats/action/max"] == [max(row["action"] for row in rows[:80])]


def test_an_interrupted_export_leaves_nothing(plain: Path, tmp_path: Path) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with hl.open(plain, mongo="none") as store:
        export(store, tmp_path / "whole")
        with pytest.raises(KeyboardInterrupt):
            export(store, tmp_path / "set", progress=stop)
        assert [path.name for path in tmp_path.iterdir()] == ["whole"]
        export(store, tmp_path / "set")
        assert every_file(tmp_path / "set") == every_file(tmp_path / "whole")
        with pytest.raises(UsageError, match="is not empty"):
            export(store, tmp_path / "whole")


def test_long_sets_have_several_files(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_DATA_MB", "_VIDEO_MB"):
        monkeypatch.setattr(lerobot, name, 0)
    with hl.open(plain, mongo="none") as store:
        export(store, tmp_path / "set")
    for folder in ("data", "videos/observation.images.front"):
        files = [path.stem for path in (tmp_path / "set" / folder).rglob("file-*")]
        assert sorted(files) == ["file-000", "file-001"]
    rows, pictures = rows_of(tmp_path / "set"), greys_of(tmp_path / "set")
    assert len(rows) == len(pictures) == 120
    key = "videos/observation.images.front"
    assert [
        (one[f"{key}/file_index"], one[f"{key}/from_timestamp"], one[f"{key}/to_timestamp"])
        for one in episodes_of(tmp_path / "set")
    ] == [(0, 0, 4), (1, 0, 2)]


def test_episodes_are_marks_and_intervals(make: Make, tmp_path: Path) -> None:
    with make(Log()) as store:
        store.mark("run0", START + SECOND, "wave", until=START + 2 * SECOND)
        store.mark("run0", START + 3 * SECOND, "rest", until=START + 3_500 * MS)
        export(store, tmp_path / "marks", episodes_by="mark")
        check(tmp_path / "marks", {0: SECOND, 1: 3 * SECOND}, [20, 10])
        names = [one["name"] for one in about(tmp_path / "marks")["episodes"]]
        assert names == ["run0-001-wave", "run0-002-rest"]
        export(store, tmp_path / "held", episodes_by="go: x > 1000 and x < 2000")
        check(tmp_path / "held", {0: 1_030 * MS}, [20])


def test_a_task_may_be_said_by_a_topic(make: Make, tmp_path: Path) -> None:
    with make(Log()) as store:
        store.mark("run0", START + SECOND, "a", until=START + 2 * SECOND)
        store.mark("run0", START + 3 * SECOND, "b", until=START + 3_900 * MS)
        export(store, tmp_path / "set", episodes_by="mark", task="", task_topic="say")
        assert [one["tasks"] for one in episodes_of(tmp_path / "set")] == [["first"], ["second"]]
        assert {row["task_index"] for row in rows_of(tmp_path / "set")} == {0, 1}
        with pytest.raises(UsageError, match="no text"):
            export(store, tmp_path / "bad", task="", task_topic="arm")
        for task, topic in (("x", "say"), ("", None)):
            with pytest.raises(UsageError, match="Say what the robot does"):
                export(store, tmp_path / "bad", task=task, task_topic=topic)
    import pandas as pd

    tasks = pd.read_parquet(tmp_path / "set/meta/tasks.parquet")
    assert tasks.index.name == "task"
    assert tasks["task_index"].to_dict() == {"first": 0, "second": 1}


def test_a_gap_is_refused_cut_or_held(make: Make, tmp_path: Path) -> None:
    with make(Log(silent=SILENT)) as store:
        with pytest.raises(UsageError, match=r"run0: /go has a gap at .*:21.2"):
            export(store, tmp_path / "set")
        report = export(store, tmp_path / "set2", on_gap="drop")
        assert [one["length"] for one in episodes_of(tmp_path / "set2")] == [25, 40]
        check(tmp_path / "set2", {0: 30 * MS, 1: 2_030 * MS}, [25, 40], is_silent=True)
        assert report.dropped == 15
        report = export(store, tmp_path / "set3", on_gap="hold")
        assert (report.episodes, report.frames) == (1, 80)
        assert about(tmp_path / "set3")["episodes"][0]["held"] == {"/go": report.held}
        assert (report.held, report.dropped) == (15, 0)
        actions = [row["action"] for row in rows_of(tmp_path / "set3")]
        assert actions[19:40] == [980.0] * 21


@pytest.mark.parametrize(("broken", "instead"), [(10, 9), (0, 1)])
def test_a_picture_that_cannot_be_shown(
    make: Make, tmp_path: Path, broken: int, instead: int
) -> None:
    """The one before it is shown, or the first one that can be."""
    with make(Log(broken=broken)) as store:
        with pytest.raises(UsageError, match=r"a picture of /cam cannot be shown"):
            export(store, tmp_path / "set")
        report = export(store, tmp_path / "held", on_gap="hold")
    assert (report.frames, report.missing) == (80, 2)
    assert about(tmp_path / "held")["episodes"][0]["missing"] == {"/cam": 2}
    shown = [one for _, one in greys_of(tmp_path / "held")]
    assert abs(shown[2 * broken] - grey(instead * CAMERA_STEP)) < 3


def test_what_does_not_fit_is_refused(make: Make, tmp_path: Path) -> None:
    def refused(values: dict[str, Any], error: type[Exception], match: str) -> None:
        with pytest.raises(error, match=match):
            store.to_lerobot(store.all_topics(), values, tmp_path / "set", fps=FPS, task="t")

    with make(Log(), Log(camera=(20, 30))) as store:
        with pytest.raises(UsageError, match="other sizes of pictures"):
            export(store, tmp_path / "sizes")
        refused({"features": {"action": {"arm": "word"}}}, UsageError, "word is string, no number")
        refused({"features": {"action": {"arm": "none"}}}, UsageError, "no field none")
        refused({"images": {"front": "arm"}}, (PayloadError, UsageError), "picture")  # type: ignore[arg-type]
        refused({"features": {"action": {"nowhere": "x"}}}, TopicError, "nowhere")
        refused({"features": {"action": {"*": "x"}}}, TopicError, "means several topics")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("- a", "Expected `object`"),
        ("other: 1", "unknown field `other`"),
        ("features: {timestamp: {go: x}}", "no name for a feature"),
        ("features: {action: {go: [1]}}", "Expected `str`"),
        ("images: {front: [a]}", "Expected `str`"),
        ("robot_type: x", "has no features"),
        ("a: [", "is no YAML"),
    ],
)
def test_a_map_says_what_is_wrong(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(UsageError, match=match):
        FeatureMap.read(tmp_path / "map.yaml")


def test_a_recording_in_progress_is_read_as_of_one_moment(make: Make, tmp_path: Path) -> None:
    with make() as store, store.start("now", flush_interval_s=0.05) as recording:
        for time in range(0, SECOND, GO_STEP):
            recording.write(GO, json.dumps({"x": time / MS}).encode(), log_time=START + time)
        wait_for(lambda: store.topics() and store.topic("go").count() == 20)
        features = {"features": {"action": {"go": "x"}}}
        store.to_lerobot(store.topic("go"), features, tmp_path / "set", fps=FPS, task="go")
    assert [row["action"] for row in rows_of(tmp_path / "set")] == [50.0 * n for n in range(20)]


def test_the_command_line(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("map.yaml").write_text(FeatureMap.of(MAP).to_yaml())
    assert FeatureMap.read("map.yaml") == FeatureMap.of(MAP)
    to = ("export", "set", "-F", "lerobot", "--map", "map.yaml", "--fps", str(FPS))
    done = answer(*to, "--task", "wave", store=plain)
    assert "2 episodes, 120 frames" in done.err
    check(Path("set"), dict.fromkeys(range(2), 30 * MS), [80, 40])
    answer(*to, "--task", "wave", "--force", store=plain, code=2)
    for wrong in (
        ("export", "x.mcap", "--fps", "3"),
        ("export", "x", "-F", "lerobot"),
        (*to, "--task", "wave", "--split-by", "mark"),
    ):
        answer(*wrong, store=plain, code=2)
    answer("export", "own.yaml", "-F", "lerobot", "--propose-map", store=plain)
    assert FeatureMap.read("own.yaml").images == {"cam": "/cam"}
    answer("export", "own.yaml", "-F", "lerobot", "--propose-map", store=plain, code=2)
    with hl.open(tmp_path / "robot", create=True, mongo="none") as store:
        twist = Schema("geometry_msgs/Twist", "ros1msg", b"Vector3 linear\n")
        with store.start("run") as recording:
            recording.write(Channel("/cmd_vel", "ros1", twist, {}), bytes(48), log_time=START)
        (action,) = proposed(store.all_topics()).vectors["action"]
    assert (action.topic, action.paths) == ("/cmd_vel", ("linear.x", "angular.z"))


def test_depth_has_one_scale_nan_is_a_gap_and_numbers_keep_their_type(tmp_path: Path) -> None:
    state = Channel("/state", "ros1", Schema("t/S", "ros1msg", b"float64 v\nfloat32 w\n"), {})
    deep = Channel("/deep", "ros1", Schema("sensor_msgs/Image", "ros1msg", IMAGE), {})
    features = {
        "features": {"observation.state": {"state": "v"}, "action": {"state": "w"}},
        "images": {"deep": "deep"},
    }
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        with store.start("run") as recording:
            for number in range(40):
                time = START + number * 50 * MS
                mm = np.full((16, 16), 1500, np.uint16)
                mm[:8], mm[0, 0] = 0, 2000 if number < 20 else 60_000
                value = np.nan if 10 <= number < 20 else number + 0.1
                recording.write(deep, image(mm, "16UC1"), log_time=time)
                recording.write(state, struct.pack("<df", value, number), log_time=time)
        query, given = store.topic("state", "deep"), {"fps": FPS, "task": "x"}
        with pytest.raises(UsageError, match="gap"):
            store.to_lerobot(query, features, tmp_path / "set", depth_scale=(0, 3), **given)
        given["on_gap"] = "hold"
        report = store.to_lerobot(query, features, tmp_path / "set", **given)
        assert report.left_out == ("/deep",)
        assert "deep" not in (tmp_path / "set/meta/info.json").read_text()
        store.to_lerobot(query, features, tmp_path / "scaled", depth_scale=(0, 3), **given)
    info = json.loads((tmp_path / "scaled/meta/info.json").read_text())["features"]
    assert [info[name]["dtype"] for name in ("observation.state", "action")] == [
        "float64",
        "float32",
    ]
    rows = rows_of(tmp_path / "scaled")
    assert [row["observation.state"] for row in rows] == [
        (9 if 10 <= n < 20 else n) + 0.1 for n in range(40)
    ]
    assert json.loads((tmp_path / "scaled/meta/hybridlog.json").read_text())["depth_scale"] == [
        0,
        3,
    ]
    (file,) = (tmp_path / "scaled/videos").rglob("*.mp4")
    with av.open(str(file)) as opened:
        shown = [frame.to_ndarray(format="gray") for frame in opened.decode(video=0)]
    assert all(abs(int(one[12, 12]) - 127) < 8 and one[4, 12] < 24 for one in shown)


def test_the_doctor_finds_nothing_wrong(plain: Path, tmp_path: Path) -> None:
    with hl.open(plain, mongo="none") as store:
        export(store, tmp_path / "set")
    program = Path(sys.executable).with_name("lerobot-doctor")
    done = subprocess.run(
        [program, "check", tmp_path / "set"],
        env={**os.environ, "HF_HUB_OFFLINE": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "Summary" in done.stdout, done.stderr
    assert "[FAIL]" not in done.stdout, done.stdout
    for part in ("Metadata & Format", "Temporal Consistency", "Video Integrity"):
        assert f"[PASS] {part}" in done.stdout, done.stdout


CAM = {"images": {"front": "/cam"}}


def test_a_damaged_recording(make: Make, tmp_path: Path) -> None:
    """What is lost is in the set's description; a gap is refused unless it is asked for."""
    with make() as store:
        Log().write(store, "run", settings=SegmentSettings(chunk_size=64 << 10))
        (entry,) = store.recordings()
        ids = [one.channel_id for one in store.session.channels_of(entry, ["/cam"])]
        chunk = store.session.chunks(entry, ids)[-2]
        ((segment, _),) = places.logs_of(tmp_path / "store", "run", "/cam")
        data = bytearray(segment.read_bytes())
        data[chunk.place.offset + chunk.place.length // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    with hl.open(tmp_path / "other", create=True, mongo="none") as store:
        store.record(tmp_path / "damaged.mcap")

        def export(name: str, on_gap: Any) -> dict[str, Any]:
            query = store.topic("cam")
            store.to_lerobot(query, CAM, tmp_path / name, fps=FPS, task="x", on_gap=on_gap)
            return about(tmp_path / name)

        with pytest.raises(UsageError, match="/cam has a gap at"):
            export("refused", "refuse")
        held = export("held", "hold")["episodes"]
        assert [one["held"]["/cam"] > 0 for one in held] == [True]
        assert all(one["lost"] > 0 or not one["is_lost_exact"] for one in held)
        cut = export("cut", "drop")["episodes"]
        assert len(cut) == 2
        assert not any(one["held"] for one in cut)


def test_a_recording_whose_pictures_have_expired_is_refused(make: Make, tmp_path: Path) -> None:
    with make(Log()) as store:
        store.keep({"topic": {"**": "0s"}})
        with pytest.raises(UsageError, match="cannot be shown, or has no payload"):
            store.to_lerobot(store.topic("cam"), CAM, tmp_path / "expired", fps=FPS, task="x")
