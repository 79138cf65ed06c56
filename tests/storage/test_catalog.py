"""The catalog: against the same questions asked of a list, and with its bytes changed."""

from __future__ import annotations

import json
import os
import random
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import asdict, replace

from hybridlog.entries import summary_of, topic_types
from hybridlog.index.indexing import stamp_stats
from hybridlog_storage.catalog import (
    Catalog,
    ChannelStats,
    RecordingEntry,
    RecordingSummary,
    channel_entry,
)
from hybridlog_storage.cells import CATALOG, Cells, put
from hybridlog_storage.manifest import Manifest, Mark, Note, Source
from hybridlog_storage.messages import Channel, Schema, schema_hash
from tests.limits import Limit

STORE = "5" * 32
CHANNELS = range(1, 6)
SCHEMAS = {
    c: Schema(f"pkg/msg/T{c}", "ros2msg", b"int8 x" * c) if c != 2 else None for c in CHANNELS
}


# What is put into it.


def channel(number: int) -> Channel:
    return Channel(
        f"/ä{number}",
        "cdr",
        SCHEMAS[number],
        {"a": "b.c", "$d": ""},
    )


def stats(rng: random.Random) -> ChannelStats:
    """What decoding may find out of a channel."""
    stamps = sorted(rng.choices(range(100), k=2))
    return ChannelStats(
        unreadable=rng.randrange(3),
        first_stamp=stamps[0],
        last_stamp=stamps[1],
        stamped=rng.randrange(1, 5),
        skew_sum=float(rng.randrange(10**9) << 20),
        skew_min=-3,
        skew_max=9,
    )


def ids_in(catalog: Catalog) -> set[str]:
    """Ids of the recordings that have a summary."""
    return {one.id for one in catalog.summaries()}


class Model:
    """A recording, and what decoding its segments has found out."""

    def __init__(self, seed: int, name: str = "run näme", segments: int = 3) -> None:
        rng = random.Random(seed)
        self.id = f"20261128-run-{rng.getrandbits(64):016x}"
        self.decoded = [
            {c: stats(rng) for c in sorted(rng.sample(CHANNELS, 3))} for _ in range(segments)
        ]
        self.entry = RecordingEntry(
            Manifest(
                self.id,
                name,
                2**62,
                tags={"a.b": "c", "$x": "y", "": "z"},
                source=Source(path="/x", bytes=2**40, fingerprint="f"),
                notes=(Note(5, "ö"),),
                marks=(Mark(f"{1:016x}", 1, "m"),),
            ),
            "complete",
            losses=[{"cause": "queue", "count": None}],
            channels=[channel_entry(c, channel(c)) for c in CHANNELS],
            stored_bytes=2**50,
            segments=segments,
            spans=[(n, n, n + 9) for n in range(segments)],
            digests={str(n): f"{rng.getrandbits(256):064x}" for n in range(segments)},
        )
        for entry in self.entry.channels:
            entry.stats = replace(stats(rng), messages=7, payload_bytes=9, first=0, last=99)

    @property
    def summary(self) -> RecordingSummary:
        return summary_of(self.entry, f"outside of {self.id}")

    def put(self, catalog: Catalog, *, decoded: bool = True) -> None:
        catalog.put([(self.summary, topic_types(self.entry))])
        for number, found in enumerate(self.decoded if decoded else ()):
            catalog.put_decoded(self.id, number, self.entry.digests[str(number)], found)


def catalog_in(folder: Path, store: str = STORE) -> Catalog:
    return Catalog(folder, Cells(folder / CATALOG, store))


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with closing(catalog_in(tmp_path)) as made:
        yield made


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(1)


# Questions.


def decoded_of(catalog: Catalog, model: Model) -> list[dict[int, ChannelStats] | None]:
    """What a catalog says of the decoding of each segment."""
    digests = {int(number): digest for number, digest in model.entry.digests.items()}
    found = catalog.decoded(model.id, digests)
    return [found.get(number) for number in digests]


def test_what_was_decoded_of_other_bytes_is_not_believed(catalog: Catalog, model: Model) -> None:
    model.put(catalog, decoded=False)
    decoded = model.decoded[0]
    catalog.put_decoded(model.id, 0, "of another", decoded)
    assert decoded_of(catalog, model)[0] is None
    catalog.put_decoded(model.id, 0, model.entry.digests["0"], decoded)
    assert decoded_of(catalog, model)[0] == decoded


