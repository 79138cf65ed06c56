"""The catalog, in a real MongoDB and against the same questions asked of a list."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog_storage.catalog import (
    Catalog,
    ChannelStats,
    ChannelTotals,
    ChunkEntry,
    RecordingEntry,
    channel_entry,
    schema_hash,
)
from hybridlog_storage.database import Database
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongod import EmbeddedMongod


@pytest.fixture(scope="module")
def mongod(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    base = tmp_path_factory.mktemp("catalog")
    with EmbeddedMongod(base / "mongod", linger_s=0) as running:
        yield running.start()


@pytest.fixture
def database(mongod: str, request: pytest.FixtureRequest) -> Iterator[Database]:
    with Database.connect(mongod, f"test{abs(hash(request.node.name))}") as connected:
        yield connected
        connected.drop_all()


@pytest.fixture
def catalog(database: Database) -> Catalog:
    made = Catalog(database)
    made.prepare()
    return made


def stats_of(rng: random.Random) -> ChannelStats:
    times = sorted(rng.randrange(100) for _ in range(2))
    sent = sorted(rng.randrange(100) for _ in range(2))
    stamps = sorted(rng.randrange(100) for _ in range(2))
    found = ChannelStats(
        messages=rng.randrange(1, 9),
        payload_bytes=rng.randrange(100),
        unreadable=rng.randrange(3),
        first=times[0],
        last=times[1],
        longest=times[1] - times[0],
    )
    if rng.random() < 0.8:
        found.first_publish, found.last_publish = sent
    if rng.random() < 0.8:
        found.first_stamp, found.last_stamp = stamps
        found.stamped, found.skew_sum, found.skew_min, found.skew_max = 2, 7.0, -3, 9
    return found


def entries(count: int, seed: int = 1) -> list[ChunkEntry]:
    rng = random.Random(seed)
    found = []
    for number in range(count):
        stats = {c: stats_of(rng) for c in rng.sample(range(1, 6), rng.randrange(1, 4))}
        times = [t for s in stats.values() for t in (s.first, s.last) if t is not None]
        found.append(
            ChunkEntry(
                f"run-{number % 2}", number % 3, number * 100, 90, 10, min(times), max(times), stats
            )
        )
    return found


def places(chunks: Sequence[ChunkEntry]) -> set[tuple[int, int]]:
    return {(c.segment, c.offset) for c in chunks}


def test_chunks_come_back(catalog: Catalog) -> None:
    written = entries(40)
    for entry in written:
        catalog.put_chunks([entry])
    found = [c for r in ("run-0", "run-1") for c in catalog.chunks(r)]
    assert sorted(found, key=lambda c: c.offset) == written
    catalog.put_chunks([replace(written[0], length=5)])
    again = {c.offset: c for c in catalog.chunks("run-0")}
    assert again[0].length == 5
    assert len(again) == 20


@pytest.mark.parametrize("clock", ["log", "publish", "header"])
def test_chunks_of_a_time_range(catalog: Catalog, clock: str) -> None:
    written = entries(60)
    for entry in written:
        catalog.put_chunks([entry])
    mine = [c for c in written if c.recording == "run-1"]
    suffix = {"log": "", "publish": "_publish", "header": "_stamp"}[clock]
    rng = random.Random(2)
    for _ in range(60):
        begin = rng.randrange(-5, 100)
        end = begin + rng.choice([1, 5, 30])
        channels = rng.sample(range(1, 6), rng.randrange(1, 4))
        parts = [(chunk, chunk.stats[c]) for chunk in mine for c in channels if c in chunk.stats]
        spans = [(c, getattr(s, f"first{suffix}"), getattr(s, f"last{suffix}")) for c, s in parts]
        want = places([c for c, a, b in spans if a is not None and a < end and b >= begin])
        got = catalog.chunks("run-1", channels, (begin, end), clock)
        assert places(got) == want
        longest = max(c.stats[i].longest for c in mine for i in channels if i in c.stats)
        bounded = catalog.chunks("run-1", channels, (begin, end), clock, longest)
        assert places(bounded) == want
        every = catalog.chunks("run-1", channels)
        assert places(every) == places([c for c in mine if c.stats.keys() & set(channels)])


def recording(name: str, first: int | None) -> RecordingEntry:
    channel = Channel("/ä", "cdr", Schema("x/msg/Y", "ros2msg", b"int8 x"), {"a": "b.c", "$d": ""})
    made = channel_entry(3, channel, "no reason")
    if first is not None:
        made.stats = ChannelStats(messages=2, first=first, last=first + 5, skew_sum=0.5)
    return RecordingEntry(
        id=name,
        key=2**32 - 1,
        name=f"{name} name",
        tags={"a.b": "c", "$x": "y", "": "z"},
        source={"path": "/x", "bytes": 2**40, "fingerprint": "f"},
        created=2**62,
        status="complete",
        end={"losses": []},
        channels=[made],
        stored_bytes=2**50,
        segments=1,
        chunks=2,
    )


def test_recordings_come_back_in_the_order_of_time(catalog: Catalog) -> None:
    written = [recording("c", 5), recording("a", 9), recording("b", None), recording("d", 5)]
    for entry in written:
        catalog.put_recording(entry)
    assert [r.id for r in catalog.recordings()] == ["c", "d", "a", "b"]
    assert catalog.recordings()[0] == written[0]
    assert written[0].span == (5, 10)
    assert written[0].messages == 2
    assert written[2].span is None
    changed = replace(written[0], status="recovered", tags={})
    catalog.put_recording(changed)
    assert catalog.recordings()[0] == changed


def test_schemas(catalog: Catalog) -> None:
    one, other = Schema("a/B", "ros1msg", b"\xff\0int8 x"), Schema("a/B", "ros1msg", b"")
    catalog.put_schemas(Channel(topic, "ros1", s) for topic, s in [("a", one), ("b", other)])
    catalog.put_schemas([Channel("c", "ros1", one), Channel("d", "json", None)])
    catalog.put_schemas([])
    digests = [schema_hash(one), schema_hash(other)]
    assert digests[0] != digests[1]
    assert catalog.schemas(set(digests)) == {digests[0]: one, digests[1]: other}
    assert catalog.schemas([digests[1], "nothing"]) == {digests[1]: other}
    assert catalog.schemas([]) == {}


def test_hashes_of_schemas_do_not_run_together() -> None:
    schemas = [
        Schema("ab", "c", b"d"), Schema("a", "bc", b"d"), Schema("a", "b", b"cd"),
        Schema("", "ab", b"cd"), Schema("ab", "", b"cd"), Schema("abcd", "", b""),
    ]  # fmt: skip
    for one, other in combinations(schemas, 2):
        assert schema_hash(one) != schema_hash(other)


def test_losses_are_replaced(catalog: Catalog, database: Database) -> None:
    catalog.put_losses("r", [{"cause": "a", "count": 1}, {"cause": "b", "count": None}])
    catalog.put_losses("other", [{"cause": "c"}])
    catalog.put_losses("r", [{"cause": "d"}])
    found = database.find("hybridlog.losses", {})
    kept = sorted((d["rec"], d["_id"]["n"], d["cause"]) for d in found)
    assert kept == [("other", 0, "c"), ("r", 0, "d")]


def test_a_recording_is_removed_without_a_trace(catalog: Catalog, database: Database) -> None:
    for name in ("r", "r2"):
        catalog.put_recording(recording(name, 1))
        catalog.put_losses(name, [{"cause": "a"}])
        catalog.put_chunks([replace(entries(1)[0], recording=name)])
        database.ensure_collection("topic")
        document = {"_id": name.encode(), "_meta": {"rec": name}}
        database.replace("topic", {"_id": name.encode()}, document)
    before = {c: database.count(c, {}) for c in database.list_collections()}
    catalog.remove_recording("r", ["topic"])
    after = {c: database.count(c, {}) for c in database.list_collections()}
    assert after == {c: n // 2 if n == 2 else n for c, n in before.items()}
    assert [r.id for r in catalog.recordings()] == ["r2"]
    assert catalog.chunks("r") == []
    assert len(catalog.chunks("r2")) == 1


@given(st.lists(st.integers(0, 2**32), min_size=1, max_size=12), st.randoms(use_true_random=False))
def test_statistics_add_up_in_any_order(seeds: list[int], rng: random.Random) -> None:
    parts = [stats_of(random.Random(seed)) for seed in seeds]
    whole = ChannelStats()
    for part in parts:
        whole.add(part)
    shuffled = ChannelStats()
    for part in rng.sample(parts, len(parts)):
        shuffled.add(part)
    assert whole == shuffled
    for name, value in asdict(whole).items():
        values = [v for p in parts if (v := getattr(p, name)) is not None]
        if name.startswith("first") or name == "skew_min":
            assert value == min(values, default=None)
        elif name.startswith("last") or name == "skew_max":
            assert value == max(values, default=None)
        elif name == "longest":
            assert value == max(values)
        else:
            assert value == sum(values)


@given(
    st.lists(
        st.dictionaries(st.integers(0, 3), st.integers(-(2**62), 2**62), min_size=1), max_size=9
    ),
    st.randoms(use_true_random=False),
)
def test_totals_are_the_same_in_any_order(skews: list[dict[int, int]], rng: random.Random) -> None:
    """To the last bit, though skews of senders without a clock are beyond what floats hold."""
    chunks = [
        ChunkEntry(
            "r", 1, number, 1, 1, 0, 0, {c: replace(ONE, skew_sum=float(s)) for c, s in of.items()}
        )
        for number, of in enumerate(skews)
    ]
    whole = ChannelTotals.of(chunks)
    shuffled = ChannelTotals.of(rng.sample(chunks, len(chunks)))
    for channel in range(4):
        own = [float(of[channel]) for of in skews if channel in of]
        found = whole.stats(channel)
        assert found == shuffled.stats(channel)
        assert found.skew_sum == math.fsum(own)
        assert found.messages == len(own)
        assert found == (replace(ONE, messages=len(own), skew_sum=math.fsum(own)) if own else NONE)


ONE = ChannelStats(messages=1, first=5, last=5, stamped=0)
NONE = ChannelStats()
