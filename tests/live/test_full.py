"""A recorder on a small disk that another program fills: it goes on as long as anything may go.

A file system of 270 MB is filled to the last byte and emptied, the recorder is killed twice, and
started below its reserve. Then every message is accounted for."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.live.recorder import Recorder, RecorderOptions, make_room
from hybridlog_storage.errors import DiskFullError, PayloadError
from tests.live.speaker import Speaker
from tests.live.test_play import CHANNELS, payload
from tests.live.test_retention import store_with

FLUSH_S = 0.3


SLACK_S = 2.0


RESERVE = 10 << 20


QUOTA = 200_000_000


TOPICS = {"/camera": 1, "/points": 3, "/arm": 1}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """An ext4 of 270 MB."""
    image, place = tmp_path / "image", tmp_path / "disk"
    place.mkdir()
    with image.open("wb") as file:
        file.truncate(270 << 20)
    try:
        subprocess.run(["mkfs.ext4", "-q", "-m", "0", "-F", image], check=True)
        subprocess.run(["mount", "-o", "loop", image, place], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this machine mounts nothing")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def drive(path: str, log: str, name: str, pause: str) -> None:
    """Record until nobody wants more; each message is written down before it is sent."""
    sent = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    with hl.open(path, mongo="none") as store:
        options = RecorderOptions(name, reserve_bytes=RESERVE, flush_interval_s=FLUSH_S)
        options = replace(options, settings=replace(options.settings, segment_size=4 << 20))
        make_room(store, options.reserve_bytes)
        speaker = Speaker()
        recorder = Recorder(store, [speaker], options, lambda text: print(text, file=sys.stderr))
        recorder.start()
        print("begun", flush=True)
        os.set_blocking(0, False)
        step = 0
        while not recorder.wait(float(pause)):
            with suppress(BlockingIOError):
                os.read(0, 1)
                break
            for topic, every in TOPICS.items():
                if step % every == 0:
                    now, number = time.time_ns(), step // every
                    os.write(sent, f"{name} {topic} {number} {now}\n".encode())
                    speaker.say(CHANNELS[topic], payload(topic, number), now)
            step += 1
            if step % 20 == 0:
                recorder.look()
        print(recorder.reason, file=sys.stderr, flush=True)
        with suppress(DiskFullError):
            recorder.stop()


def fill(path: Path) -> None:
    """Take all that is free."""
    with path.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(1 << 20)):
            pass


def begin(store: Path, log: Path, name: str, pause: float = 0.005) -> subprocess.Popen[str]:
    code = "import sys; from tests.live.test_full import drive; drive(*sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(store), str(log), name, str(pause)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    return process


def stop(process: subprocess.Popen[str]) -> None:
    assert process.poll() is None  # it went on
    process.communicate(".", 60)
    assert process.returncode == 0


@pytest.mark.exhaustive
def test_a_recorder_outlives_a_disk_that_is_filled(disk: Path, tmp_path: Path) -> None:
    store, log, filler = disk / "store", tmp_path / "sent", disk / "filler"
    store_with(store, quota=str(QUOTA)).close()
    killed: dict[str, int] = {}
    names = [f"part{number}" for number in range(4)]
    for number, name in enumerate(names):
        process = begin(store, log, name)
        time.sleep(12 if number == 0 else 2)
        if number == 0:
            with hl.open(store, mongo="none") as opened:
                opened.pin(name, "+1s", "+3s", ["/camera"])
        fill(filler)  # before the next one starts, too
        time.sleep(4)
        if number in {0, 1}:
            killed[name] = time.time_ns()
            process.kill()
            process.communicate()
        else:
            filler.unlink()
            time.sleep(1)
            stop(process)
    sent: dict[tuple[str, str, int], int] = {}
    for line in log.read_text().splitlines():
        name, topic, number_, at = line.split()
        sent[name, topic, int(number_)] = int(at)
    gone = 0
    with hl.open(store, mongo="none") as opened:
        for name in names:
            (entry,) = opened.recordings(name)
            losses = entry.end.get("losses", ())
            for topic in TOPICS:
                own = {n: at for (r, t, n), at in sent.items() if (r, t) == (name, topic)}
                begun = min(own.values())
                for message in opened.query([topic], [name]):
                    number = message.fields["n"]
                    at = own.pop(number)
                    assert at == message.log_time_ns
                    try:
                        assert message.raw == payload(topic, number)
                    except PayloadError:
                        gone += 1
                        pinned = begun + 10**9 <= at < begun + 3 * 10**9
                        assert (name, topic, pinned) != (names[0], "/camera", True)
                told = sum(row["count"] or 0 for row in losses if row["topic"] == topic)
                if name in killed:
                    own = {
                        n: at
                        for n, at in own.items()
                        if at < killed[name] - (FLUSH_S + SLACK_S) * 1e9
                    }
                assert told >= len(own), (name, topic, told, len(own))
        assert gone
        assert opened.verify().findings == []
