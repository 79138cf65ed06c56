"""What people do next with a log, in every state of a store: as in the recording that has ended."""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

import hybridlog as hl
from hybridlog.contract import contract_of
from hybridlog.record.marks import MARK_CHANNEL, MARKS, mark_payload
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer
from tests.drawing.test_mp4 import read as read_mp4
from tests.drawing.test_video import JSON, encoded, payload
from tests.independent import read_mcap
from tests.odd_messages import ros_channel
from tests.ros_values import ROS2
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")

SECOND, MS = 10**9, 10**6
START = 1_748_937_600 * SECOND
ROS = ("/tf", "/pose", "/scan")
OUT = "OUT"
NOISE = b"NOISE" * 400
Asked = tuple[str, ...]
JOBS: dict[str, list[Asked]] = {
    "tf": [("tf", "map", "-t", "/scan", "-F", "csv"), ("tf", "map", "base", "--at", "+1.3s")],
    "in-frame": [
        ("fetch", "-t", "/scan", "--in-frame", "map", "-F", "ply", "-o", OUT),
        ("fetch", "-t", "/pose", "--in-frame", "map", "-F", "tum"),
        ("align", "--to", "/pose", "-t", "/scan", "--in-frame", "map", "-F", "csv"),
    ],
    "split-by": [
        ("export", OUT, "-t", "/pose", "-F", "csv", "--split-by", "mark"),
        ("export", f"{OUT}.mcap", "-t", "/pose", "--split-by", "/pose: pose.position.x > 0.5"),
    ],
    "rosbag2": [
        ("export", OUT, "-F", "rosbag2", "-t", "/pose", "-t", "/scan", "-t", "/tf"),
        ("export", OUT, "-t", "/pose", "-F", "rosbag2", "--storage", "sqlite3"),
    ],
    "video": [
        ("fetch", "-t", "/video", "--between", "+350ms", "+900ms", "-o", f"{OUT}.mp4"),
        ("fetch", "-t", "/video", "--at", "+710ms", "-F", "png", "-o", f"{OUT}.png"),
    ],
    "check": [("check", "-t", "/pose", "-t", "/scan", "--json")],
    "contract": [("check", "--contract", "CONTRACT", "--json")],
    "diff": [("diff", "run", "run", "--json"), ("diff", "run", "other", "--json")],
    "marks": [("fetch", "-t", MARKS, "-F", "jsonl"), ("fetch", "-t", MARKS, "-F", "csv")],
}


