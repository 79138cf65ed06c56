"""One contract, kept by every backend, and what each of them keeps apart from it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
import struct
import sys
import tempfile
import time
from base64 import b64decode
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

from benchmarks.backends import mongo, postgres, postgres_server, sqlite
from benchmarks.backends.base import Backend, BackendFailedError, BackendMissingError
from benchmarks.backends.registry import BACKENDS
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.collection_names import collection_of
from tests.waiting import at_once

pytestmark = pytest.mark.mongo("embedded")

KEEPING = [name for name in BACKENDS if name != "nothing"]
START = 1_436_866_013_589_000_000
STEP = 10_000_000

GRIPPER = Schema(
    "pr2_controllers_msgs/Pr2GripperCommand", "ros1msg", b"float64 position\nfloat64 max_effort\n"
)
POSE = Schema(
    "geometry_msgs/Pose",
    "ros1msg",
    b"Point position\n" + b"=" * 80 + b"\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\n"
    b"float64 z\n",
)
SCAN = Schema(
    "bench_msgs/Scan",
    "ros1msg",
    b"time stamp\nstring frame\nfloat32[] ranges\nuint8[] image\nuint64 serial\n",
)
STAMPED = Schema(
    "geometry_msgs/PoseStamped",
    "ros1msg",
    b"Pose pose\n" + b"=" * 80 + b"\nMSG: geometry_msgs/Pose\n" + POSE.data,
)
HOSTILE = (
    "/A/b",
    "/a/b",
    '/x"; DROP TABLE a__b; --',
    "/long_name" * 30,
    "/sqlite_master",
    "no $slash. 'quoted' \\ \n{} %s",
    "/ünïcode/☃",
)

Message = tuple[int, int, bytes]
"""Channel, log time, payload."""


@pytest.fixture(autouse=True)
def surroundings(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[None]:
    """Clusters are made fast, and no socket is left behind."""
    tmp_path_factory.getbasetemp()  # before there is another place for temporary files
    monkeypatch.setattr(postgres_server, "CLUSTER", (*postgres_server.CLUSTER, "--no-sync"))
    with tempfile.TemporaryDirectory(prefix="hlt-", dir="/tmp") as sockets:
        monkeypatch.setenv("TMPDIR", sockets)
        monkeypatch.setattr(tempfile, "tempdir", sockets)
        yield
        assert not list(Path(sockets).glob("hybridlog-bench-*"))


def gripper(number: int) -> bytes:
    return struct.pack("<dd", number * 0.25, -1.0)


def pose(number: int) -> bytes:
    return struct.pack("<ddd", number - 3.0, 0.5, float("nan"))


def scan(number: int) -> bytes:
    frame = f"laser\0{number}".encode()
    image = bytes([number]) * 1000
    return b"".join(
        (
            struct.pack("<III", 1_436_866_013, number, len(frame)),
            frame,
            struct.pack("<I3f", 3, 1.5, float("inf"), number),
            struct.pack("<I", len(image)),
            image,
            struct.pack("<Q", (1 << 63) + 2048 * number),
        )
    )


CHANNELS = (
    Channel("/r_gripper_controller/command", "ros1", GRIPPER, {"callerid": "/one"}),
    Channel("/rviz/camera_pose", "ros1", POSE),
    Channel("/scan", "ros1", SCAN),
    Channel("/r_gripper_controller/command", "ros1", GRIPPER, {"callerid": "/two"}),
    Channel("/r_cart/command_pose", "ros1", STAMPED),
    *(Channel(topic, "ros1", GRIPPER) for topic in HOSTILE),
)
MAKERS: tuple[Callable[[int], bytes], ...] = (
    *(gripper, pose, scan, gripper, pose),
    *(gripper for _ in HOSTILE),
)


def messages(channel: int, first: int, last: int) -> list[Message]:
    return [(channel, START + n * STEP, MAKERS[channel](n)) for n in range(first, last)]


def insert_from_threads(backend: Backend, first: int, last: int) -> list[Message]:
    """A thread a topic, as in the harness; several channels of a topic share one."""
    by_topic: dict[str, list[int]] = defaultdict(list)
    for number, channel in enumerate(CHANNELS):
        by_topic[channel.topic].append(number)

    def work(numbers: Sequence[int]) -> None:
        for batch in zip(*(messages(n, first, last) for n in numbers), strict=True):
            for message in batch:
                backend.insert(*message)

    at_once(*(partial(work, numbers) for numbers in by_topic.values()))
    return [message for n in range(len(CHANNELS)) for message in messages(n, first, last)]


def by_topic(sent: Sequence[Message]) -> dict[str, int]:
    return dict(Counter(CHANNELS[channel].topic for channel, _, _ in sent))


@contextlib.contextmanager
def opened(name: str, directory: Path, channels: Sequence[Channel] = CHANNELS) -> Iterator[Any]:
    backend = BACKENDS[name](directory)
    try:
        backend.open(channels)
        yield backend
    finally:
        backend.close()


def is_alive(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def working_in(directory: Path) -> list[str]:
    """Command lines of processes that have something to do with a directory."""
    found = []
    for process in psutil.process_iter(["pid", "cmdline"]):
        line = " ".join(process.info["cmdline"] or ())
        if str(directory) in line and process.info["pid"] != os.getpid():
            found.append(line)
    return found


def mongo_documents(backend: Any) -> dict[str, list[Any]]:
    return {
        channel.topic: list(backend.database[collection_of(channel.topic)].find())
        for channel in CHANNELS
    }


def postgres_documents(backend: Any) -> dict[str, list[Any]]:
    with backend.connect() as connection:
        return {
            channel.topic: [
                row[0]
                for row in connection.execute(
                    # The identifiers of this are the backend's word; the quotes are not.
                    "SELECT data FROM "
                    + '"'
                    + backend.table_of(channel.topic).replace('"', '""')
                    + '"'
                )
            ]
            for channel in CHANNELS
        }


def sqlite_documents(backend: Any) -> dict[str, list[Any]]:
    connection = sqlite3.connect(backend.path)
    with contextlib.closing(connection):
        return {
            channel.topic: [
                json.loads(row[0])
                for row in connection.execute(
                    f"SELECT msg FROM {sqlite.quoted(sqlite.table_of(channel.topic))}"
                )
            ]
            for channel in CHANNELS
        }


def mcap_payloads(backend: Any) -> list[tuple[str, int, bytes]]:
    from mcap.reader import make_reader

    found = []
    for path in backend.paths:
        with path.open("rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages():
                found.append((channel.topic, message.log_time, message.data))
    return found


def bag_payloads(backend: Any) -> list[tuple[str, int, bytes]]:
    from rosbags.rosbag1 import Reader

    found = []
    for path in backend.paths:
        with Reader(path) as reader:
            for connection, log_time, payload in reader.messages():
                found.append((connection.topic, log_time, bytes(payload)))
    return found


def hybridlog_payloads(backend: Any) -> list[tuple[str, int, bytes]]:
    return [
        (message.topic, message.log_time_ns, message.raw) for message in backend.store.all_topics()
    ]


PAYLOADS = {
    "mcap": mcap_payloads,
    "bagfile": bag_payloads,
    "hybridlog": hybridlog_payloads,
}


def documents_of(backend: Any) -> dict[str, list[Any]]:
    if backend.name.startswith("mongo"):
        return mongo_documents(backend)
    return (postgres_documents if "postgres" in backend.name else sqlite_documents)(backend)


def check_documents(backend: Any, sent: Sequence[Message]) -> None:
    """Compare with what was sent, field by field."""
    is_json = not backend.name.startswith("mongo")
    nul = "\ufffd" if backend.name == "postgres_indexed" else "\0"
    found = documents_of(backend)
    assert {topic: len(rows) for topic, rows in found.items()} == by_topic(sent)
    for topic, rows in found.items():
        for document in rows:
            document.pop("_id", None)
            meta = document.pop("_meta")
            number, rest = divmod(meta["t"] - START, STEP)
            assert rest == 0
            at = meta["inserted_at"]
            text = at.removesuffix("Z") if is_json else at.isoformat(timespec="milliseconds")
            milliseconds = 589 + number * 10
            assert text == f"2015-07-14T09:26:{53 + milliseconds // 1000}.{milliseconds % 1000:03}"
            if topic == "/scan":
                image = document.pop("image")
                assert (b64decode(image) if is_json else image) == bytes([number]) * 1000
                serial = document.pop("serial")
                assert serial == (1 << 63) + 2048 * number
                assert isinstance(serial, int if is_json else float)
                assert document == {
                    "stamp": {"secs": 1_436_866_013, "nsecs": number},
                    "frame": f"laser{nul}{number}",
                    "ranges": [1.5, None if is_json else float("inf"), float(number)],
                }
            elif topic in {"/rviz/camera_pose", "/r_cart/command_pose"}:
                document = document.get("pose", document)
                z = document["position"].pop("z")
                assert z is None if is_json else z != z
                assert document == {"position": {"x": number - 3.0, "y": 0.5}}
            else:
                assert document == {"position": number * 0.25, "max_effort": -1.0}


def has_the_indexes_of_the_appendix(backend: Any) -> None:
    made = {
        topic: {
            tuple(index["key"]) for index in backend.database[collection_of(topic)].list_indexes()
        }
        - {("_id",)}
        for topic in ("/r_gripper_controller/command", "/rviz/camera_pose", "/r_cart/command_pose")
    }
    assert made == {
        "/r_gripper_controller/command": {("position",), ("_meta.inserted_at",)},
        "/rviz/camera_pose": {("position.x", "_meta.inserted_at"), ("_meta.inserted_at",)},
        "/r_cart/command_pose": {
            ("pose.position.x", "pose.position.y", "pose.position.z"),
            ("_meta.inserted_at",),
        },
    }


INDEXED_PATHS = {
    "/r_gripper_controller/command": ("position", "_meta.t"),
    "/rviz/camera_pose": ("position.x",),
    "/r_cart/command_pose": ("pose.position.x",),
}


def postgresql_uses_its_indexes(backend: Any) -> None:
    with backend.connect() as connection:
        connection.execute("SET enable_seqscan = off")
        for topic, paths in INDEXED_PATHS.items():
            for path in paths:
                rows = connection.execute(
                    f'EXPLAIN SELECT count(*) FROM "{backend.table_of(topic)}" '
                    f"WHERE {postgres.expression(path)} <= 0"
                )
                plan = "\n".join(row[0] for row in rows)
                assert "Index Cond" in plan, plan


def sqlite_uses_its_indexes(backend: Any) -> None:
    for topic, paths in INDEXED_PATHS.items():
        for path in paths:
            rows = backend.connection.execute(
                f"EXPLAIN QUERY PLAN SELECT count(*) FROM {sqlite.quoted(sqlite.table_of(topic))} "
                f"WHERE {sqlite.expression(path)} <= 0"
            ).fetchall()
            assert "INDEX" in str(rows), rows


BESIDES: dict[str, Callable[[Any], None]] = {
    "mongo_indexed": has_the_indexes_of_the_appendix,
    "postgres_indexed": postgresql_uses_its_indexes,
    "sqlite_indexed": sqlite_uses_its_indexes,
}


ALWAYS = frozenset(("hybridlog", "mongo", "sqlite_indexed"))
"""The others are tried before figures are published."""


@pytest.mark.parametrize(
    "name",
    [
        name if name in ALWAYS else pytest.param(name, marks=pytest.mark.exhaustive)
        for name in KEEPING
    ],
)
def test_contract(name: str, tmp_path: Path) -> None:
    with opened(name, tmp_path) as backend:
        sent = insert_from_threads(backend, 0, 20)
        servers = backend.processes()
        assert bool(servers) == (backend.kind == "hybrid" or name.startswith(("mongo", "postgres")))
        # The first is the server; PostgreSQL's workers come and go.
        assert all(is_alive(pid) for pid in servers[:1])
        backend.finish()
        assert dict(backend.counts()) == by_topic(sent)
        assert not getattr(backend, "refused", None)
    assert not working_in(tmp_path)
    assert not any(is_alive(pid) for pid in servers)

    with opened(name, tmp_path) as backend:
        sent += insert_from_threads(backend, 20, 25)
        if name in BESIDES:
            BESIDES[name](backend)
        backend.finish()
        assert dict(backend.counts()) == by_topic(sent)
        if name in PAYLOADS:
            found = PAYLOADS[name](backend)
            wanted = [(CHANNELS[channel].topic, t, payload) for channel, t, payload in sent]
            assert sorted(found) == sorted(wanted)
        else:
            check_documents(backend, sent)
    assert not working_in(tmp_path)


@pytest.mark.parametrize("name", ["mongo", "postgres", "sqlite_indexed"])
def test_two_seconds_of_messages_go_in_together(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = {"mongo": mongo, "postgres": postgres, "sqlite_indexed": sqlite}[name]
    monkeypatch.setattr(module, "BATCH_S", 1e9)  # only what they hold makes them go
    with opened(name, tmp_path) as backend:

        def count() -> int:
            return len(documents_of(backend)[CHANNELS[0].topic])

        for message in messages(0, 0, 20):
            backend.insert(*message)
        assert count() == 0
        monkeypatch.setattr(module, "BATCH_BYTES", 0)
        backend.insert(*messages(0, 20, 21)[0])
        assert count() == 21
        for message in messages(0, 21, 23):
            backend.insert(*message)
        backend.finish()
        assert count() == 23


@pytest.mark.parametrize("name", ["mongo", "postgres"])
def test_a_killed_server_is_told_and_leaves_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (mongo, postgres):
        monkeypatch.setattr(module, "BATCH_S", 0.05)

    def go_on() -> None:
        for message in messages(0, 50, 1000):
            backend.insert(*message)
            time.sleep(0.001)
        backend.finish()

    with opened(name, tmp_path, CHANNELS[:1]) as backend:
        for message in messages(0, 0, 50):
            backend.insert(*message)
        os.kill(backend.processes()[0], signal.SIGKILL)
        began = time.monotonic()
        for _ in range(2):
            with pytest.raises(BackendFailedError, match=r"\w"):
                go_on()
        with pytest.raises(BackendFailedError):
            backend.counts()
        assert time.monotonic() - began < 50, "it waits as long as a driver does by itself"
    assert not working_in(tmp_path)


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("mcap", "mcap"),
        ("bagfile", "rosbags"),
        ("mongo", "pymongo"),
        ("postgres", "psycopg"),
    ],
)
def test_a_missing_driver_is_told_with_its_cure(
    name: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    backend = BACKENDS[name](tmp_path)
    with pytest.raises(BackendMissingError, match="pip install"):
        BACKENDS[name].check()
    with pytest.raises(BackendMissingError, match="pip install"):
        backend.open(CHANNELS)
    backend.close()
