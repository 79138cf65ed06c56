"""One contract, kept by every backend, and what each of them keeps apart from it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import threading
import time
from base64 import b64decode
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from benchmarks.backends import mongo, postgres, postgres_server, sqlite
from benchmarks.backends.base import Backend, BackendFailedError, BackendMissingError
from benchmarks.backends.registry import BACKENDS
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo import mongod
from hybridlog_storage.mongo.collection_names import collection_of
from tests.imports import ROOT
from tests.test_faults import kill_mongod
from tests.waiting import wait_for

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
    failures: list[BaseException] = []

    def work(numbers: Sequence[int]) -> None:
        try:
            for batch in zip(*(messages(n, first, last) for n in numbers), strict=True):
                for message in batch:
                    backend.insert(*message)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=[numbers]) for numbers in by_topic.values()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not failures
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


COUNT = """
import json, sys
from pathlib import Path
from benchmarks.backends.registry import BACKENDS
from tests.benchmarks.test_backends import CHANNELS
backend = BACKENDS[sys.argv[1]](Path(sys.argv[2]))
try:
    backend.open(CHANNELS)
    print(json.dumps(dict(backend.counts())))
finally:
    backend.close()
"""


def in_another_process(script: str, *arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# Reading back by other means than the backend's own.


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


# What single backends are asked besides.


def leaves_out_what_no_document_can_hold(backend: Any) -> None:
    image = bytes(17 << 20)
    head = struct.pack("<IIII", 0, 0, 0, 0) + struct.pack("<I", len(image))
    backend.insert(2, START, head + image + bytes(8))
    assert backend.refused == {"/scan": 1}


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
    "mongo": leaves_out_what_no_document_can_hold,
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

    assert json.loads(in_another_process(COUNT, name, tmp_path)) == by_topic(sent)
    assert not working_in(tmp_path)

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


def test_registry() -> None:
    for name, backend in BACKENDS.items():
        assert backend.name == name
        assert backend.about
        assert "\n" not in backend.about


def test_table_names_stay_apart() -> None:
    topics = [*HOSTILE, "/long_name" * 29 + "/x", "/SQLITE_master", "/a/B", ""]
    for table_of in (postgres.table_of, sqlite.table_of):
        names = [table_of(topic) for topic in topics]
        assert len({name.lower() for name in names if table_of is sqlite.table_of}) in {
            0,
            len(topics),
        }
        assert len(set(names)) == len(topics)
        assert not any(name.lower().startswith("sqlite_") for name in names) or (
            table_of is postgres.table_of
        )
        assert table_of("/r_cart/command_pose") == "r_cart__command_pose"
    assert all(len(postgres.table_of(topic).encode()) <= 63 for topic in topics)


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


# Failures.


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


def test_hybridlog_counts_right_after_its_server_was_killed(tmp_path: Path) -> None:
    with opened("hybridlog", tmp_path, CHANNELS[:1]) as backend:
        for message in messages(0, 0, 50):
            backend.insert(*message)
        # Once it is in the index; what the server thinks it has is then wrong by as much.
        recording = backend._recording
        wait_for(lambda: recording.stored[0] == 50 and recording.lag == 0)
        time.sleep(2 * mongod._JOURNAL_MS / 1000)
        kill_mongod(backend.path)
        for message in messages(0, 50, 100):
            backend.insert(*message)
        backend.finish()
        assert backend.counts() == {CHANNELS[0].topic: 100}


HOLD = """
import sys, time
from pathlib import Path
from benchmarks.backends.registry import BACKENDS
from benchmarks.backends import postgres_server
from tests.benchmarks.test_backends import CHANNELS, messages
postgres_server.CLUSTER += ("--no-sync",)
backend = BACKENDS[sys.argv[1]](Path(sys.argv[2]))
backend.open(CHANNELS)
for message in messages(0, 0, 10):
    backend.insert(*message)
backend.finish()
print("ready", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("name", ["mongo", "postgres"])
def test_a_killed_benchmark_takes_its_server_along(name: str, tmp_path: Path) -> None:
    benchmark = subprocess.Popen(
        [sys.executable, "-c", HOLD, name, str(tmp_path)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    with benchmark:
        assert benchmark.stdout is not None
        assert benchmark.stdout.readline() == "ready\n"
        benchmark.kill()
    # At once, while the server may still be ending: the next one waits for that.
    with opened(name, tmp_path) as backend:
        assert backend.counts()[CHANNELS[0].topic] == 10
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


@pytest.mark.parametrize("name", ["mongo", "hybridlog"])
def test_a_missing_mongod_is_told_with_its_cure(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HYBRIDLOG_MONGOD", str(tmp_path / "none"))
    with pytest.raises(BackendMissingError, match="HYBRIDLOG_MONGOD"):
        BACKENDS[name].check()


def test_a_server_that_does_not_start_is_told_with_what_it_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "not_mongod"
    program.write_text("#!/bin/sh\necho 'the cat is on the keyboard' >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setenv("HYBRIDLOG_MONGOD", str(program))
    backend = BACKENDS["mongo"](tmp_path)
    with pytest.raises(BackendMissingError, match="the cat is on the keyboard"):
        backend.open(CHANNELS)
    backend.close()
    assert not working_in(tmp_path)


def test_a_full_sqlite_file_is_a_failure(tmp_path: Path) -> None:
    with opened("sqlite", tmp_path) as backend:
        backend.connection.execute("PRAGMA max_page_count = 60")
        insert = backend.insert
        with pytest.raises(BackendFailedError, match="full"):
            list(map(insert, *zip(*messages(2, 0, 250), strict=True)))


FULL = """
import resource, signal, sys
from pathlib import Path
from benchmarks.backends.base import BackendFailedError
from benchmarks.backends.registry import BACKENDS
from tests.benchmarks.test_backends import CHANNELS
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
backend = BACKENDS[sys.argv[1]](Path(sys.argv[2]))
backend.open(CHANNELS)
try:
    import random
    for number in range(100):
        backend.insert(0, number, random.Random(number).randbytes(100_000))
    backend.finish()
except BackendFailedError as error:
    print(error)
backend.close()
"""


@pytest.mark.parametrize("name", ["mcap", "bagfile"])
def test_a_file_that_cannot_grow_is_a_failure(name: str, tmp_path: Path) -> None:
    assert "File too large" in in_another_process(FULL, name, tmp_path)


def test_a_bag_does_not_take_what_is_not_ros(tmp_path: Path) -> None:
    with pytest.raises(BackendMissingError, match="ROS 1 alone"):
        BACKENDS["bagfile"](tmp_path).open([Channel("/a", "json", None)])


def test_slashes_that_a_bag_leaves_out_do_not_hide_messages(tmp_path: Path) -> None:
    channels = [Channel(topic, "ros1", GRIPPER) for topic in ("/a//b/", "/a/b", "c/")]
    with opened("bagfile", tmp_path, channels) as backend:
        for number in range(3):
            backend.insert(number, START, gripper(number))
        backend.finish()
        assert dict(backend.counts()) == {"/a//b/": 1, "/a/b": 1, "c/": 1}
