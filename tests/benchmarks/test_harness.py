"""The harness: what is counted, what is dropped, and that nobody is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from benchmarks import usage
from benchmarks.backends.files import Nothing
from benchmarks.harness.run import run
from benchmarks.loads.base import PAYLOADS, Load
from benchmarks.side import MARK
from hybridlog_storage.messages import Channel

# Backends of the tests. The logger, another process, imports them from here.


class Odd(Nothing):
    """Slow with its first topic, forgets a message of each, has a server that leaves the session.

    Notes what it is given: channel, log time and a digest of the payload.
    """

    def open(self, channels: Sequence[Channel]) -> None:
        super().open(channels)
        self.seen: list[tuple[int, int, str]] = []
        work = "import time; sum(range(10**6)); b = bytearray(30 << 20); time.sleep(600)"
        self.server = subprocess.Popen([sys.executable, "-c", work], start_new_session=True)

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        if channel == 0:
            time.sleep(0.02)
        super().insert(channel, log_time, payload)
        assert isinstance(payload, bytes)
        self.seen.append((channel, log_time, sha256(payload).hexdigest()))

    def finish(self) -> None:
        super().finish()
        (self.directory.parent / "seen.json").write_text(json.dumps(self.seen))

    def counts(self) -> Mapping[str, int]:
        return {topic: count - 1 for topic, count in super().counts().items()}

    def processes(self) -> Sequence[int]:
        return (self.server.pid,)

    def close(self) -> None:
        self.server.terminate()
        self.server.wait()


def make_load(directory: Path, messages: int) -> Load:
    """Messages of different lengths, one topic after the other, each at `rate` Hz."""
    directory.mkdir(parents=True)
    rng = np.random.default_rng(1)
    topics, rate = 3, 200.0
    rows = topics * messages
    length = rng.integers(1, 3000, rows)
    offset = np.cumsum(length) - length
    (directory / PAYLOADS).write_bytes(rng.bytes(int(length.sum())))
    due = np.rint(np.arange(rows) * 1e9 / rate / topics).astype(np.int64)
    load = Load(
        seed=1,
        channels=tuple(Channel(f"/topic/{n}", "ros1", None) for n in range(topics)),
        channel=(np.arange(rows) % topics).astype(np.int32),
        due=due,
        log_time=due,
        offset=offset,
        length=length,
        payloads=directory / PAYLOADS,
    )
    load.save(directory)
    return load


def test_what_is_counted_and_what_is_dropped(tmp_path: Path) -> None:
    load = make_load(tmp_path / "load", messages=60)
    directory = tmp_path / "run"
    directory.mkdir()
    before = time.time_ns()
    found = run(load, Odd, directory)
    after = time.time_ns()
    assert (found.status, found.reason) == ("ok", "")
    assert usage.marked(MARK, str(directory.resolve())) == []
    # Every message arrives as it is.
    seen = json.loads((directory / "seen.json").read_text())
    content = load.payloads.read_bytes()
    sent = [
        (int(c), sha256(content[o : o + n]).hexdigest())
        for c, o, n in zip(load.channel, load.offset, load.length, strict=True)
    ]
    for channel in (1, 2):
        assert [d for c, _, d in seen if c == channel] == [d for c, d in sent if c == channel]
    assert {d for c, _, d in seen if c == 0} < {d for c, d in sent if c == 0}
    assert all(before < log_time < after for _, log_time, _ in seen)
    # A full queue drops its own messages only: 60 in 0.3 s, of which about 15 are taken meanwhile,
    # and ten wait at the end. What the backend has not counted is lost.
    values = found.values
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    published, dropped, persisted = values["topics"]["/topic/0"]
    assert published == 60
    assert 10 < dropped < 45
    assert persisted == published - dropped - 1
    assert values["topics"]["/topic/1"] == values["topics"]["/topic/2"] == [60, 0, 59]
    assert (values["published"], values["dropped"]) == (len(load), dropped) == (180, dropped)
    assert (values["errors"], values["lost"], values["persisted"]) == (0, 3, 177 - dropped)
    assert values["published_bytes"] == load.payload_bytes
    means = [load.length[load.channel == c].mean() for c in range(3)]
    expected = persisted * means[0] + 59 * (means[1] + means[2])
    assert values["persisted_bytes"] == pytest.approx(expected, abs=1)
    # The publisher does not wait for who is slow; the end does.
    assert values["due_s"] == load.duration_s
    assert load.duration_s <= values["publish_s"] < load.duration_s + 0.3
    assert 0.02 * persisted < values["wall_s"] < load.duration_s + 3
    assert 0 < values["cpu_s"] < 3
    assert values["server_peak_rss"] > 30 << 20
    assert 5 << 20 < values["peak_rss"] < 200 << 20
    assert values["disk_bytes"] > 0
    assert 1 < values["spin_ms"] < 2000
