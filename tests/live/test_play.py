"""A robot that is left alone within a quota: whatever happens, every message is accounted for.

It is killed, and its disk is full. The robot writes down what it sends before it sends it.
"""

from __future__ import annotations

import errno
import os
import random
import struct
import subprocess
import sys
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from typing import Any

from msgspec.structs import replace

import hybridlog as hl
from hybridlog.live.recorder import Recorder, RecorderOptions
from hybridlog.maintenance.edit import mark_now
from hybridlog.maintenance.retention import MIN_SEGMENT
from hybridlog.maintenance.sizes import disk_bytes
from hybridlog.record.marks import MARKS
from hybridlog_storage.disk import files
from hybridlog_storage.errors import DiskFullError, PayloadError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.settings import write_settings
from tests.live.speaker import Recorded, Speaker
from tests.waiting import wait_for

FLUSH_S = 0.4
SLACK_S = 1.5  # for a machine that has other things to do
SECONDS, SPEED = 12, 8
QUOTA = 10_000_000
NOISE = random.Random(5).randbytes(1 << 20)
ROOM = 16_384
"""Bytes that a write may still have on the full disk: enough to seal a file."""
BLOB = Schema("a/Blob", "ros1msg", b"uint32 n\nfloat64 x\nuint8[] data\n")
SIZES = {"/camera": 50_000, "/points": 20_000, "/arm": 0}
EVERY = {"/camera": 10, "/points": 50, "/arm": 5}
"""Steps of 10 ms between two messages."""
CHANNELS = {topic: Channel(topic, "ros1", BLOB, {}, has_publish_time=False) for topic in SIZES}
PARTS = ("killed", "full")
Messages = dict[tuple[str, int], int]
"""Log time by topic and number."""


def payload(topic: str, number: int) -> bytes:
    size = SIZES[topic]
    first = number * 7919 % (len(NOISE) - size)
    return struct.pack("<IdI", number, number / 2, size) + NOISE[first : first + size]


def store_with(path: Path, **rules: str) -> hl.Store:
    """A new store with rules of retention, without MongoDB."""
    with hl.open(path, mongo="none", create=True) as store:
        settings = store.directory.settings
    write_settings(path, replace(settings, retention=rules))
    return hl.open(path, mongo="none")