def test_damage_is_replaced(catalog: Catalog) -> None:
    catalog.put_damage("r", {(0, 1): "ä", (2, 3): "b"})
    catalog.put_damage("other", {(9, 9): "c"})
    assert catalog.damage("r") == {(0, 1): "ä", (2, 3): "b"}
    catalog.put_damage("r", {(2, 3): "d"})
    assert catalog.damage("r") == {(2, 3): "d"}
    catalog.put_damage("r", {})
    assert (catalog.damage("r"), catalog.damage("other")) == ({}, {(9, 9): "c"})


def test_hashes_of_schemas_do_not_run_together() -> None:
    schemas = [
        Schema("ab", "c", b"d"), Schema("a", "bc", b"d"), Schema("a", "b", b"cd"),
        Schema("", "ab", b"cd"), Schema("ab", "", b"cd"), Schema("abcd", "", b""),
    ]  # fmt: skip
    for one, other in combinations(schemas, 2):
        assert schema_hash(one) != schema_hash(other)


def test_a_recording_is_removed_without_a_trace(catalog: Catalog, model: Model) -> None:
    other = Model(2, "other")
    for one in (model, other):
        one.put(catalog)
        catalog.put_damage(one.id, {(0, 0): "x"})
    catalog.remove(model.id)
    assert ids_in(catalog) == {other.id}
    assert catalog.damage(model.id) == {}
    assert decoded_of(catalog, model) == [None] * 3
    assert decoded_of(catalog, other) == other.decoded
    catalog.remove(other.id)
    assert catalog.summaries() == []


@given(st.lists(st.integers(0, 2**32), min_size=1, max_size=12), st.randoms(use_true_random=False))
def test_statistics_add_up_in_any_order(seeds: list[int], rng: random.Random) -> None:
    parts = []
    for seed in seeds:
        part = replace(stats(random.Random(seed)), messages=seed, skew_sum=float(seed % 1000))
        parts.append(part if seed % 2 else replace(part, first_stamp=None, skew_min=None))
    whole, shuffled = ChannelStats(), ChannelStats()
    for part in parts:
        whole.add(part)
    for part in rng.sample(parts, len(parts)):
        shuffled.add(part)
    assert whole == shuffled
    for name, value in asdict(whole).items():
        values = [v for p in parts if (v := getattr(p, name)) is not None]
        if name.startswith("first") or name == "skew_min":
            assert value == min(values, default=None)
        elif name.startswith("last") or name == "skew_max":
            assert value == max(values, default=None)
        else:
            assert value == sum(values)


@given(st.lists(st.integers(-(2**62), 2**62 - 1), min_size=1, max_size=9))
def test_skews_add_up_exactly(skews: list[int]) -> None:
    """Those of senders without a clock are beyond what floats hold one by one."""
    found = stamp_stats(np.array(skews, np.int64) + 7, np.full(len(skews), 7))
    assert (found.skew_sum, found.stamped, found.unset) == (sum(skews), len(skews), 0)
    assert (found.skew_min, found.skew_max) == (min(skews), max(skews))


# Whatever happens to the file.


class Truth:
    """A small catalog, and everything that it may say."""

    def __init__(self, folder: Path) -> None:
        self.models = [Model(n, f"run{n}", segments=2) for n in range(3)]
        self.damage = {(0, 1): "unreadable", (1, 0): "gone"}
        with closing(catalog_in(folder)) as made:
            self.fill(made)
        self.content = (folder / CATALOG).read_bytes()

    def fill(self, catalog: Catalog) -> None:
        for model in self.models:
            model.put(catalog)
            catalog.put_damage(model.id, self.damage)
            catalog.put_indexed([model.id], "an index")

    def check(self, catalog: Catalog) -> bool:
        """That nothing that it says is wrong; returns whether it says all."""
        summaries = {one.id: one for one in catalog.summaries()}
        complete = len(summaries) == len(self.models)
        for model in self.models:
            damage = catalog.damage(model.id)
            assert damage in ({}, self.damage)
            decoded = decoded_of(catalog, model)
            assert all(
                one in (None, want) for one, want in zip(decoded, model.decoded, strict=True)
            )
            complete &= bool(damage) and None not in decoded
            if model.id in summaries:
                found = summaries.pop(model.id)
                assert found._replace(indexed_by="") == model.summary
                assert {*catalog.topics(found.topics)} == topic_types(model.entry)
        assert not summaries
        for one in catalog.summaries():  # or unreadable chunks would be forgotten
            assert one.indexed_by == ("an index" if catalog.damage(one.id) else "")
        return complete


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return Truth(tmp_path_factory.mktemp("truth"))


