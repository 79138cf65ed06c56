"""The harness: what is counted, what is dropped, and that nobody is left behind."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from benchmarks import usage
from benchmarks.backends.base import Backend, BackendFailedError, BackendMissingError
from benchmarks.backends.nothing import Nothing
from benchmarks.harness.counters import Counters
from benchmarks.harness.run import Outcome, Setting, run
from benchmarks.harness.subscribers import Subscribers
from benchmarks.loads.base import PAYLOADS, Load
from benchmarks.side import MARK
from hybridlog_storage.messages import Channel
from tests.imports import ROOT
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")

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


class Flaky(Nothing):
    """Every third message is refused."""

    def open(self, channels: Sequence[Channel]) -> None:
        super().open(channels)
        self.calls = [0] * len(channels)

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        self.calls[channel] += 1
        if self.calls[channel] % 3 == 0:
            raise ValueError("the third one")
        super().insert(channel, log_time, payload)


class Dying(Nothing):
    """Gives up after 20 messages of a topic; what it had is there."""

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        if self._counts[channel] == 20:
            self.finish()
            raise BackendFailedError("the disk is full")
        super().insert(channel, log_time, payload)


class Crashing(Nothing):
    """Takes its process with it."""

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        if self._counts[channel] == 20:
            os.kill(os.getpid(), signal.SIGKILL)
        super().insert(channel, log_time, payload)


class Missing(Nothing):
    @classmethod
    def check(cls) -> None:
        raise BackendMissingError("no such system; install it")


class Buggy(Nothing):
    def open(self, channels: Sequence[Channel]) -> None:
        raise TypeError("a mistake of its author")


class Unfinished(Nothing):
    def finish(self) -> None:
        raise BackendFailedError("cannot be synced")


class Forgetful(Nothing):
    """Keeps one message of each topic less than it was given."""

    def counts(self) -> Mapping[str, int]:
        return {topic: count - 1 for topic, count in super().counts().items()}


class Stopped(Nothing):
    """Refuses a message while the collector looks at what is older than the run."""

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        if gc.get_freeze_count() < 1000:
            raise ValueError("all objects of the modules may be looked at")
        super().insert(channel, log_time, payload)


class Liar(Nothing):
    """Says that it has more than it was given."""

    def counts(self) -> Mapping[str, int]:
        return {topic: count + 1 for topic, count in super().counts().items()}


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


class Leaving(Served):
    """Forgets its server, which does not listen to a first request to end, either."""

    def open(self, channels: Sequence[Channel]) -> None:
        Nothing.open(self, channels)
        work = "import signal, time; signal.signal(15, signal.SIG_IGN); time.sleep(600)"
        self.server = subprocess.Popen([sys.executable, "-c", work], start_new_session=True)

    def close(self) -> None:
        self.server.returncode = 0  # no warning that it still runs


class Hanging(Served):
    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        time.sleep(600)


# Loads.


def make_load(
    directory: Path,
    *,
    topics: int = 3,
    messages: int = 30,
    rate: float = 200.0,
    names: Sequence[str] | None = None,
) -> Load:
    """Messages of different lengths, one topic after the other, each at `rate` Hz."""
    directory.mkdir(parents=True)
    rng = np.random.default_rng(1)
    rows = topics * messages
    length = rng.integers(1, 3000, rows)
    offset = np.cumsum(length) - length
    (directory / PAYLOADS).write_bytes(rng.bytes(int(length.sum())))
    due = np.rint(np.arange(rows) * 1e9 / rate / topics).astype(np.int64)
    names = names or [f"/topic/{n}" for n in range(topics)]
    load = Load(
        name="test",
        seed=1,
        channels=tuple(Channel(name, "ros1", None) for name in names),
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

    def go(backend: type[Backend], load: Load | None = None, **setting: Any) -> Outcome:
        directory = tmp_path / "run"
        directory.mkdir()
        return run(load or make_load(tmp_path / "load"), backend, directory, Setting(**setting))

    yield go
    assert usage.marked(MARK, str((tmp_path / "run").resolve())) == []


# What is counted.


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
    assert 0 <= values["depth_p50"] <= values["depth_p99"] <= values["depth_max"] <= 10
    assert 0 <= values["late_ms_p50"] <= values["late_ms_p99"] <= values["late_ms_max"]
    assert 0 < values["cpu_s"] < 2
    assert values["server_peak_rss"] > 30 << 20
    assert 5 << 20 < values["peak_rss"] < 200 << 20
    assert values["disk_bytes"] > 0
    assert 1 < values["spin_ms"] < 2000
    assert values["other_cpu_s"] >= 0
    assert values["steal_s"] >= 0


@pytest.mark.parametrize("more", [0, 128 << 20])
def test_payloads_lie_in_memory_or_are_mapped_where_they_are_too_many(
    tmp_path: Path, more: int
) -> None:
    load = make_load(tmp_path / "load")
    expected = load.payloads.read_bytes()
    os.truncate(load.payloads, len(expected) + more)
    counters = Counters(tmp_path / "counters", len(load.channels))
    subscribers = Subscribers(load, Nothing(tmp_path), counters)
    assert bytes(subscribers._payloads[: len(expected)]) == expected
    assert len(subscribers._payloads) == len(expected) + more
    held = subscribers.payload_rss()
    assert held == usage.mapped_rss(load.payloads.resolve()) if more else held == len(expected)
    assert held >= len(expected)


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
    assert values["depth_max"] == 10
    # The publisher does not wait for who is slow; the end does.
    assert values["publish_s"] < load.duration_s + 0.3
    assert values["wall_s"] > 0.02 * persisted
    lengths = load.length[load.channel == 0]
    expected = load.payload_bytes - dropped * lengths.mean()
    assert values["persisted_bytes"] == pytest.approx(expected, abs=1)


def test_longer_queues_drop_less(tmp_path: Path, start: Runner) -> None:
    found = start(Slow, make_load(tmp_path / "load", messages=60), queue=60)
    assert found.values["dropped"] == 0
    assert found.values["depth_max"] > 10


def test_inserts_that_raise_are_counted(start: Runner) -> None:
    found = start(Flaky)
    assert found.status == "ok"
    values = found.values
    assert (values["errors"], values["persisted"], values["lost"]) == (30, 60, 0)
    assert values["insert_error"] == "ValueError: the third one"


def test_the_collector_spares_what_is_older_than_the_run(start: Runner) -> None:
    found = start(Stopped)
    assert (found.status, found.values["errors"]) == ("ok", 0)


def test_lost_messages_are_seen_by_who_counts(start: Runner) -> None:
    values = start(Forgetful).values
    assert (values["persisted"], values["lost"], values["dropped"]) == (87, 3, 0)


def test_a_backend_cannot_have_more_than_it_got(start: Runner) -> None:
    found = start(Liar)
    assert found.status == "failed"
    assert "more than" in found.reason


def test_channels_of_one_topic_are_counted_together(tmp_path: Path, start: Runner) -> None:
    load = make_load(tmp_path / "load", names=["/a", "/b", "/a"])
    topics = start(Nothing, load).values["topics"]
    assert {topic: published for topic, (published, _, _) in topics.items()} == {"/a": 60, "/b": 30}
    assert all(published == dropped + kept for published, dropped, kept in topics.values())


def test_speed(tmp_path: Path, start: Runner) -> None:
    load = make_load(tmp_path / "load", rate=20)
    values = start(Nothing, load, speed=10).values
    assert values["due_s"] == pytest.approx(load.duration_s / 10)
    assert load.duration_s / 10 <= values["publish_s"] < load.duration_s / 2
    assert values["persisted"] == 90


def test_nonsense_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="speed"):
        Setting(speed=0)
    load = make_load(tmp_path / "load", messages=0)
    with pytest.raises(ValueError, match="no messages"):
        run(load, Nothing, tmp_path)


# What goes wrong.


def test_a_missing_backend(start: Runner) -> None:
    found = start(Missing)
    assert found == Outcome("missing", {}, "no such system; install it")


def test_a_backend_that_gives_up(tmp_path: Path, start: Runner) -> None:
    found = start(Dying, make_load(tmp_path / "load", messages=400))
    assert (found.status, found.reason) == ("failed", "the disk is full")
    values = found.values
    assert 20 < values["published"] < 1200
    assert values["persisted"] <= 60
    assert values["publish_s"] > 0
    assert values["cpu_s"] > 0


def test_a_backend_that_crashes(tmp_path: Path, start: Runner) -> None:
    found = start(Crashing, make_load(tmp_path / "load", messages=400))
    assert found.status == "failed"
    assert "SIGKILL" in found.reason
    assert 20 < found.values["published"] < 1200
    assert "persisted" not in found.values


def test_a_backend_with_a_mistake(start: Runner) -> None:
    found = start(Buggy)
    assert found.status == "failed"
    assert "TypeError: a mistake of its author" in found.reason


def test_a_backend_that_cannot_finish(start: Runner) -> None:
    found = start(Unfinished)
    assert (found.status, found.reason) == ("failed", "cannot be synced")
    assert found.values["published"] == 90
    assert found.values["wall_s"] > 0.1
    assert found.values["late_ms_p99"] >= 0


def test_a_run_that_takes_too_long(start: Runner) -> None:
    found = start(Hanging, timeout_s=3)
    assert found.status == "failed"
    assert "3 s" in found.reason
    assert found.values["published"] == 90
    # One is being inserted, ten wait, for each topic.
    assert found.values["dropped"] == 3 * (30 - 11)


def test_servers_that_stay_are_ended(start: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (("_LEAVE_S", 0.3), ("_GRACE_S", 0.3)):
        monkeypatch.setattr(f"benchmarks.side.{name}", seconds)
    assert start(Leaving).status == "ok"


_ONE_RUN = """
import sys
from pathlib import Path
from benchmarks.harness.run import run
from benchmarks.loads.base import Load
from benchmarks.studies.runs import run_directory
from tests.benchmarks.test_harness import Served
from tests.waiting import wait_for
with run_directory(Path(sys.argv[1])) as directory:
    run(Load.open(Path(sys.argv[2])), Served, directory)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_who_is_interrupted_leaves_nobody(tmp_path: Path, number: signal.Signals) -> None:
    make_load(tmp_path / "load", messages=6000)
    work = tmp_path / "work"
    work.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-c", _ONE_RUN, str(work), str(tmp_path / "load")],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    below = psutil.Process(process.pid)
    wait_for(lambda: len(_runs(work)) == 1 and _published(_runs(work)[0]) > 0)
    started = below.children(recursive=True)
    assert len(started) >= 3  # the logger, the publisher, the server
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    wait_for(lambda: not any(child.is_running() for child in started))
    if number == signal.SIGINT:
        assert "KeyboardInterrupt" in said
        assert _runs(work) == []


