"""A recorder keeps its store within the rules, loses nothing for it, and leaves pins alone."""

from __future__ import annotations

import random
import signal
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import UNSET

import hybridlog as hl
from hybridlog.live.recorder import Recorder, RecorderOptions
from hybridlog.maintenance.retention import MIN_SEGMENT
from hybridlog.maintenance.sizes import disk_bytes
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.index_state import NOTHING, IndexState
from hybridlog_storage.settings import write_settings
from tests import places
from tests.indexed import documents_of
from tests.live.speaker import Speaker
from tests.some import each
from tests.test_faults import kill_mongod

CAMERA = Channel("/camera", "ros1", Schema("a/Image", "ros1msg", b"uint32 n\nuint8[] data\n"), {})
ARM = Channel("/arm", "ros1", Schema("a/Arm", "ros1msg", b"uint32 n\nfloat64 x\n"), {})
NOISE = random.Random(5).randbytes(1 << 20)
SIZE = 50_000
PINNED = range(20, 30)
"""Images that are pinned as soon as they are there."""


def image(number: int) -> bytes:
    first = number * 7919 % (len(NOISE) - SIZE)
    return struct.pack("<II", number, SIZE) + NOISE[first : first + SIZE]


def store_with(path: Path, **rules: str) -> hl.Store:
    """A new store with rules of retention, without MongoDB."""
    with hl.open(path, mongo="none", create=True) as store:
        settings = store.directory.settings
    write_settings(path, replace(settings, retention=rules))
    return hl.open(path, mongo="none")


def play(path: Path, quota: int, rate: int, seconds: float) -> None:
    """Record images of so many bytes a second; prints the most that the store took, and counts."""
    most = 0
    with store_with(path, quota=str(quota)) as store:
        speaker = Speaker()
        recorder = Recorder(store, [speaker], RecorderOptions(reserve_bytes=0), lambda _: None)
        recorder.start()
        begun, number, pinned, looked = time.monotonic(), 0, 0, 0.0
        print("running", flush=True)
        while (now := time.monotonic() - begun) < seconds:
            if number * SIZE < now * rate:
                speaker.say(CAMERA, image(number), number * 10**9)
                speaker.say(ARM, struct.pack("<Id", number, number / 2), number * 10**9 + 1)
                number += 1
            else:
                time.sleep(0.002)
            if not pinned and number == PINNED[-1] + 10:
                with hl.open(path, mongo="none") as other:
                    span = PINNED[0] * 10**9, (PINNED[-1] + 1) * 10**9
                    other.pin(recorder.name, *span, ["/camera"])
                pinned = number
                print("pinned", flush=True)
            if now - looked > 0.1:
                looked, most = now, max(most, disk_bytes(path))
                recorder.look()
        (report,) = recorder.stop()
        assert report.entry.end["losses"] == []
    print(most, number, flush=True)


def check(path: Path, sent: int | None) -> int:
    """Check that every message is counted, and that what is pinned is there; returns the count."""
    with hl.open(path, mongo="none") as store:
        numbers = [message.fields["n"] for message in store.topic("/arm")]
        assert numbers == [*range(len(numbers) if sent is None else sent)]
        assert store.topic("/arm").where("x < 10").count() == min(20, len(numbers))
        images: dict[int, bytes | None] = {}
        for message in store.topic("/camera"):
            number = message.log_time_ns // 10**9
            try:
                images[number] = message.raw
            except PayloadError:
                images[number] = None
        assert [*images] == [*range(len(images))]
        assert store.topic("/camera").count() == len(images)
        assert all(raw is None or raw == image(number) for number, raw in images.items())
        assert all(images[number] is not None for number in PINNED)
        assert store.verify().findings == []
    return sum(raw is None for raw in images.values())