def made_again(truth: Truth, folder: Path) -> None:
    """Nothing wrong is said of a file that was changed, and it can be made again."""
    with closing(catalog_in(folder)) as opened:
        truth.check(opened)
        truth.fill(opened)
        assert truth.check(opened)
    with closing(catalog_in(folder)) as opened:
        assert truth.check(opened)
    assert [path.name for path in folder.iterdir()] == [CATALOG]


def test_whatever_bytes_change_nothing_wrong_is_said(truth: Truth, tmp_path: Path) -> None:
    rng = random.Random(6)
    for turn in range(60):
        spot = turn if turn < 40 else rng.randrange(len(truth.content))
        data = bytearray(truth.content)
        for place in range(spot, spot + rng.choice([1, 1, 4, 100])):
            data[place % len(data)] ^= rng.choice([1, 1 << rng.randrange(8), 0xFF])
        (tmp_path / CATALOG).write_bytes(data)
        try:
            made_again(truth, tmp_path)
        except Exception as error:
            raise AssertionError(f"byte {spot} of {len(data)}") from error


def in_sql(text: str) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        with closing(sqlite3.connect(path)) as opened:
            opened.executescript(text)

    return change


def in_bytes(change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(change(path.read_bytes()))


WAYS: dict[str, Callable[[Path], object]] = {
    "deleted": Path.unlink,
    "empty": in_bytes(lambda _: b""),
    "text": in_bytes(lambda _: b"what somebody has written\n" * 50),
    "cut": in_bytes(lambda data: data[: len(data) // 2]),
    "longer": in_bytes(lambda data: data + b"x" * 5000),
    "zeros": in_bytes(lambda data: data[:4096] + bytes(4096) + data[8192:]),
    "pages exchanged": in_bytes(lambda d: d[:4096] + d[8192:12288] + d[4096:8192] + d[12288:]),
    "a folder": lambda path: (path.unlink(), path.mkdir(), (path / "x").touch()),
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "a journal": lambda path: path.with_name(f"{path.name}-journal").write_bytes(b"x" * 9999),
    "write-ahead": in_sql("PRAGMA journal_mode = WAL; DELETE FROM cells WHERE number = 1"),
    "another table": in_sql("CREATE TABLE more(x)"),
    "a trigger": in_sql(
        "CREATE TRIGGER t AFTER INSERT ON cells BEGIN DELETE FROM cells WHERE kind = 'summary'; END"
    ),
    "a view": in_sql("ALTER TABLE cells RENAME TO x; CREATE VIEW cells AS SELECT * FROM x"),
    "some rows": in_sql("DELETE FROM cells WHERE length(body) % 2"),
    "other types": in_sql("UPDATE cells SET body = 7, crc = 'x' WHERE number = 1"),
    "no text": in_sql("UPDATE cells SET key = CAST(x'ff00' || key AS TEXT) WHERE kind = 'summary'"),
}


@pytest.mark.parametrize("way", WAYS)
def test_whatever_happens_to_the_file_costs_time_only(
    truth: Truth, tmp_path: Path, way: str
) -> None:
    """Before it is opened, and while it is open."""
    path = tmp_path / CATALOG
    path.write_bytes(truth.content)
    WAYS[way](path)
    made_again(truth, tmp_path)
    path.write_bytes(truth.content)
    with closing(catalog_in(tmp_path)) as opened:
        assert truth.check(opened)
        WAYS[way](path)
        truth.check(opened)
        truth.fill(opened)
        assert truth.check(opened) or way == "a trigger"
    made_again(truth, tmp_path)


def changed_anywhere(value: Any) -> Iterator[Any]:
    """The value with one of the values in it replaced by one of another type, or gone."""
    yield from (None, 7, "x", [], {}, 1.5, [[]], 10**30)
    if not isinstance(value, dict | list):
        return
    items = [*(value.items() if isinstance(value, dict) else enumerate(value))]
    for at, (place, one) in enumerate(items):
        for other in ([], *([(place, it)] for it in changed_anywhere(one))):
            found = [*items[:at], *other, *items[at + 1 :]]
            yield dict(found) if isinstance(value, dict) else [it for _, it in found]


@pytest.mark.parametrize("kind", ["summary", "index", "topics", "decoded"])
def test_a_forged_cell_is_no_error(truth: Truth, tmp_path: Path, kind: str) -> None:
    """Its checksum is right. Of types that do not fit nothing is believed."""
    recording = truth.models[0].id
    path = tmp_path / CATALOG
    path.write_bytes(truth.content)
    with closing(sqlite3.connect(path)) as made:
        query = "SELECT key, body FROM cells WHERE kind = ? ORDER BY key = ? DESC, number"
        key, body = made.execute(query, (kind, recording)).fetchone()
    texts = (json.dumps(one).encode() for one in changed_anywhere(json.loads(body)))
    bodies = [b"", b"[" * 100_000, b"\xff", b'["\\udcff"]', *some_of(texts, 150)]
    for forged in bodies:
        with closing(sqlite3.connect(path)) as made, made:
            made.execute(*put(kind, key, forged))
        with closing(catalog_in(tmp_path)) as opened:
            known = {one.id: one for one in opened.summaries()}
            for one in known.values():
                assert opened.topics(one.topics)
                assert one.span is None or all(type(time) is int for time in one.span)
                assert [type(value) for value in one if value is not None] == [
                    type(value)
                    for value, has in zip(truth.models[0].summary, one, strict=True)
                    if has is not None
                ]
            assert known.keys() <= {model.id for model in truth.models}
            opened.damage(recording)
            for one in decoded_of(opened, truth.models[0]):
                assert all(type(stats) is ChannelStats for stats in (one or {}).values())


def some_of(texts: Iterator[bytes], count: int) -> list[bytes]:
    everything = [*texts]
    return random.Random(7).sample(everything, min(count, len(everything)))


def test_what_another_store_has_is_not_believed(tmp_path: Path, model: Model) -> None:
    with closing(catalog_in(tmp_path)) as made:
        model.put(made)
    with closing(catalog_in(tmp_path, "6" * 32)) as other:
        assert ids_in(other) == set()
        another = Model(2, "another")
        another.put(other)
        assert ids_in(other) == {another.id}


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Another process writes, and does not end."""
    hold = (
        "import sqlite3, sys; held = sqlite3.connect(sys.argv[1]);"
        "held.execute('BEGIN EXCLUSIVE'); print('held', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(folder / CATALOG)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        try:
            yield
        finally:
            process.communicate("\n")


@contextmanager
def full(catalog: Catalog) -> Iterator[None]:
    """No room on the disk."""
    opened = catalog._cells._use()
    opened.execute("PRAGMA max_page_count = 1")
    yield


@pytest.mark.parametrize("trouble", ["locked", "full"])
def test_what_cannot_be_written_answers_here(
    tmp_path: Path, model: Model, limit: Limit, trouble: str
) -> None:
    """And is made again by others."""
    limit(catalog_busy_s=0.05)
    others = [Model(number, f"run{number}" * 2000) for number in (2, 3, 4)]
    with closing(catalog_in(tmp_path)) as made:
        model.put(made)
        with locked(tmp_path) if trouble == "locked" else full(made):
            begun = time.monotonic()
            for other in others:
                other.put(made)
                assert decoded_of(made, other) == other.decoded
            assert time.monotonic() - begun < 3
            with closing(catalog_in(tmp_path)) as beside:
                assert ids_in(beside) == ({model.id} if trouble == "full" else set())
        assert ids_in(made) == {one.id for one in others}
    with closing(catalog_in(tmp_path)) as same:
        assert ids_in(same) == {model.id}


# Several at once.


def test_two_that_have_it_open_see_what_the_other_does(tmp_path: Path, model: Model) -> None:
    with closing(catalog_in(tmp_path)) as one, closing(catalog_in(tmp_path)) as other:
        model.put(one)
        assert ids_in(other) == {model.id}
        assert decoded_of(other, model) == model.decoded
        other.remove(model.id)
        assert ids_in(one) == set()
        model.put(other)
        (tmp_path / CATALOG).unlink()
        assert ids_in(other) == {model.id}