def write(recording: Any) -> None:
    """Two seconds of poses, scans, transforms, video, marks and noise."""
    types = ROS2.types
    header, moment = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    turn, point = types["geometry_msgs/msg/Quaternion"], types["geometry_msgs/msg/Point"]
    vector = types["geometry_msgs/msg/Vector3"]
    video = Channel("/video", "json", Schema("foxglove.CompressedVideo", "jsonschema", JSON), {})
    noise = Channel("/noise", "json", None, {})
    for n in range(40):
        time_ns = START + n * 50 * MS
        stamp = moment(*divmod(time_ns, SECOND))

        def add(
            topic: str, kind: str, message: Any, offset: int = 0, time_ns: int = time_ns
        ) -> None:
            data = bytes(ROS2.serialize_cdr(message, kind))
            recording.write(ros_channel(topic, kind, 2), data, log_time=time_ns + offset)

        angle = n / 30
        half = turn(x=0.0, y=0.0, z=float(np.sin(angle / 2)), w=float(np.cos(angle / 2)))
        links = [
            types["geometry_msgs/msg/TransformStamped"](
                header(stamp, above),
                below,
                types["geometry_msgs/msg/Transform"](vector(x=n / 10, y=1.0, z=0.0), half),
            )
            for above, below in (("map", "odom"), ("odom", "base"))
        ]
        add("/tf", "tf2_msgs/msg/TFMessage", types["tf2_msgs/msg/TFMessage"](links))
        pose = types["geometry_msgs/msg/Pose"](point(x=n / 20, y=0.0, z=0.0), half)
        stamped = types["geometry_msgs/msg/PoseStamped"](header(stamp, "odom"), pose)
        add("/pose", "geometry_msgs/msg/PoseStamped", stamped, 1 * MS)
        scan = types["sensor_msgs/msg/LaserScan"](
            header(stamp, "base"),
            angle_min=-1.0,
            angle_max=1.0,
            angle_increment=0.004,
            time_increment=0.0,
            scan_time=0.05,
            range_min=0.1,
            range_max=10.0,
            ranges=np.arange(500, dtype=np.float32) / 100,
            intensities=np.empty(0, np.float32),
        )
        add("/scan", "sensor_msgs/msg/LaserScan", scan, 2 * MS)
        if n % 2 == 0 and n // 2 < 12:
            data = payload("json", "h264", encoded("h264")[n // 2])
            recording.write(video, data, log_time=time_ns + 3 * MS)
        if n in {10, 25}:
            mark = mark_payload(f"turn {n}", {"kind": "turn"}, time_ns + 300 * MS)
            recording.write(MARK_CHANNEL, mark, log_time=time_ns + 4 * MS)
        content = json.dumps({"n": n, "text": NOISE.decode()}).encode()
        recording.write(noise, content, log_time=time_ns + 5 * MS)


class Jobs:
    """A store that was copied while its recording went on, and what the ended one answers."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "store"
        self.copy = folder / "copy"
        settings = SegmentSettings(chunk_size=1024, compression="none", sync="never")
        with hl.open(self.path, create=True, mongo="none") as store:
            with store.start("other", settings=settings) as other:
                write(other)
                other.write(Channel("/more", "json", None, {}), b"{}", log_time=START + SECOND)
            live = store.start("run", settings=settings, flush_interval_s=0.05)
            write(live)
            with hl.open(self.path, mongo="none") as reader:
                wait_for(lambda: reader.entry("run").messages >= 174)
            (self.path / "contract.yaml").write_text("topics: {}\n")
            shutil.copytree(self.path, self.copy, ignore=shutil.ignore_patterns("*.sock"))
            live.close()
            checked = [one for one in store.check(["run"]) if one.topic in ROS]
        self.contract = folder / "contract.yaml"
        self.contract.write_text(contract_of(checked))
        self.wanted = self.answers(self.path, folder / "wanted")

    def answers(self, store: Path, folder: Path) -> dict[Asked, Any]:
        """What every job gives, and the files that it writes."""
        found: dict[Asked, Any] = {}
        folder.mkdir()
        for number, asked in enumerate(one for jobs in JOBS.values() for one in jobs):
            place = folder / str(number)
            place.mkdir()
            words = [
                word.replace(OUT, str(place / "out")).replace("CONTRACT", str(self.contract))
                for word in asked
            ]
            if "-r" not in words and words[0] not in {"diff", "tf"}:
                words += ["-r", "run"]
            if words[0] == "tf":
                words += ["-r", "run"]
            done = answer(*words, store=store, code=None)
            files = {p.relative_to(place).as_posix(): content(p) for p in outputs(place)}
            found[asked] = (done.code, json_or_text(done.out), files)
        return found


def outputs(place: Path) -> list[Path]:
    """Its files; a bag is one."""
    return [
        one
        for one in sorted(place.rglob("*"))
        if (one.is_file() and not (one.parent / "metadata.yaml").exists())
        or (one / "metadata.yaml").exists()
    ]


def content(path: Path) -> Any:
    """What an output holds, whatever its chunks."""
    if path.is_dir():
        with Reader(path) as reader:
            return [(c.topic, time, bytes(raw)) for c, time, raw in reader.messages()]
    if path.suffix == ".mp4":
        name, times, pictures = read_mp4(path)
        return name, times, [one.tobytes() for one in pictures]
    if path.suffix == ".mcap":
        return read_mcap(path)
    return path.read_bytes()


def json_or_text(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def but_for_flushing(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows about topics; of a running recording, one may be flushed later than another."""
    kept = [one for one in rows if one.get("what") != "early_stop"]
    return [{k: v for k, v in one.items() if k not in {"early_ns", "found"}} for one in kept]


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> Jobs:
    return Jobs(tmp_path_factory.mktemp("jobs"))


def damage(recording: Path) -> None:
    """Damage chunks of a topic that no job asks for, and the index of none."""
    segments = recording.glob("*.mcap")
    (segment, data), *_ = ((one, found) for one in segments if NOISE in (found := one.read_bytes()))
    for _ in range(3):
        data = data.replace(NOISE, b"DAMAGE" * (len(NOISE) // 6) + b"D" * (len(NOISE) % 6), 1)
    segment.write_bytes(data)


GOES_ON = ("running", "unfinished", "recovered")
STATES = ("ended", *GOES_ON, "read-only", "damaged", "with arrays", "with MongoDB")


@contextmanager
def in_state(jobs: Jobs, path: Path, state: str, patch: pytest.MonkeyPatch) -> Iterator[None]:
    shutil.copytree(jobs.copy if state in GOES_ON else jobs.path, path)
    if state in {"unfinished", "read-only"}:
        patch.setattr(StoreDirectory, "is_writable", False)
    elif state == "damaged":
        damage(places.folder(path, "run"))
    elif state == "with arrays":
        with hl.open(path, mongo="none") as store:
            (found,) = store.index.arrays("/scan")
            assert found.recordings
    elif state == "with MongoDB":
        patch.setenv("HYBRIDLOG_MONGO_URI", "embedded")
        answer("index", "rebuild", store=path)
    elif state == "running":
        with (places.folder(path, "run") / "writer.lock").open("r+b") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        return
    yield


@pytest.mark.parametrize("state", STATES)
def test_jobs(jobs: Jobs, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with in_state(jobs, tmp_path / "store", state, monkeypatch):
        found = jobs.answers(tmp_path / "store", tmp_path / "found")
    for asked, (code, said, files) in jobs.wanted.items():
        own_code, own, own_files = found[asked]
        if state == "damaged" and asked[0] == "diff":
            assert own_code == 5  # it reads all topics
            continue
        if state == "running" and asked[0] in {"check", "diff"}:
            said, own = (but_for_flushing(rows) for rows in (said, own))
        assert own_code == code, (asked, own)
        assert own == said, asked
        assert own_files == files, asked


def test_the_ended_recording_answers(jobs: Jobs) -> None:
    """So that no job is the same everywhere because it does nothing."""
    for asked, (_, said, files) in jobs.wanted.items():
        assert asked == ("diff", "run", "run", "--json") or said or files, asked
    assert len(jobs.wanted[JOBS["split-by"][0]][2]) == 2
