"""Rehearsals against the recorder's own snapshots of the same messages."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

import hybridlog as hl
from hybridlog.live import rehearsal
from hybridlog.live.clocks import MachineClock
from hybridlog.live.rehearsal import snapshot_spans
from hybridlog.live.snapshots import SnapshotOptions, Snapshots, Trigger
from hybridlog.record.losses import Ledger
from hybridlog_storage.errors import TimeError, TopicError, UsageError, WhereError
from hybridlog_storage.messages import Channel
from tests.calls import Calls
from tests.cli.within import answer as run

MS = 10**6
BASE = 1_748_937_600 * 10**9
LATCHED = {"latching": "1", "callerid": "/a"}
TOPICS: dict[str, tuple[str, dict[str, str]]] = {
    "n": ("/n", {}),
    "pad": ("/pad", {}),
    "map a": ("/map", LATCHED),
    "map b": ("/map", LATCHED | {"callerid": "/b"}),
}
Sent = tuple[str, int, bytes]


def said(seed: int) -> list[Sent]:
    rng = random.Random(seed)
    found = []
    now = BASE + seed * 10**12
    for _ in range(400):
        now += rng.choice([1, 5, 20, 90]) * MS + rng.randrange(1000)
        name = rng.choices(list(TOPICS), [10, 20, 1, 1])[0]
        content = json.dumps({"v": rng.randrange(100), "pad": "-" * rng.randrange(300)}).encode()
        found.append((name, now, b"{" if rng.random() < 0.02 else content))
    return found


SAID = {"one": said(1), "two": said(2)}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    path = tmp_path_factory.mktemp("rehearsal")
    with hl.open(path / "store", create=True) as opened:
        for name, messages in SAID.items():
            with (path / f"{name}.mcap").open("wb") as file:
                writer = Writer(file)
                writer.start("ros1")
                schema = writer.register_schema("Any", "jsonschema", b"{}")
                channels = {
                    key: writer.register_channel(topic, "json", schema, metadata)
                    for key, (topic, metadata) in TOPICS.items()
                }
                for key, at, payload in messages:
                    writer.add_message(channels[key], at, payload, at)
                writer.finish()
            opened.record(path / f"{name}.mcap")
        yield opened


class Taken:
    """Takes the messages of one snapshot, as a recording does."""

    label, filled, failure = "snap", 0.0, None

    def __init__(self) -> None:
        self.cut_off: dict[str, int] = {}
        self.ledger = Ledger()
        self.payloads: list[bytes] = []

    def write(self, channel: Channel, payload: bytes, **_: Any) -> bool:
        self.payloads.append(payload)
        return True

    @property
    def stored(self) -> tuple[int, int]:
        return len(self.payloads), sum(map(len, self.payloads))

    def close(self) -> Any:
        return None


def recorded(trigger: str, name: str, before_s: float, after_s: float) -> list[tuple[int, int]]:
    """Messages and bytes of each snapshot that the recorder makes."""
    taken: list[Taken] = []

    def start(_: str) -> Any:
        taken.append(Taken())
        return taken[-1]

    options = SnapshotOptions(3600, before_s, after_s, (Trigger.of(trigger),))
    snapshots = Snapshots(
        options, 1 << 30, start, lambda _: None, lambda _: None, clock=MachineClock()
    )
    channels = {
        key: Channel(topic, "json", None, metadata) for key, (topic, metadata) in TOPICS.items()
    }
    for key, at, payload in SAID[name]:
        snapshots.write(channels[key], payload, log_time=at)
        if snapshots._dumping is not None:
            snapshots._dumping.result()
    snapshots.close()
    return [one.stored for one in taken]


@pytest.fixture(params=["whole", "in blocks"])
def blocks(request: pytest.FixtureRequest, calls: Calls) -> None:
    """Sizes of messages come all at once, or a few at a time."""
    if request.param == "whole":
        return

    def cut(found: Iterator[rehearsal._Sizes], *_: Any) -> Iterator[rehearsal._Sizes]:
        for one in found:
            for begin in range(0, len(one.time), 3):
                yield rehearsal._Sizes(*(column[begin : begin + 3] for column in one))

    calls.change(rehearsal, "_from_table", cut)


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize("trigger", ["/n: v >= 80", "/n: v == 7", "/map", "/n: v > 100"])
@pytest.mark.parametrize(("before", "after"), [(1, 0.5), (0, 0), (5, 0), (0.05, 0.2), (0, 2)])
def test_a_rehearsal_keeps_what_the_recorder_would(
    store: hl.Store, trigger: str, before: float, after: float
) -> None:
    found = store.rehearse(trigger, before=f"{before}s", after=f"{after}s")
    want = {name: recorded(trigger, name, before, after) for name in SAID}
    assert found.recordings == 2
    labels = {summary.id: summary.label for summary in store.summaries()}
    for name, snapshots in want.items():
        mine = [one.messages for one in found.snapshots if labels[one.recording] == name]
        assert mine == [messages for messages, _ in snapshots]
    assert found.payload_bytes == sum(size for rows in want.values() for _, size in rows)
    assert found.messages == sum(count for rows in want.values() for count, _ in rows)
    if trigger != "/map":
        assert found.fired == store.topic("n").where(trigger.removeprefix("/n: ")).count()
    assert found.stored_bytes == sum(len(m[2]) for rows in SAID.values() for m in rows)


def naive_spans(times: list[int], before: int, after: int) -> list[tuple[int, int]]:
    """The rules of the recorder, message by message."""
    found: list[list[int]] = []
    until = -1
    for now in times:
        if now >= until:
            found.append([max(now - before, 0), 0])
        until = max(until, now + after)
        found[-1][1] = max(found[-1][1], until, now + 1)
    return [(begin, end) for begin, end in found]


@given(st.lists(st.integers(0, 50), max_size=20).map(sorted), st.integers(0, 9), st.integers(0, 9))
def test_spans_of_snapshots(times: list[int], before: int, after: int) -> None:
    found = snapshot_spans(np.array(times, np.int64), before, after)
    assert [tuple(row) for row in found.tolist()] == naive_spans(times, before, after)


def test_only_what_is_recent(store: hl.Store) -> None:
    later = SAID["two"][200][1]
    found = store.rehearse("/n: v >= 80", since=later, before="1s")
    assert found.recordings == 1
    query = store.topic("n").where("v >= 80").between(later, None)
    assert found.fired == query.count() > 0
    now = store.rehearse("/n: v >= 80", since="1d")
    assert (now.recordings, now.fired, len(now.snapshots), now.payload_bytes) == (0, 0, 0, 0)
    ago = f"{(time.time_ns() - later) // 10**9 + 5}s"
    assert store.rehearse("/n: v >= 80", since=ago, before="1s").fired >= found.fired
    one = store.rehearse("n: v >= 80", recordings=["one"])
    assert one.recordings == 1


def test_what_is_refused(store: hl.Store) -> None:
    with pytest.raises(TopicError, match="No topic of the store matches"):
        store.rehearse("/nothing: v > 1")
    with pytest.raises(UsageError, match="TOPIC: PREDICATE"):
        store.rehearse(": v > 1")
    with pytest.raises(WhereError):
        store.rehearse("/n: v >")
    with pytest.raises(TimeError):
        store.rehearse("/n", since="lately")
    with pytest.raises(TimeError):
        store.rehearse("/n", before="soon")
    with pytest.raises(TopicError):
        store.rehearse("/n", recordings=["three"])


def test_the_command(store: hl.Store) -> None:
    path = store.directory.path
    found = store.rehearse("/n: v >= 80", before="1s", after="500ms")
    asked = ("intervals", "--rehearse", "/n: v >= 80", "--before", "1s", "--after", "500ms")
    rows = run(*asked, "--json", store=path).json
    assert (rows["fired"], rows["payload_bytes"]) == (found.fired, found.payload_bytes)
    assert len(rows["snapshots"]) == len(found.snapshots)
    shown = run(*asked, store=path)
    assert f"fired       {found.fired} times" in shown.lines
    assert "of payload" not in shown.err
    none = run(*asked, "--last", "1h", store=path)
    assert "No recording is from that time." in none.err
    run(*asked, "name", store=path, code=2)
    run("intervals", "n", "--before", "1s", store=path, code=2)
    run("trigger", store=path, code=2)
