"""The harness: what is counted, what is dropped, and that nobody is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from benchmarks import usage
from benchmarks.backends.base import Backend
from benchmarks.backends.nothing import Nothing
from benchmarks.harness.run import Outcome, run
from benchmarks.loads.base import PAYLOADS, Load
from benchmarks.side import MARK
from hybridlog_storage.messages import Channel

# Backends of the tests. The logger, another process, imports them from here.


class Digests(Nothing):
    """Notes what it is given: channel, log time and a digest of the payload."""

    def open(self, channels: Sequence[Channel]) -> None:
        super().open(channels)
        self.seen: list[tuple[int, int, str]] = []

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        super().insert(channel, log_time, payload)
        assert isinstance(payload, bytes)
        self.seen.append((channel, log_time, sha256(payload).hexdigest()))

    def finish(self) -> None:
        super().finish()
        (self.directory.parent / "seen.json").write_text(json.dumps(self.seen))


class Slow(Nothing):
    """The first topic takes 20 ms a message, the others nothing."""

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        if channel == 0:
            time.sleep(0.02)
        super().insert(channel, log_time, payload)


class Forgetful(Nothing):
    """Keeps one message of each topic less than it was given."""

    def counts(self) -> Mapping[str, int]:
        return {topic: count - 1 for topic, count in super().counts().items()}


class Served(Nothing):
    """Has a server, which works a little and leaves the session as servers do."""

    def open(self, channels: Sequence[Channel]) -> None:
        super().open(channels)
        work = "import time; sum(range(10**6)); b = bytearray(30 << 20); time.sleep(600)"
        self.server = subprocess.Popen([sys.executable, "-c", work], start_new_session=True)

    def processes(self) -> Sequence[int]:
        return (self.server.pid,)

    def close(self) -> None:
        self.server.terminate()
        self.server.wait()


def make_load(
    directory: Path,
    *,
    messages: int = 30,
) -> Load:
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


Runner = Callable[..., Outcome]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Runner]:
    """Runs a backend in a directory of its own; looks afterwards whether anybody is left."""

    def go(backend: type[Backend], load: Load) -> Outcome:
        directory = tmp_path / "run"
        directory.mkdir()
        return run(load, backend, directory)

    yield go
    assert usage.marked(MARK, str((tmp_path / "run").resolve())) == []


def test_every_message_arrives_as_it_is(tmp_path: Path, start: Runner) -> None:
    load = make_load(tmp_path / "load")
    before = time.time_ns()
    found = start(Digests, load)
    after = time.time_ns()
    assert (found.status, found.reason) == ("ok", "")
    seen = json.loads((tmp_path / "run" / "seen.json").read_text())
    content = load.payloads.read_bytes()
    sent = [
        (int(c), sha256(content[o : o + n]).hexdigest())
        for c, o, n in zip(load.channel, load.offset, load.length, strict=True)
    ]
    for channel in range(3):
        assert [d for c, _, d in seen if c == channel] == [d for c, d in sent if c == channel]
    assert all(before < log_time < after for _, log_time, _ in seen)


def test_values_of_a_good_run(tmp_path: Path, start: Runner) -> None:
    load = make_load(tmp_path / "load")
    values = start(Served, load).values
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values["published"] == values["persisted"] == len(load) == 90
    assert (values["dropped"], values["errors"], values["lost"]) == (0, 0, 0)
    assert values["published_bytes"] == values["persisted_bytes"] == load.payload_bytes
    assert values["topics"] == {f"/topic/{n}": [30, 0, 30] for n in range(3)}
    assert values["due_s"] == load.duration_s
    assert load.duration_s <= values["publish_s"] <= values["wall_s"] < load.duration_s + 2
    assert 0 < values["cpu_s"] < 2
    assert values["server_peak_rss"] > 30 << 20
    assert 5 << 20 < values["peak_rss"] < 200 << 20
    assert values["disk_bytes"] > 0
    assert 1 < values["spin_ms"] < 2000


def test_a_full_queue_drops_and_only_its_own_messages(tmp_path: Path, start: Runner) -> None:
    load = make_load(tmp_path / "load", messages=60)
    values = start(Slow, load).values
    published, dropped, persisted = values["topics"]["/topic/0"]
    # 60 messages in 0.3 s: about 15 are taken meanwhile, ten wait at the end.
    assert published == 60
    assert 10 < dropped < 45
    assert persisted == published - dropped
    assert values["topics"]["/topic/1"] == values["topics"]["/topic/2"] == [60, 0, 60]
    assert values["published"] == values["persisted"] + values["dropped"]
    assert values["dropped"] == dropped
    # The publisher does not wait for who is slow; the end does.
    assert values["publish_s"] < load.duration_s + 0.3
    assert values["wall_s"] > 0.02 * persisted
    lengths = load.length[load.channel == 0]
    expected = load.payload_bytes - dropped * lengths.mean()
    assert values["persisted_bytes"] == pytest.approx(expected, abs=1)


def test_lost_messages_are_seen_by_who_counts(tmp_path: Path, start: Runner) -> None:
    values = start(Forgetful, make_load(tmp_path / "load")).values
    assert (values["persisted"], values["lost"], values["dropped"]) == (87, 3, 0)