def _runs(work: Path) -> list[Path]:
    return list((work / "runs").glob("*"))


def _published(directory: Path) -> int:
    path = directory / "counters"
    return sum(Counters(path).published()) if path.is_file() and path.stat().st_size else 0


# The parts.


def test_counters_are_shared_through_the_file(tmp_path: Path) -> None:
    one = Counters(tmp_path / "counters", 3)
    other = Counters(tmp_path / "counters")
    one.sent[2], one.dropped[0], one.taken[1], one.errors[2] = 2**40, 5, 6, 7
    assert other.published() == [5, 0, 2**40]
    assert (other.taken[1], other.errors[2]) == (6, 7)
    assert len(other.sent) == len(other.errors) == 3


def test_usage_of_a_process_and_its_children() -> None:
    work = (
        "import os, subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; "
        "b = bytearray(64 << 20); sum(range(3 * 10**6)); print(1, flush=True); time.sleep(60)'])\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", work], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        known = {process.pid, *(p.pid for p in psutil.Process(process.pid).children())}
        found = usage.with_children([process.pid])
        seconds, memory = usage.cpu_s(found), usage.peak_rss(found)
        for pid in known:
            os.kill(pid, signal.SIGKILL)
    assert found == known
    assert len(found) == 2
    assert 0.01 < seconds < 10
    assert 64 << 20 < memory < 200 << 20
    assert usage.with_children([process.pid]) == set()
    assert usage.cpu_s([process.pid]) == 0


def test_disk_bytes_counts_no_holes(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "full").write_bytes(os.urandom(100_000))
    with (tmp_path / "sparse").open("wb") as stream:
        stream.truncate(10**9)
    (tmp_path / "dangling").symlink_to(tmp_path / "nosuch")
    assert 100_000 <= usage.disk_bytes(tmp_path) < 200_000


def test_nothing_counts_what_it_was_given(tmp_path: Path) -> None:
    backend = Nothing(tmp_path)
    backend.open([Channel("/a", "ros1", None), Channel("/b", "ros1", None)])
    for channel in (0, 1, 1):
        backend.insert(channel, 1, b"x")
    backend.finish()
    backend.close()
    assert Nothing(tmp_path).counts() == {"/a": 1, "/b": 2}
    (tmp_path / "empty").mkdir()
    with pytest.raises(BackendFailedError, match="did not finish"):
        Nothing(tmp_path / "empty").counts()
