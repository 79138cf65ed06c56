"""Half an hour of a robot that is left alone; then every message is accounted for.

It is recorded within a quota, with pins, marks, a contract and a trigger. It is killed twice, its
clock is set, and its disk is full. The robot writes down what it sends before it sends it.
"""

from __future__ import annotations

import errno
import os
import random
import struct
import subprocess
import sys
import time
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.contract import Contract, TopicRules
from hybridlog.follow.child import Trigger
from hybridlog.live import incidents
from hybridlog.live.recorder import Recorder, RecorderOptions
from hybridlog.maintenance.edit import mark_now
from hybridlog.maintenance.retention import MIN_SEGMENT
from hybridlog.maintenance.sizes import disk_bytes
from hybridlog.record.marks import MARKS
from hybridlog_storage.disk import files
from hybridlog_storage.errors import DiskFullError, PayloadError
from hybridlog_storage.messages import Channel, Schema
from tests.live.speaker import Speaker
from tests.live.test_machine_clock import BOOT, NOW, Clock
from tests.live.test_retention import NOISE, store_with
from tests.waiting import wait_for

SECOND = 10**9
FLUSH_S = 0.4
ROOM = 16_384
"""Bytes that a write may still have on the full disk: enough to seal a file."""
SLACK_S = 1.5  # for a machine that has other things to do
BLOB = Schema("a/Blob", "ros1msg", b"uint32 n\nfloat64 x\nbool pressed\nuint8[] data\n")
SIZES = {"/camera": 50_000, "/points": 20_000, "/arm": 0, "/bumper": 0}
EVERY = {"/camera": 100, "/points": 500, "/arm": 50, "/bumper": 10_000}
"""Milliseconds between two messages."""
CHANNELS = {topic: Channel(topic, "ros1", BLOB, {}, has_publish_time=False) for topic in SIZES}
PARTS = ("first", "clock", "full", "box")
"""What is recorded, one after the other: killed, killed after its clock was set, ended by a full
disk, and with a ring."""
RINGS = 8
"""How often a ring fits into its part,"""
SLOWER = 4
"""in which time passes more slowly."""


def ring_s(seconds: float, speed: float) -> float:
    """Seconds of a ring, which goes by the time that passes."""
    return seconds / speed * SLOWER / RINGS


def payload(topic: str, number: int, *, pressed: bool = False) -> bytes:
    size = SIZES[topic]
    first = number * 7919 % (len(NOISE) - size)
    return struct.pack("<Id?I", number, number / 2, pressed, size) + NOISE[first : first + size]


