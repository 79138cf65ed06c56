"""A recorder that is killed under load: what was flushed is there, byte for byte."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog_storage.errors import HeldError
from hybridlog_storage.messages import Channel, Schema
from tests.some import each

FLUSH_S = 0.4
SLACK_S = 1.5  # for a machine that has other things to do
TOPICS = 6

LOAD = """
import sys, time
import hybridlog as hl
from tests.live.test_killed import channels, payload
with hl.open(sys.argv[1], create=True) as store:
    recording = store.start("load", flush_interval_s=float(sys.argv[2]))
    topics = channels()
    print("running", flush=True)
    for number in range(10**9):
        recording.write(topics[number % len(topics)], payload(number), sequence=number)
        if number % 20 == 0:
            time.sleep(0.005)
"""


def channels() -> list[Channel]:
    schema = Schema("test_msgs/Blob", "ros1msg", b"uint8[] data\n")
    return [Channel(f"/blob{n}", "ros1", schema, {}, False) for n in range(TOPICS)]


def payload(number: int) -> bytes:
    """A message that says its number in every byte; sizes of every kind of chunk."""
    size = (0, 12, 700, 5000, 90_000, 1_200_000)[number % TOPICS]
    content = (number * 2654435761 % (1 << 32)).to_bytes(4, "little") * (size // 4)
    return len(content).to_bytes(4, "little") + content


@pytest.mark.parametrize("seed", [0, 1, *each(2, 3, 4)])
def test_a_kill_costs_no_more_than_the_flush_interval(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "store"
    process = subprocess.Popen(
        [sys.executable, "-c", LOAD, str(path), str(FLUSH_S)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "running\n"
        time.sleep(random.Random(seed).uniform(0, 2.5))
    finally:
        os.kill(process.pid, signal.SIGKILL)
        killed = time.time_ns()
        process.communicate()
    with hl.open(path) as store:
        (recording,) = store.recordings()
        assert recording.status == "recovered"
        found: dict[int, bytes] = {}
        latest = 0
        for message in store.all_topics() if recording.messages else ():
            found[message.sequence] = message.raw
            latest = max(latest, message.log_time_ns)
        for number, raw in found.items():
            assert raw == payload(number), number
        if found:
            assert killed - latest < (FLUSH_S + SLACK_S) * 1e9
            # What lies further back than the flush interval is all there.
            times = {m.sequence: m.log_time_ns for m in store.all_topics()}
            flushed = [n for n, t in times.items() if killed - t > (FLUSH_S + SLACK_S) * 1e9]
            if flushed:
                assert set(range(max(flushed) + 1)) <= found.keys()
        assert store.verify().findings == []


def test_a_killed_recording_is_not_said_to_go_on(tmp_path: Path) -> None:
    path = tmp_path / "store"
    process = subprocess.Popen(
        [sys.executable, "-c", LOAD, str(path), "0.05"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "running\n"
        before = hl.open(path)
        while not before.summaries()[0].messages:
            time.sleep(0.02)
        assert [entry.status for entry in before.recordings()] == ["open"]
        with pytest.raises(HeldError, match=f"is being written by process {process.pid} "):
            before.remove("load")
    finally:
        process.kill()
        process.communicate()
    with before:
        # Another process is about to recover it, so nobody else can.
        with before.directory.writing(before.entry("load").id), hl.open(path) as after:
            for store in (before, after):
                assert [one.status for one in store.summaries()] == ["unfinished"]
                assert [entry.status for entry in store.recordings()] == ["unfinished"]
                assert store.recordings()[0].messages > 0
        with hl.open(path) as after:
            for store in (after, before):
                assert [entry.status for entry in store.recordings()] == ["recovered"]