class Robot:
    """Sends messages to a recorder, and writes down each of them before."""

    def __init__(self, path: Path, log: Path, part: str) -> None:
        self.path, self.part, self.is_full, self.used = path, part, False, 0
        self.log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self.store = hl.open(path, mongo="none")
        self.speaker = Speaker()
        options = RecorderOptions(name=part, reserve_bytes=0, flush_interval_s=FLUSH_S)
        self.recorder = Recorder(self.store, [self.speaker], options, self.say)

    def say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def note(self, *words: object) -> None:
        os.write(self.log, (" ".join(map(str, (self.part, *words))) + "\n").encode())

    def send(self, topic: str, number: int) -> None:
        now = time.time_ns()
        self.note(topic, number, now)
        self.speaker.say(CHANNELS[topic], payload(topic, number), now)

    def protect(self) -> None:
        """Pin what the camera has just seen, and mark the moment."""
        span = time.time_ns() - 10**9 // SPEED, time.time_ns()
        with hl.open(self.path, mongo="none") as other:
            other.pin(self.recorder.name, *span, ["/camera"])
        self.note("pin", *span)
        mark_now(self.store.directory, self.recorder._target.id, span[1], "slipped", {})

    def write(self, do: Any, fd: int, parts: list[memoryview], *where: int) -> int:
        size = sum(map(len, parts))
        if self.is_full and size > ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return int(do(fd, parts, *where))

    def run(self) -> None:
        """Go through the part; one that is to be killed goes on until then."""
        system: Any = files.system
        writev, pwritev = system.writev, system.pwritev
        system.writev = lambda *words: self.write(writev, *words)
        system.pwritev = lambda *words: self.write(pwritev, *words)
        self.recorder.start()
        begun, step = time.monotonic(), 0
        while step < 100 * SECONDS or self.part == "killed":
            if step / 100 > (time.monotonic() - begun) * SPEED:
                time.sleep(0.001)
                continue
            for topic, every in EVERY.items():
                if step % every == 0:
                    self.send(topic, step // every)
            step += 1
            if step == 40 * SECONDS:
                self.protect()
            self.is_full = self.part == "full" and step > 90 * SECONDS
            if step % 50 == 0:
                self.recorder.look()
                self.note("used", disk_bytes(self.path))
            if step == 100 * SECONDS:
                print("done", flush=True)
        if self.part == "full":
            wait_for(lambda: self.recorder.look() and self.recorder.wait(0.1))
            for number in range(5):
                self.send("/arm", 10**6 + number)
        assert self.recorder.wait(0) == (self.part == "full"), self.recorder.reason
        with suppress(DiskFullError):  # for what can be made again, such as the catalog
            self.recorder.stop()
        self.store.close()


def drive(path: str, log: str, part: str) -> None:
    Robot(Path(path), Path(log), part).run()


def stored_of(store: hl.Store, part: str) -> dict[tuple[str, int], tuple[int, bytes | None]]:
    found: dict[tuple[str, int], tuple[int, bytes | None]] = {}
    for topic in SIZES:
        query = store.query([topic], [part])
        before = len(found)
        for message in query:
            key = topic, message.fields["n"]
            assert key not in found
            assert message.fields["x"] == key[1] / 2
            try:
                found[key] = message.log_time_ns, message.raw
            except PayloadError:
                found[key] = message.log_time_ns, None
        assert query.count() == query.where("x >= 0").count() == len(found) - before
    return found


def check(store: hl.Store, part: str, sent: Messages, pins: list[list[int]], killed: int) -> int:
    """Compare what is stored of a part with what was sent; returns how many payloads are gone."""
    (entry,) = store.recordings(part)
    stored = stored_of(store, part)
    for key, (at, raw) in stored.items():
        assert at == sent[key]
        assert raw in {None, payload(*key)}
    for begin, end in pins:
        pinned = [key for key, at in sent.items() if begin <= at < end and key[0] == "/camera"]
        assert pinned
        assert all(stored[key][1] is not None for key in pinned)
    missing = {key: sent[key] for key in sent.keys() - stored.keys()}
    if part == "killed":
        assert entry.status == "recovered"
        assert all(killed - at < (FLUSH_S + SLACK_S) * 1e9 for at in missing.values())
    else:
        assert bool(missing) >= (part == "full")
        for topic in SIZES:
            gone = [at for (name, _), at in missing.items() if name == topic]
            rows = [row for row in entry.losses if row["topic"] == topic]
            assert sum(row["count"] for row in rows) == len(gone)
            assert {row["cause"] for row in rows} <= {"disk"}
            assert all(any(row["from"] <= at <= row["to"] for row in rows) for at in gone)
    assert [m.fields["text"] for m in store.query([MARKS], [part])] == ["slipped"]
    return sum(raw is None for _, raw in stored.values())


def test_every_message_of_a_robot_is_accounted_for(tmp_path: Path) -> None:
    path, log = tmp_path / "store", tmp_path / "sent"
    rules: dict[str, Any] = {"topic": {"/points": "1000d"}}
    store_with(path, quota=str(QUOTA), **rules).close()
    killed = 0
    code = "import sys; from tests.live.test_play import drive; drive(*sys.argv[1:])"
    for part in PARTS:
        command = [sys.executable, "-c", code, str(path), str(log), part]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == "done\n"
                if part == "killed":
                    time.sleep(random.Random(part).uniform(0, 0.5))
                    killed = time.time_ns()
                    process.kill()
                process.wait()
            finally:
                process.kill()
        assert process.returncode == (-9 if part == "killed" else 0)
    sent: dict[str, Messages] = defaultdict(dict)
    pins: dict[str, list[list[int]]] = defaultdict(list)
    for line in log.read_text().splitlines():
        part, what, *rest = line.split()
        numbers = [*map(int, rest)]
        if what == "used":
            assert numbers[0] <= QUOTA + 4 * MIN_SEGMENT
        elif what == "pin":
            pins[part].append(numbers)
        else:
            sent[part][what, numbers[0]] = numbers[1]
    with hl.open(path, mongo="none") as store:
        for is_kept in (False, True):
            if is_kept:
                store.keep({"max-age": "0s"})
            gone = sum(check(store, part, sent[part], pins[part], killed) for part in PARTS)
            assert gone > 0
        assert store.verify().findings == []


def test_rules_that_are_written_while_it_runs_hold(tmp_path: Path) -> None:
    with store_with(tmp_path / "store") as store:
        robot = Recorded(store, RecorderOptions(reserve_bytes=0))
        robot.speaker.say(CHANNELS["/camera"], payload("/camera", 0))
        with store_with(tmp_path / "store", **{"min-free": "1000TB"}):
            pass
        wait_for(lambda: robot.recorder.look() and robot.said)
        robot.recorder.stop()
    assert "all that is left must stay" in robot.said[0]
    with hl.open(tmp_path / "store", mongo="none") as store:
        assert store.topic("/camera").count() == 1