class Robot:
    """Sends messages to a recorder, and writes down each of them before."""

    def __init__(self, path: Path, log: Path, part: str, seconds: float, speed: float) -> None:
        self.path, self.part, self.seconds, self.speed = path, part, seconds, speed
        self.log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self.store = hl.open(path, mongo="none")
        self.speaker = Speaker()
        begin = NOW + PARTS.index(part) * 86_400 * SECOND
        self.clock = Clock(BOOT if part == "clock" else begin)
        self.is_set_to = begin
        self.is_full = False
        contract = Contract({"/points": TopicRules(longest_gap=round(seconds / 20 * SECOND))})
        options = RecorderOptions(
            name=part, reserve_bytes=0, flush_interval_s=FLUSH_S, contract=contract
        )
        if part == "box":
            self.speed = speed / SLOWER
            incidents._LATE_S = 0.1  # type: ignore[misc]
            options = replace(
                options,
                contract=None,
                flush_interval_s=FLUSH_S / 10,
                ring_s=ring_s(seconds, speed),
                triggers=[Trigger.of("/bumper: pressed = true")],
                before_s=seconds / 40,
                after_s=seconds / 40,
            )
        self.recorder = Recorder(self.store, [self.speaker], options, self.say, self.clock)

    def say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def note(self, *words: object) -> None:
        os.write(self.log, (" ".join(map(str, (self.part, *words))) + "\n").encode())

    def send(self, topic: str, number: int, *, pressed: bool = False) -> None:
        self.note(topic, number, self.clock.time, time.time_ns())
        message = payload(topic, number, pressed=pressed)
        self.speaker.say(CHANNELS[topic], message, self.clock.time)

    def pin(self) -> None:
        span = self.clock.time - round(self.seconds / 20 * SECOND), self.clock.time
        with hl.open(self.path, mongo="none") as other:
            other.pin(self.recorder.name, *span, ["/camera"])
        self.note("pin", *span)

    def mark(self) -> None:
        recording = self.recorder._target.id
        mark_now(self.store.directory, recording, self.clock.time, "slipped", {})

    def write(self, do: Any, fd: int, parts: list[memoryview], *where: int) -> int:
        if self.is_full and sum(map(len, parts)) > ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return int(do(fd, parts, *where))

    def run(self) -> None:
        """Go through the part; a part that is to be killed goes on until then."""
        system: Any = files.system
        writev, pwritev = system.writev, system.pwritev
        system.writev = lambda *words: self.write(writev, *words)
        system.pwritev = lambda *words: self.write(pwritev, *words)
        self.recorder.start()
        if self.part == "box":  # a ring waits for its triggers
            wait_for(lambda: self.recorder._follower._task.seen is not None)
        events: list[tuple[float, Any]] = [
            (0.3, self.pin),
            (0.4, self.mark),
            (0.5, lambda: self.send("/bumper", 10**6, pressed=True)),
            (1.0, lambda: print("done", flush=True)),
        ]
        if self.part == "clock":
            events.insert(0, (0.1, self.set_clock))
        if self.part == "full":
            events.insert(-1, (0.9, lambda: setattr(self, "is_full", True)))
        begun, looked, most, step = time.monotonic(), 0.0, 0, 0
        while events or self.part in PARTS[:2]:
            now = time.monotonic()
            passed = step / 1000
            if passed > (now - begun) * self.speed:
                time.sleep(0.001)
                continue
            if events and passed >= events[0][0] * self.seconds:
                events.pop(0)[1]()
            for topic, every in EVERY.items():
                is_silent = topic == "/points" and 0.6 < passed / self.seconds < 0.8
                if step % every == 0 and not is_silent:
                    self.send(topic, step // every)
            step += 10
            self.clock.run(10**7)
            if now - looked > 0.1:
                looked = now
                self.recorder.look()
                if (used := disk_bytes(self.path)) > most:
                    most = used
                    self.note("used", most)
        if self.part == "full":
            wait_for(self.has_ended)
            for number in range(5):
                self.send("/arm", 10**6 + number)
        with suppress(DiskFullError):  # for what can be made again, such as the catalog
            self.recorder.stop()
        self.store.close()

    def has_ended(self) -> bool:
        self.recorder.look()
        return self.recorder.wait(0.1)

    def set_clock(self) -> None:
        self.clock.time = self.is_set_to


def drive(*words: str) -> None:
    path, log, part, seconds, speed = words
    Robot(Path(path), Path(log), part, float(seconds), float(speed)).run()


@dataclass
class Sent:
    """What the robot has written down of a part."""

    messages: dict[tuple[str, int], tuple[int, int]] = field(default_factory=dict)
    pins: list[tuple[int, int]] = field(default_factory=list)
    used: int = 0


def sent_of(log: Path) -> dict[str, Sent]:
    found: dict[str, Sent] = defaultdict(Sent)
    for line in log.read_text().splitlines():
        part, what, *rest = line.split()
        numbers = [*map(int, rest)]
        if what == "pin":
            found[part].pins.append((numbers[0], numbers[1]))
        elif what == "used":
            found[part].used = numbers[0]
        else:
            found[part].messages[what, numbers[0]] = numbers[1], numbers[2]
    return found


def stored_of(store: hl.Store, label: str) -> dict[tuple[str, int], tuple[int, bytes | None]]:
    found: dict[tuple[str, int], tuple[int, bytes | None]] = {}
    for topic in SIZES:
        query = store.query([topic], [label])
        before = len(found)
        for message in query:
            key = topic, message.fields["n"]
            assert key not in found
            assert message.fields["x"] == (key[1] / 2)
            try:
                found[key] = message.log_time_ns, message.raw
            except PayloadError:
                found[key] = message.log_time_ns, None
        assert query.count() == len(found) - before
        assert query.where("x >= 0").count() == query.count()
    return found


def account(
    path: Path, sent: dict[str, Sent], killed: dict[str, int], seconds: float, speed: float
) -> int:
    """Compare what is stored with what was sent; returns how many payloads have expired."""
    expired = 0
    with hl.open(path, mongo="none") as store:
        for part in PARTS:
            messages = sent[part].messages
            (entry,) = store.recordings(part)
            stored = stored_of(store, part)
            for (topic, number), (at, raw) in stored.items():
                assert at == messages[topic, number][0]
                right = payload(topic, number, pressed=(topic, number) == ("/bumper", 10**6))
                assert raw in {None, right}
                expired += raw is None
            for begin, end in sent[part].pins:
                pinned = [k for k, (at, _) in messages.items() if begin <= at < end]
                pinned = [key for key in pinned if key[0] == "/camera"]
                assert pinned
                assert all(stored[key][1] is not None for key in pinned)
            missing = {key: messages[key] for key in messages.keys() - stored.keys()}
            assert missing
            if part in killed:
                assert entry.status == "recovered"
                assert all(
                    killed[part] - at < (FLUSH_S + SLACK_S) * 1e9 for _, at in missing.values()
                )
            elif part == "box":
                (fired,) = [at for (_, n), (at, _) in messages.items() if n == 10**6]
                around = seconds / 40 * SECOND
                near = [key for key, (at, _) in messages.items() if -around <= at - fired <= around]
                assert all(stored[key][1] is not None for key in near)
                end = max(sent_at for _, sent_at in messages.values())
                span = ring_s(seconds, speed) * SECOND
                assert all(end - sent_at > span for _, sent_at in missing.values())
                assert [m["text"] for m in entry.marks if m["tags"].get("cause") != "clock"] == [
                    "slipped",
                    "/bumper: pressed = true",
                ]
            else:
                rows = entry.end["losses"]
                for topic in SIZES:
                    gone = [at for (t, _), (at, _) in missing.items() if t == topic]
                    ours = [row for row in rows if row["topic"] == topic]
                    assert sum(row["count"] for row in ours) == len(gone)
                    assert {row["cause"] for row in ours} <= {"disk"}
                    assert all(any(r["from"] <= at <= r["to"] for r in ours) for at in gone)
            # Of a short part a kill may take all marks: they were not flushed yet.
            if part == "full" or (part in killed and seconds > 100):
                marks = [m.fields for m in store.query([MARKS], [part])]
                causes = Counter(mark["tags"].get("cause", mark["text"]) for mark in marks)
                rows = entry.end["losses"] if part == "full" else ()
                lost = sum(row["count"] for row in rows if row["topic"] == MARKS)
                assert causes["slipped"] + causes["contract"] + lost >= 2
                assert causes["clock"] or part != "clock"
        assert store.verify().findings == []
    return expired


@pytest.mark.parametrize(
    ("seconds", "speed", "quota"),
    [
        # Beside all pins there is room for what triggers have yet to see, on any machine.
        (12, 8, 26_000_000),
        pytest.param(
            450, 12, 100_000_000, marks=[pytest.mark.exhaustive, pytest.mark.timeout(1800)]
        ),
    ],
)
def test_every_message_of_a_robot_is_accounted_for(
    tmp_path: Path, seconds: float, speed: float, quota: int
) -> None:
    path, log = tmp_path / "store", tmp_path / "sent"
    rules: dict[str, Any] = {"topic": {"/points": "1000d"}}
    store_with(path, quota=str(quota), **rules).close()
    killed: dict[str, int] = {}
    for part in PARTS:
        words = map(str, (path, log, part, seconds, speed))
        code = "import sys; from tests.live.test_play import drive; drive(*sys.argv[1:])"
        process = subprocess.Popen(
            [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "done\n"
            if part in PARTS[:2]:
                time.sleep(random.Random(part).uniform(0, 0.5))
                killed[part] = time.time_ns()
                process.kill()
            process.wait()
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
        assert process.returncode == (-9 if part in killed else 0)
    sent = sent_of(log)
    assert account(path, sent, killed, seconds, speed) > 0
    assert max(one.used for one in sent.values()) <= quota + 4 * MIN_SEGMENT
    with hl.open(path, mongo="none") as store:
        store.keep({"max-age": "0s"})
    assert account(path, sent, killed, seconds, speed) > 0