@pytest.mark.parametrize(
    ("quota", "rate", "seconds"),
    [
        (24_000_000, 6_000_000, 9),
        pytest.param(2_000_000_000, 50_000_000, 600, marks=pytest.mark.exhaustive),
    ],
)
def test_the_quota_holds_while_recording_and_nothing_is_lost(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], quota: int, rate: int, seconds: float
) -> None:
    play(tmp_path / "store", quota, rate, seconds)
    *_, line = capfd.readouterr().out.splitlines()
    most, sent = map(int, line.split())
    segment = max(quota // 50, MIN_SEGMENT)
    assert sent * SIZE > 1.5 * quota  # or nothing had to go
    assert most <= quota + 2 * segment
    assert check(tmp_path / "store", sent) > 0
    sizes = [p.stat().st_size for p in places.files(tmp_path / "store")]
    assert max(sizes) < 2 * segment


def has_expired(folder: Path) -> bool:
    """True once a rule was applied to a segment of a recording."""
    manifest = places.read_in(folder)
    return manifest is not None and any(log.retained is not UNSET for log in manifest.logs.values())


PLAY = """
import sys
from pathlib import Path
from tests.live.test_retention import play
play(Path(sys.argv[1]), 12_000_000, 6_000_000, 60)
"""


@pytest.mark.parametrize("seed", [0, 1, *each(*range(2, 60))])
def test_a_kill_costs_no_pinned_byte_and_no_count(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "store"
    process = subprocess.Popen(
        [sys.executable, "-c", PLAY, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        assert [process.stdout.readline() for _ in range(2)] == ["running\n", "pinned\n"]
        (folder,) = places.folders(path)
        # From the first expiry on, at any time.
        while not has_expired(folder):
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(random.Random(seed).uniform(0, 1))
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    gone = check(path, None)
    assert gone > 0
    with hl.open(path, mongo="none") as store:
        store.keep({"max-age": "0s", "quota": "1MB"})
    assert check(path, None) > gone


def test_rules_that_are_written_while_it_runs_hold(tmp_path: Path) -> None:
    said: list[str] = []
    with store_with(tmp_path / "store") as store:
        speaker = Speaker()
        options = RecorderOptions(reserve_bytes=0)
        recorder = Recorder(store, [speaker], options, said.append)
        recorder.start()
        speaker.say(CAMERA, image(0))
        with store_with(tmp_path / "store", **{"min-free": "1000TB"}):
            pass
        until = time.monotonic() + 60
        while not said and time.monotonic() < until:
            time.sleep(0.05)
        recorder.stop()
    assert "all that is left must stay" in said[0]
    with hl.open(tmp_path / "store", mongo="none") as store:
        assert store.topic("/camera").count() == 1


@pytest.mark.mongo("embedded")
def test_documents_that_mongodb_loses_after_their_messages_expired_are_made_again(
    tmp_path: Path,
) -> None:
    path = tmp_path / "store"
    with hl.open(path, create=True) as store:
        store.directory.change_settings(retention={"quota": "12MB"})
        speaker = Speaker()
        recorder = Recorder(store, [speaker], RecorderOptions(reserve_bytes=0), lambda _: None)
        recorder.start()
        (folder,) = places.folders(path)
        sent, until = 0, time.monotonic() + 60
        while not has_expired(folder):
            assert time.monotonic() < until
            for _ in range(10):
                speaker.say(CAMERA, image(sent), sent * 10**9)
                sent += 1
            time.sleep(0.1)
        database = store.connect()
        while recorder.look().lag:  # or what is sent now would say anew what is there
            assert time.monotonic() < until
            time.sleep(0.1)
        IndexState(database).put_through(folder.name[-16:], NOTHING)
        database.checkpoint()
        kill_mongod(path)
        failures: set[str] = set()
        while not any("have expired since" in one for one in failures):
            assert time.monotonic() < until
            speaker.say(CAMERA, image(sent), sent * 10**9)
            sent += 1
            time.sleep(0.2)
            failures.add(recorder.look().index_failure)
        (report,) = recorder.stop()
        assert report.entry.end["losses"] == []
    with hl.open(path) as store:
        assert store.topic("/camera").count() == sent
        assert len(documents_of(store, "/camera")) == sent
        assert store.verify().findings == []
