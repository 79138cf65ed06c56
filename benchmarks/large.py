"""Ten million messages in one recording: `python -m benchmarks.large FOLDER --hours 3`.

Writes the log of a robot with 928 messages a second and records it into `FOLDER/store`; a store
that is there already is used as it is. Then commands run on it, each in a process of its own.
Printed for each: time on the clock and of the processor in s, the largest memory of the process
in MB, and the last line of its output.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from hybridlog.demo.topics import Types

START = 1_700_000_000 * 10**9
SECOND = 10**9
BEAMS, WIDTH, HEIGHT = 360, 96, 72
JOINTS = (b"left__", b"right_", b"mast__")
Rows = NDArray[np.void]
Seconds = NDArray[np.float64]


def _packed(*fields: tuple[Any, ...], header: bool = True) -> np.dtype[Any]:
    """The bytes of a ROS 1 message whose strings and arrays have one length."""
    head = [("seq", "<u4"), ("secs", "<u4"), ("nsecs", "<u4"), ("id_size", "<u4"), ("id", "S4")]
    return np.dtype([*(head if header else ()), *fields])


IMU = _packed(
    ("orientation", "<f8", 4), ("a", "<f8", 9), ("turn", "<f8", 3), ("b", "<f8", 9),
    ("force", "<f8", 3), ("c", "<f8", 9),
)  # fmt: skip
ODOM = _packed(
    ("child_size", "<u4"), ("child", "S4"), ("position", "<f8", 3), ("orientation", "<f8", 4),
    ("a", "<f8", 36), ("twist", "<f8", 6), ("b", "<f8", 36),
)  # fmt: skip
TF = np.dtype([
    ("transforms", "<u4"), *((name, IMU.fields[name][0]) for name in IMU.names[:5]),
    ("child_size", "<u4"), ("child", "S4"), ("position", "<f8", 3), ("orientation", "<f8", 4),
])  # fmt: skip
JOINT_STATES = _packed(
    ("names", "<u4"), ("name", [("size", "<u4"), ("text", "S6")], len(JOINTS)),
    ("positions", "<u4"), ("position", "<f8", len(JOINTS)),
    ("velocities", "<u4"), ("velocity", "<f8", len(JOINTS)), ("efforts", "<u4"),
)  # fmt: skip
SCAN = _packed(
    ("settings", "<f4", 7), ("beams", "<u4"), ("ranges", "<f4", BEAMS), ("intensities", "<u4"),
)  # fmt: skip
IMAGE = _packed(
    ("height", "<u4"), ("width", "<u4"), ("encoding_size", "<u4"), ("encoding", "S5"),
    ("is_bigendian", "u1"), ("step", "<u4"), ("size", "<u4"), ("data", "u1", (HEIGHT, WIDTH)),
)  # fmt: skip
FIX = _packed(
    ("status", "i1"), ("service", "<u2"), ("place", "<f8", 3), ("a", "<f8", 9), ("kind", "u1"),
)  # fmt: skip
MODE = _packed(("data", "u1"), header=False)


def _speed(seconds: Seconds) -> Seconds:
    """Forward speed of the robot, m/s: it stands still now and then."""
    return np.maximum(0.0, np.sin(seconds / 40) + 0.3 * np.sin(seconds / 7))


def _imu(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["orientation"][:, 2] = np.sin(seconds / 120)
    rows["orientation"][:, 3] = np.cos(seconds / 120)
    rows["turn"] = noise.normal(scale=0.01, size=(len(rows), 3))
    rows["force"] = noise.normal(scale=0.1, size=(len(rows), 3))
    rows["force"][:, 2] += 9.81


def _odom(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["child_size"], rows["child"] = 4, b"base"
    rows["position"][:, 0], rows["position"][:, 1] = 20 * np.sin(seconds / 90), seconds / 100
    rows["orientation"][:, 3] = 1
    rows["twist"][:, 0] = _speed(seconds) + noise.normal(scale=0.01, size=len(rows))


def _tf(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["transforms"], rows["child_size"], rows["child"] = 1, 4, b"base"
    rows["position"][:, 0] = 20 * np.sin(seconds / 90)
    rows["orientation"][:, 3] = 1


def _joint_states(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["names"] = rows["positions"] = rows["velocities"] = len(JOINTS)
    rows["name"]["size"], rows["name"]["text"] = 6, JOINTS
    rows["position"][:] = (seconds[:, None] * (1, 1.1, 0.01)) % 6.28
    rows["velocity"][:] = _speed(seconds)[:, None]


def _scan(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["settings"] = -3.14, 3.14, 6.28 / BEAMS, 0, 0.05, 0.1, 30
    rows["beams"] = BEAMS
    walls = 6 + 5.6 * np.sin(seconds[:, None] / 61 + np.arange(BEAMS) / 57)
    rows["ranges"] = np.round(walls + noise.normal(scale=0.01, size=walls.shape), 3)


def _image(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["height"], rows["width"], rows["encoding_size"] = HEIGHT, WIDTH, 5
    rows["encoding"], rows["step"], rows["size"] = b"mono8", WIDTH, HEIGHT * WIDTH
    across = np.arange(WIDTH) + 10 * seconds[:, None, None]
    rows["data"] = (
        2 * across + np.arange(HEIGHT)[:, None] + noise.integers(0, 4, rows["data"].shape)
    )


def _fix(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["place"] = 52.0, 8.0, 60.0
    rows["place"][:, 0] += seconds * 1e-6 + noise.normal(scale=1e-6, size=len(rows))


def _mode(rows: Rows, seconds: Seconds, noise: np.random.Generator) -> None:
    rows["data"] = seconds // 97 % 7


Fill = Callable[[Rows, Seconds, np.random.Generator], None]
TOPICS: dict[str, tuple[int, str, np.dtype[Any], Fill]] = {
    "/imu/data": (500, "sensor_msgs/Imu", IMU, _imu),
    "/tf": (200, "tf2_msgs/TFMessage", TF, _tf),
    "/odom": (100, "nav_msgs/Odometry", ODOM, _odom),
    "/joint_states": (100, "sensor_msgs/JointState", JOINT_STATES, _joint_states),
    "/scan": (20, "sensor_msgs/LaserScan", SCAN, _scan),
    "/camera/image_raw": (5, "sensor_msgs/Image", IMAGE, _image),
    "/fix": (1, "sensor_msgs/NavSatFix", FIX, _fix),
    "/mode": (1, "std_msgs/UInt8", MODE, _mode),
}
"""Messages a second, type, layout and content."""


def write_log(path: Path, seconds: int) -> None:
    """Write the log; its times begin at `START`, and a second lacks scans now and then."""
    types, noise = Types(1), np.random.default_rng(1)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 20, compression=CompressionType.ZSTD)
        writer.start(profile="ros1")
        channels = {}
        for topic, (_, kind, _, _) in TOPICS.items():
            package, name = kind.split("/")
            text, _ = types.store.generate_msgdef(f"{package}/msg/{name}")
            schema = writer.register_schema(kind, "ros1msg", text.encode())
            channels[topic] = writer.register_channel(topic, "ros1", schema)
        for second in range(seconds):
            messages = []
            for number, (topic, (rate, _, layout, fill)) in enumerate(TOPICS.items()):
                if topic == "/scan" and second % 1800 == 900:
                    continue
                since = second + np.arange(rate) / rate
                times = START + second * SECOND + np.arange(rate) * (SECOND // rate) + number
                rows = np.zeros(rate, layout)
                if layout is not MODE:
                    rows["id_size"], rows["id"] = 4, b"odom" if topic == "/odom" else b"base"
                    rows["seq"] = second * rate + np.arange(rate)
                    rows["secs"], rows["nsecs"] = np.divmod(times, SECOND)
                fill(rows, since, noise)
                size, data = layout.itemsize, rows.tobytes()
                messages += [
                    (log_time, channels[topic], data[n * size : (n + 1) * size])
                    for n, log_time in enumerate(times.tolist())
                ]
            messages.sort()
            for log_time, channel, payload in messages:
                writer.add_message(channel, log_time, payload, log_time)
        writer.finish()


RANGE = ("--between", "+5m", "+6m")
NEAR = "/odom: twist.twist.linear.x > 1.2"
COMMANDS: dict[str, tuple[str, ...]] = {
    "info": ("info",),
    "sql: filter": (
        "sql",
        "select count(*), avg(twist.twist.linear.x) from odom where twist.twist.linear.x > 0.5",
    ),
    "sql: group": (
        "sql",
        "select t // 60000000000, max(linear_acceleration.z) from imu__data group by 1",
    ),
    "sql: join": (
        "sql",
        "select m.data, avg(o.pose.pose.position.x) from odom o "
        "join mode m on o.t // 1000000000 = m.t // 1000000000 group by 1",
    ),
    "sql: as-of join": (
        "sql",
        "select count(*), avg(o.twist.twist.linear.x) from imu__data i "
        "asof join odom o on i.t >= o.t where i.angular_velocity.z > 0",
    ),
    "sql: all rows": ("sql", "select * from imu__data", "-o", "{out}.parquet"),
    "sql: sort": (
        "sql",
        "select * from imu__data order by angular_velocity.z",
        "-o",
        "{out}.parquet",
    ),
    "sql: arrays": ("sql", "select count(*), min(list_min(ranges)) from scan"),
    "count": ("fetch", "-t", "imu/data", "--where", "angular_velocity.z > 0.02", "--count"),
    "count of arrays": ("fetch", "-t", "scan", "--where", "ranges.min < 0.5", "--count"),
    "count of array elements": (
        "fetch",
        "-t",
        "scan",
        "--where",
        "ranges[100:140] < 0.5",
        "--count",
    ),
    "near another topic: count": (
        "fetch",
        "-t",
        "scan",
        "--where",
        NEAR,
        "--within",
        "0.1s",
        "--count",
    ),
    "near another topic: mcap": (
        "fetch",
        "-t",
        "scan",
        "--where",
        NEAR,
        "--within",
        "0.1s",
        "-o",
        "{out}.mcap",
    ),
    "fetch: range to mcap": ("fetch", "-t", "*", *RANGE, "-o", "{out}.mcap"),
    "fetch: range to bag": ("fetch", "-t", "*", *RANGE, "-o", "{out}.bag"),
    "fetch: one topic to mcap": ("fetch", "-t", "imu/data", "-o", "{out}.mcap"),
    "fetch: one topic to parquet": ("fetch", "-t", "imu/data", "-o", "{out}.parquet"),
    "fetch: fields to csv": (
        "fetch",
        "-t",
        "imu/data",
        "--fields",
        "angular_velocity.z",
        "-o",
        "{out}.csv",
    ),
    "align: as of": (
        "align",
        "--to",
        "imu/data",
        "-t",
        "odom",
        "-t",
        "scan",
        "-o",
        "{out}.parquet",
    ),
    "align: interpolate": (
        "align",
        "--to",
        "imu/data",
        "-t",
        "odom",
        "--how",
        "interpolate",
        "-o",
        "{out}.parquet",
    ),
    "resample": (
        "resample",
        "-t",
        "odom",
        "-t",
        "imu/data",
        "--step",
        "10ms",
        "-o",
        "{out}.parquet",
    ),
    "rate": ("rate",),
    "rate: windows": ("rate", "--window", "1s", "-o", "{out}.csv"),
    "gaps": ("gaps", "-t", "imu/data"),
    "stats": ("stats", "-t", "imu/data"),
    "stats of all": ("stats", "-t", "*"),
    "intervals": ("intervals", "-t", "odom", "--where", "twist.twist.linear.x > 0.5"),
    "intervals: noise": ("intervals", "-t", "imu/data", "--where", "angular_velocity.z > 0"),
    "changes": ("changes", "-t", "mode", "--fields", "data"),
    "changes: noise": ("changes", "-t", "imu/data", "--fields", "angular_velocity.z"),
    "trigger": ("trigger", "--rehearse", "/scan: ranges.min < 0.5"),
    "export: mcap": ("export", "{out}.mcap"),
    "export: parquet": ("export", "-F", "parquet", "{out}"),
    "verify": ("verify",),
    "compact: dry run": ("compact", "--dry-run"),
    "compact": ("compact",),
    "compact: without MCAP": ("compact", "--drop-mcap"),
    "index rebuild": ("index", "rebuild"),
}
"""Arguments by name, in an order in which the store is changed last."""
SYNC = """
import hybridlog as hl
sets = hl.open().sync(["odom", "scan"], tolerance="50ms")
print(len(sets), sum(len(one) for one in sets))
"""


def run(arguments: Sequence[str], store: Path) -> tuple[float, float, float, str]:
    """Run a Python process: s on the clock, s of the processor, MB of memory, last line."""
    environment = os.environ | {"HYBRIDLOG_STORE": str(store)}
    with tempfile.TemporaryFile() as printed:
        begin = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, *arguments], env=environment, stdout=printed, stderr=printed
        )
        _, status, usage = os.wait4(process.pid, 0)
        clock = time.monotonic() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        # Memory of this process would count as the next one's.
        printed.seek(max(0, printed.tell() - 4096))
        lines = printed.read().decode(errors="replace").splitlines() or [""]
    last = lines[-1] if not process.returncode else f"exit code {process.returncode}: {lines[-1]}"
    return clock, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1000, last


def main() -> None:
    """Make the store, run the commands, print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the store is made, and stays")
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--only", nargs="+", default=["*"], help="names, or globs")
    chosen = parser.parse_args()
    store, log = chosen.folder / "store", chosen.folder / "drive.mcap"
    row = "| {:26} | {:8.1f} | {:8.1f} | {:6.0f} | {}".format
    if not store.exists():
        chosen.folder.mkdir(parents=True, exist_ok=True)
        write_log(log, int(3600 * chosen.hours))
        print(row("record", *run(["-m", "hybridlog", "record", str(log)], store)), flush=True)
        log.unlink()
    works = {name: ("-m", "hybridlog", *command) for name, command in COMMANDS.items()}
    for name, arguments in {"sync": ("-c", SYNC), **works}.items():
        if not any(fnmatch(name, pattern) for pattern in chosen.only):
            continue
        with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
            filled = [part.replace("{out}", f"{folder}/out") for part in arguments]
            print(row(name, *run(filled, store)), flush=True)


if __name__ == "__main__":
    main()
