"""The catalog: against the same questions asked of a list, and with its bytes changed."""

from __future__ import annotations

import math
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.entries import summary_of, topic_types
from hybridlog.query.chunk_columns import ChunkColumns
from hybridlog_storage import catalog as module
from hybridlog_storage.catalog import (
    CATALOG,
    Catalog,
    ChannelStats,
    ChunkEntry,
    Described,
    RecordingEntry,
    channel_entry,
    channel_totals,
    schema_hash,
    stamps_of,
)
from hybridlog_storage.errors import CatalogError, DiskFullError, StoreError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.chunk_table import CHUNK, OTHER, PART, ChunkTable
from tests.imports import ROOT
from tests.storage.chunk_entries import chunk_entries

STORE = "5" * 32
CHANNELS = range(1, 6)
SILENT = 4
"""The channel that tells no publish times."""
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
        has_publish_time=number != SILENT,
    )


def segment(rng: random.Random, chunks: int) -> tuple[ChunkTable, list[dict[int, ChannelStats]]]:
    """A chunk table, and what each of its chunks holds, by channel."""
    rows, parts, told = [], [], []
    at = 20
    for _ in range(chunks):
        stats = {}
        for c in sorted(rng.sample(CHANNELS, rng.randrange(1, 4))):
            times, sent, stamps = (sorted(rng.choices(range(100), k=2)) for _ in range(3))
            found = ChannelStats(
                messages=rng.randrange(1, 9),
                payload_bytes=rng.randrange(100),
                unreadable=rng.randrange(3),
                first=times[0],
                last=times[1],
                longest=times[1] - times[0],
            )
            parts.append((c, found.messages, found.payload_bytes, *times, *sent))
            if c != SILENT:
                found.first_publish, found.last_publish = sent
            if rng.random() < 0.7:
                found.first_stamp, found.last_stamp = stamps
                found.stamped = rng.randrange(1, 5)
                found.skew_sum, found.skew_min, found.skew_max = rng.random() * 1e18, -3, 9
            stats[c] = found
        first = min(s.first for s in stats.values() if s.first is not None)
        last = max(s.last for s in stats.values() if s.last is not None)
        length, trailer = rng.randrange(50, 90), rng.randrange(5, 20)
        crcs = rng.randrange(1 << 32), rng.randrange(1 << 32)
        rows.append((at, length, trailer, *crcs, first, last, len(stats)))
        at += length + trailer
        told.append(stats)
    others = [(0, 20, 7), (at, 10, 8)]
    table = ChunkTable(np.array(rows, CHUNK), np.array(parts, PART), np.array(others, OTHER))
    return table, told


def rows_of(catalog: Catalog) -> dict[str, tuple[str, RecordingEntry]]:
    """State of the files and entry of each recording that has a summary, by id."""
    rows = {one.id: catalog.recording(one.id) for one in catalog.summaries()}
    return {recording: row for recording, row in rows.items() if row is not None}


class Model:
    """A recording as a list of what is in it."""

    def __init__(self, seed: int, label: str = "run", segments: int = 3, chunks: int = 12) -> None:
        rng = random.Random(seed)
        self.id = f"{rng.getrandbits(128):032x}"
        self.tables: dict[int, ChunkTable] = {}
        self.told: dict[int, list[dict[int, ChannelStats]]] = {}
        for number in range(segments):
            self.tables[number], self.told[number] = segment(rng, chunks)
        self.entry = RecordingEntry(
            id=self.id,
            label=label,
            name=f"{label} näme",
            tags={"a.b": "c", "$x": "y", "": "z"},
            source={"path": "/x", "bytes": 2**40, "fingerprint": "f"},
            created=2**62,
            status="complete",
            end={"losses": [{"cause": "queue", "count": None}]},
            channels=[
                channel_entry(c, channel(c), "no reason" if c == 2 else None) for c in CHANNELS
            ],
            stored_bytes=2**50,
            segments=segments,
            chunks=segments * chunks,
            notes=[{"at": 5, "text": "ö"}],
            marks=[{"time": 1, "text": "m", "tags": {}, "segment": 1}],
            spans=[
                (n, int(t.chunks["first"].min()), int(t.chunks["last"].max()))
                for n, t in self.tables.items()
            ],
            digests={str(n): f"sha256:{rng.getrandbits(256):064x}" for n in self.tables},
        )
        for entry in self.entry.channels:
            for chunks_of in self.told.values():
                for stats in chunks_of:
                    if entry.id in stats:
                        entry.stats.add(stats[entry.id])

    @property
    def described(self) -> Described:
        channels = {c: channel(c) for c in CHANNELS}
        entry = self.entry
        return Described(
            entry,
            summary_of(entry, f"outside of {self.id}"),
            topic_types(entry),
            f"looks of {self.id}",
            self.tables,
            channels,
        )

    def put(self, catalog: Catalog, *, decoded: bool = True) -> None:
        catalog.put(self.described)
        if decoded:
            catalog.put_stamps(
                self.id,
                [
                    (n, self.entry.digests[str(n)], stamps_of(t, dict(enumerate(self.told[n]))))
                    for n, t in self.tables.items()
                ],
            )

    def chunks(self, *, decoded: bool = True) -> list[ChunkEntry]:
        """What the catalog should say of all chunks."""
        found = []
        for number, table in self.tables.items():
            for row, told in enumerate(self.told[number]):
                values = table.chunks[row].tolist()[:-1]
                stats = told if decoded else {c: undecoded(s) for c, s in told.items()}
                found.append(ChunkEntry(self.id, number, row, *values, stats))
        return found

    def wanted(
        self,
        channels: Sequence[int] | None,
        bounds: tuple[int, int] | None,
        clock: str,
        *,
        decoded: bool = True,
    ) -> list[ChunkEntry]:
        """The same question, asked of the list."""
        suffix = {"log": "", "publish": "_publish", "header": "_stamp"}[clock]
        found = []
        for chunk in self.chunks(decoded=decoded):
            for c, stats in chunk.stats.items():
                if channels is not None and c not in channels:
                    continue
                first, last = getattr(stats, f"first{suffix}"), getattr(stats, f"last{suffix}")
                may = bounds is None or (clock == "header" and not decoded)
                if may or (
                    bounds is not None
                    and first is not None
                    and first < bounds[1]
                    and last >= bounds[0]
                ):
                    found.append(chunk)
                    break
        return found


def undecoded(stats: ChannelStats) -> ChannelStats:
    return ChannelStats(
        messages=stats.messages,
        payload_bytes=stats.payload_bytes,
        first=stats.first,
        last=stats.last,
        first_publish=stats.first_publish,
        last_publish=stats.last_publish,
        longest=stats.longest,
    )


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with closing(Catalog(tmp_path, STORE)) as made:
        yield made


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(1)


# Questions.


@pytest.mark.parametrize("decoded", [True, False])
@pytest.mark.parametrize("clock", ["log", "publish", "header"])
def test_chunks_by_channel_time_and_clock(
    catalog: Catalog, model: Model, clock: str, decoded: bool
) -> None:
    model.put(catalog, decoded=decoded)
    Model(9, "other").put(catalog)
    rng = random.Random(2)
    questions: list[tuple[list[int] | None, tuple[int, int] | None]] = [
        (None, None), ([], None), ([3], None), ([77], None), (None, (-(1 << 70), 1 << 70)),
        (None, (1 << 63, 1 << 64)), (None, (-(1 << 80), -(1 << 63))), (None, (50, 50)),
    ]  # fmt: skip
    for _ in range(300):
        begin = rng.randrange(-5, 105)
        channels = rng.sample(CHANNELS, rng.randrange(1, 4)) if rng.random() < 0.8 else None
        questions.append((channels, (begin, begin + rng.choice([0, 1, 2, 5, 30]))))
    kinds = set()
    for channels, bounds in questions:
        want = model.wanted(channels, bounds, clock, decoded=decoded)
        got = []
        timed = [c for c in CHANNELS if c != SILENT]
        for number in model.tables:
            table, stamps = catalog.decoded_table(model.entry, number)
            columns = ChunkColumns(number, table, channels)
            got += columns.chunks(columns.within(bounds, clock, stamps=stamps, timed=timed))
        assert [(c.segment, c.number) for c in got] == [(c.segment, c.number) for c in want]
        kinds.add((len(want) > 0, len(want) < 36))
    if decoded or clock != "header":
        assert kinds == {(True, True), (True, False), (False, True)}


def test_a_segment_without_messages_is_not_looked_for(catalog: Catalog, model: Model) -> None:
    empty = ChunkTable(np.empty(0, CHUNK), np.empty(0, PART), np.array([(0, 20, 7)], OTHER))
    assert channel_totals(empty, None) == {}
    entry = replace(model.entry, digests={**model.entry.digests, "3": "sha256:3"})
    tables = {**model.tables, 3: empty}
    catalog.put(replace(model.described, entry=entry, tables=tables))
    assert len(chunk_entries(catalog, entry)) == 36
    assert catalog.table(entry, 3).end == 20


def test_a_chunk_says_where_it_lies_and_when(catalog: Catalog, model: Model) -> None:
    model.put(catalog)
    found = [
        chunk
        for number, table in model.tables.items()
        for chunk in ChunkColumns(number, table, CHANNELS).chunks()
    ]
    for got, want in zip(found, model.chunks(), strict=True):
        assert got.place == want.place
        assert got.messages == sum(s.messages for s in want.stats.values())
        assert (got.first, got.last) == (want.first, want.last)
    assert not ChunkColumns(0, model.tables[0], [99]).chunks()


def test_the_last_chunks_come_first(model: Model) -> None:
    for number, table in model.tables.items():
        columns = ChunkColumns(number, table, [3])
        for latest in range(-1, 110):
            found = [*columns.before(latest)]
            assert {c.number for c, _ in found} == {
                n for n, first in zip(columns.number.tolist(), columns.first, strict=True)
                if first <= latest
            }  # fmt: skip
            for place, (_, last) in enumerate(found):
                assert last == max(c.last for c, _ in found[place:])


def test_recordings_come_back(catalog: Catalog, model: Model) -> None:
    other = Model(2, "other", segments=0)
    for one in (model, other):
        one.put(catalog)
    found = rows_of(catalog)
    assert found == {
        model.id: (f"looks of {model.id}", model.entry),
        other.id: (f"looks of {other.id}", other.entry),
    }
    assert found[model.id][1].span == (
        min(a for _, a, _ in model.entry.spans), max(b for _, _, b in model.entry.spans),
    )  # fmt: skip
    assert found[other.id][1].span is None
    assert model.entry.messages == sum(c.messages for c in model.chunks())
    assert model.entry.messages_by_topic()["/ä3"] == sum(
        c.stats[3].messages for c in model.chunks() if 3 in c.stats
    )
    changed = replace(other.entry, status="recovered", tags={})
    catalog.put(replace(other.described, entry=changed, files="otherwise"))
    assert rows_of(catalog)[other.id] == ("otherwise", changed)


def test_a_directory_may_have_any_name(catalog: Catalog) -> None:
    label = os.fsdecode(b"r\xff\xfe\xc3")
    model = Model(5, label)
    model.put(catalog)
    catalog.put_damage(model.id, {(0, 1): f"{label}: a file of it"})
    assert rows_of(catalog)[model.id][1].label == label
    assert catalog.damage(model.id) == {(0, 1): f"{label}: a file of it"}


def test_totals_of_a_segment_are_those_of_its_chunks(model: Model) -> None:
    for number, table in model.tables.items():
        want: dict[int, ChannelStats] = {}
        for stats in model.told[number]:
            for c, one in stats.items():
                want.setdefault(c, ChannelStats()).add(one)
        stamps = stamps_of(table, dict(enumerate(model.told[number])))
        got = channel_totals(table, stamps, {SILENT})
        for c, stats in want.items():
            stats.skew_sum = math.fsum(
                s[c].skew_sum for s in model.told[number] if c in s and s[c].stamped
            )
        assert got == want
        assert channel_totals(table, None, {SILENT}) == {c: undecoded(s) for c, s in want.items()}


def test_what_replaces_a_segment_is_what_counts(catalog: Catalog, model: Model) -> None:
    """A list of chunks belongs to one content of the segment, and to no other."""
    model.put(catalog)
    assert chunk_entries(catalog, model.entry) == model.chunks()
    again = Model(3, segments=2)
    again.id = again.entry.id = model.id
    with pytest.raises(CatalogError, match="segment 0"):
        chunk_entries(catalog, again.entry)
    again.put(catalog)
    assert chunk_entries(catalog, again.entry) == again.chunks()
    # Also for whoever asks with what was known before, and has the old lists at hand.
    with pytest.raises(CatalogError, match="segment 0"):
        chunk_entries(catalog, model.entry)


def test_stamps_of_other_bytes_are_not_believed(catalog: Catalog, model: Model) -> None:
    model.put(catalog, decoded=False)
    rows = stamps_of(model.tables[0], dict(enumerate(model.told[0])))
    catalog.put_stamps(model.id, [(0, "sha256:of another", rows)])
    assert catalog.stamps(model.entry, 0, model.tables[0]) is None
    catalog.put_stamps(model.id, [(0, model.entry.digests["0"], rows[:-1])])
    assert catalog.stamps(model.entry, 0, model.tables[0]) is None
    catalog.put_stamps(model.id, [(0, model.entry.digests["0"], rows)])
    found = catalog.stamps(model.entry, 0, model.tables[0])
    assert found is not None
    assert found.tobytes() == rows.tobytes()


def test_damage_is_replaced(catalog: Catalog) -> None:
    catalog.put_damage("r", {(0, 1): "ä", (2, 3): "b"})
    catalog.put_damage("other", {(9, 9): "c"})
    assert catalog.damage("r") == {(0, 1): "ä", (2, 3): "b"}
    catalog.put_damage("r", {(2, 3): "d"})
    assert catalog.damage("r") == {(2, 3): "d"}
    catalog.put_damage("r", {})
    assert (catalog.damage("r"), catalog.damage("other")) == ({}, {(9, 9): "c"})


def test_schemas(catalog: Catalog, model: Model) -> None:
    model.put(catalog)
    known = {schema_hash(s): s for s in SCHEMAS.values() if s is not None}
    assert len(known) == 4
    assert catalog.schemas(known) == known
    one = next(iter(known))
    assert catalog.schemas([one, "nothing"]) == {one: known[one]}
    assert catalog.schemas([]) == {}


def test_hashes_of_schemas_do_not_run_together() -> None:
    schemas = [
        Schema("ab", "c", b"d"), Schema("a", "bc", b"d"), Schema("a", "b", b"cd"),
        Schema("", "ab", b"cd"), Schema("ab", "", b"cd"), Schema("abcd", "", b""),
    ]  # fmt: skip
    for one, other in combinations(schemas, 2):
        assert schema_hash(one) != schema_hash(other)


def test_a_recording_is_removed_without_a_trace(
    catalog: Catalog, model: Model, tmp_path: Path
) -> None:
    other = Model(2, "other")
    for one in (model, other):
        one.put(catalog)
        catalog.put_damage(one.id, {(0, 0): "x"})
    catalog.remove(model.id)
    assert rows_of(catalog).keys() == {other.id}
    assert catalog.damage(model.id) == {}
    with pytest.raises(CatalogError):
        chunk_entries(catalog, model.entry)
    assert chunk_entries(catalog, other.entry) == other.chunks()
    with closing(sqlite3.connect(tmp_path / CATALOG)) as db:
        for table in ("recordings", "segments", "stamps", "damage"):
            assert {i for (i,) in db.execute(f"select distinct id from {table}")} == {other.id}


def test_so_many_lists_of_chunks_are_kept_at_hand(
    catalog: Catalog, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    model.put(catalog)
    size = module._size(model.tables[0])
    monkeypatch.setattr(module, "_CACHED_BYTES", 2 * size + size // 2)
    for _ in range(2):
        assert chunk_entries(catalog, model.entry) == model.chunks()
        assert [key[1] for key in catalog._tables] == [1, 2]
        assert catalog._cached == sum(module._size(table) for table, _ in catalog._tables.values())
    assert catalog.table(model.entry, 2) is catalog.table(model.entry, 2)
    catalog.remove(model.id)
    assert (len(catalog._tables), catalog._cached) == (0, 0)


def test_one_in_memory_leaves_no_file(tmp_path: Path, model: Model) -> None:
    with closing(Catalog(None, STORE)) as made:
        assert made.is_in_memory
        model.put(made)
        assert chunk_entries(made, model.entry) == model.chunks()
        made.rebuild()
        assert rows_of(made) == {}
        model.put(made)
        assert rows_of(made).keys() == {model.id}
    assert list(tmp_path.iterdir()) == []


@given(st.lists(st.integers(0, 2**32), min_size=1, max_size=12), st.randoms(use_true_random=False))
def test_statistics_add_up_in_any_order(seeds: list[int], rng: random.Random) -> None:
    parts = []
    for seed in seeds:
        _, (stats,) = segment(random.Random(seed), 1)
        parts += [replace(s, skew_sum=float(seed % 1000)) for s in stats.values()]
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
        elif name == "longest":
            assert value == max(values)
        else:
            assert value == sum(values)


@given(
    st.lists(st.integers(-(2**62), 2**62), min_size=1, max_size=9),
    st.randoms(use_true_random=False),
)
def test_skews_add_up_exactly(skews: list[int], rng: random.Random) -> None:
    """Those of senders without a clock are beyond what floats hold one by one."""

    def total(values: Sequence[int]) -> ChannelStats:
        rows = [(20 + 10 * n, 8, 2, 0, 0, 5, 5, 1) for n in range(len(values))]
        parts = [(1, 1, 1, 5, 5, 5, 5)] * len(values)
        table = ChunkTable(
            np.array(rows, CHUNK), np.array(parts, PART), np.array([(0, 20, 0)], OTHER)
        )
        told = {
            n: {1: ChannelStats(stamped=1, first_stamp=5, last_stamp=5, skew_sum=float(v))}
            for n, v in enumerate(values)
        }
        return channel_totals(table, stamps_of(table, told))[1]

    whole = total(skews)
    assert whole == total(rng.sample(skews, len(skews)))
    assert whole.skew_sum == math.fsum(map(float, skews))
    assert (whole.stamped, whole.messages) == (len(skews), len(skews))


# Bytes that change.


class Truth:
    """A small catalog, and everything that it may say."""

    def __init__(self, folder: Path) -> None:
        self.models = [Model(n, f"run{n}", segments=2, chunks=4) for n in range(3)]
        self.damage = {(0, 1): "unreadable", (1, 0): "gone"}
        with closing(Catalog(folder, STORE)) as made:
            self.fill(made)
        self.path = folder / CATALOG
        self.bytes = self.path.read_bytes()

    def fill(self, catalog: Catalog) -> None:
        for model in self.models:
            model.put(catalog)
            catalog.put_damage(model.id, self.damage)

    def check(self, catalog: Catalog) -> bool:
        """That nothing that it says is wrong; returns whether it says all."""
        known = rows_of(catalog)
        summaries = {one.id: one for one in catalog.summaries()}
        assert summaries.items() <= {m.id: m.described.summary for m in self.models}.items()
        complete = len(summaries) == len(self.models)
        same = catalog.with_fingerprint("f")
        assert same is None or same in [model.entry for model in self.models]
        complete &= same is not None
        for model in self.models:
            row = known.pop(model.id, None)
            if row is not None:
                assert row == (f"looks of {model.id}", model.entry)
            complete &= row is not None
            for told in (
                lambda model=model: self._chunks(catalog, model),
                lambda model=model: self._topics(catalog, model),
                lambda model=model: catalog.damage(model.id) in ({}, self.damage),
                lambda model=model: self._schemas(catalog),
            ):
                try:
                    assert told()
                except CatalogError:
                    complete = False
            for number, table in model.tables.items():
                try:
                    found = catalog.stamps(model.entry, number, table)
                except CatalogError:
                    complete = False
                else:
                    want = stamps_of(table, dict(enumerate(model.told[number])))
                    assert found is None or found.tobytes() == want.tobytes()
        assert known == {}
        return complete

    @staticmethod
    def _topics(catalog: Catalog, model: Model) -> bool:
        described = model.described
        return set(catalog.topics(described.summary.topics)) == described.topics

    @staticmethod
    def _chunks(catalog: Catalog, model: Model) -> bool:
        got = chunk_entries(catalog, model.entry)
        assert len(got) == 8
        for one, decoded, plain in zip(
            got, model.chunks(), model.chunks(decoded=False), strict=True
        ):
            assert one in (decoded, plain)
        return True

    @staticmethod
    def _schemas(catalog: Catalog) -> bool:
        known = {schema_hash(s): s for s in SCHEMAS.values() if s is not None}
        found = catalog.schemas(known)
        return all(known[digest] == schema for digest, schema in found.items())

    def is_whole(self, catalog: Catalog) -> bool:
        """The same, whatever is damaged."""
        try:
            return self.check(catalog)
        except CatalogError:
            return False

    def make_again(self, catalog: Catalog) -> None:
        """What a store does when something is damaged, or missing."""
        catalog.mend()
        self.fill(catalog)
        if not self.is_whole(catalog):
            # What is written into a damaged file makes it anew, and lacks what was there before.
            self.fill(catalog)
        assert self.check(catalog)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return Truth(tmp_path_factory.mktemp("truth"))


def open_and_ask(truth: Truth, folder: Path) -> None:
    """Nothing wrong is said of a file that was changed, and it can be made again."""
    with closing(Catalog(folder, STORE)) as opened:
        truth.is_whole(opened)
        truth.make_again(opened)
    with closing(Catalog(folder, STORE)) as opened:
        assert truth.check(opened)
        assert opened._is_sound()


def spots(truth: Truth) -> list[int]:
    rng = random.Random(6)
    size = 4096
    pages = len(truth.bytes) // size
    # The head of the file and of each page, and samples of the rest.
    found = {*range(0, 108, 3)}
    for page in range(pages):
        found.update(page * size + n for n in (0, 3, 5, 7, 8, 9, 11))
        found.update(rng.sample(range(page * size, (page + 1) * size), 4))
    return sorted(found)


def test_whatever_byte_of_the_file_changes_nothing_wrong_is_said(
    truth: Truth, tmp_path: Path
) -> None:
    rng = random.Random(5)
    path = tmp_path / CATALOG
    for spot in spots(truth):
        data = bytearray(truth.bytes)
        data[spot] ^= rng.choice([1, 1 << rng.randrange(8), 0xFF])
        path.write_bytes(data)
        try:
            open_and_ask(truth, tmp_path)
        except Exception as error:
            raise AssertionError(f"byte {spot} of {len(data)}") from error


@pytest.mark.parametrize("kind", ["zeros", "random", "another", "cut", "empty", "text"])
def test_whatever_page_of_the_file_is_lost_nothing_wrong_is_said(
    truth: Truth, tmp_path: Path, kind: str
) -> None:
    rng = random.Random(7)
    path = tmp_path / CATALOG
    size = 4096
    pages = len(truth.bytes) // size
    assert pages > 10
    for page in range(pages) if kind in {"zeros", "random", "another"} else [rng.randrange(pages)]:
        data = bytearray(truth.bytes)
        where = slice(page * size, (page + 1) * size)
        if kind == "zeros":
            data[where] = bytes(size)
        elif kind == "random":
            data[where] = rng.randbytes(size)
        elif kind == "another":
            other = rng.randrange(pages)
            data[where] = truth.bytes[other * size : (other + 1) * size]
        elif kind == "cut":
            del data[page * size + 77 :]
        else:
            data = bytearray(b"" if kind == "empty" else b"what somebody has written" * 500)
        path.write_bytes(data)
        try:
            open_and_ask(truth, tmp_path)
        except Exception as error:
            raise AssertionError(f"page {page} of {pages}") from error


CHANGES = {
    "recordings": ("files", "entry", "crc"),
    "summaries": ("summary", "crc"),
    "topics": ("topics",),
    "segments": ("digest", "chunks", "crc"),
    "stamps": ("digest", "rows", "crc"),
    "damage": ("chunks", "crc"),
    "schemas": ("name", "encoding", "data"),
}


def altered(value: object, rng: random.Random) -> Iterator[object]:
    """A value that is almost the same, or of another type."""
    if isinstance(value, int):
        yield from (value ^ 1, -value, f"{value}x", None)
        return
    data = bytearray(value if isinstance(value, bytes) else str(value).encode())
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(7)
    yield bytes(data)
    yield bytes(data).decode("utf-8", "replace")
    yield bytes(data[:-1])
    yield 5
    # The same bytes, as another type.
    yield value.decode("latin-1") if isinstance(value, bytes) else str(value).encode()


@pytest.mark.parametrize(
    ("table", "column"), [(table, column) for table, of in CHANGES.items() for column in of]
)
def test_a_row_that_was_changed_is_not_believed(
    truth: Truth, tmp_path: Path, table: str, column: str
) -> None:
    rng = random.Random(3)
    path = tmp_path / CATALOG
    with closing(sqlite3.connect(truth.path)) as db:
        (value,) = db.execute(f"select {column} from {table} limit 1").fetchone()
    for other in altered(value, rng):
        shutil.copy(truth.path, path)
        with closing(sqlite3.connect(path)) as db:
            try:
                db.execute(f"update {table} set {column} = ? where {column} = ?", (other, value))
            except sqlite3.IntegrityError:
                continue
            db.commit()
        with closing(Catalog(tmp_path, STORE)) as opened:
            complete = truth.is_whole(opened)
            if table in {"recordings", "summaries", "topics", "segments", "damage"}:
                assert not complete, other
            truth.make_again(opened)


@pytest.mark.parametrize("table", [*CHANGES, "fingerprints"])
def test_rows_that_changed_places_or_are_gone_are_not_believed(
    truth: Truth, tmp_path: Path, table: str
) -> None:
    """As they are, checksums and all."""
    keys = {"topics": "hash", "schemas": "hash"}.get(table, "id")
    path = tmp_path / CATALOG
    for change in ("exchange", "delete", "drop"):
        shutil.copy(truth.path, path)
        with closing(sqlite3.connect(path)) as db:
            found = [k for (k,) in db.execute(f"select distinct {keys} from {table} limit 2")]
            one, other = found[0], found[-1]
            if change == "exchange":
                for old, new in ((one, "x"), (other, one), ("x", other)):
                    db.execute(f"update {table} set {keys} = ? where {keys} = ?", (new, old))
            elif change == "delete":
                db.execute(f"delete from {table} where {keys} = ?", (one,))
            else:
                db.execute(f"drop table {table}")
            db.commit()
        open_and_ask(truth, tmp_path)


# Files that are not ours.


def test_the_catalog_of_another_store_is_made_anew(tmp_path: Path, model: Model) -> None:
    with closing(Catalog(tmp_path, STORE)) as made:
        model.put(made)
    with closing(Catalog(tmp_path, STORE)) as same:
        assert rows_of(same).keys() == {model.id}
    with closing(Catalog(tmp_path, "6" * 32)) as other:
        assert rows_of(other) == {}
        with pytest.raises(CatalogError):
            chunk_entries(other, model.entry)
        model.put(other)
        assert chunk_entries(other, model.entry) == model.chunks()


@pytest.mark.parametrize("version", ["1", "", "5", None])
def test_the_catalog_of_another_version_is_made_anew(
    tmp_path: Path, model: Model, version: str | None
) -> None:
    with closing(Catalog(tmp_path, STORE)) as made:
        model.put(made)
    with closing(sqlite3.connect(tmp_path / CATALOG)) as db:
        if version is None:
            db.execute("delete from meta where key = 'version'")
        else:
            db.execute("update meta set value = ? where key = 'version'", (version,))
        db.execute("create table sequence (n integer primary key autoincrement)")
        db.execute("insert into sequence values (7)")
        db.execute('create table "of ""theirs" (n)')
        db.commit()
    with closing(Catalog(tmp_path, STORE)) as again:
        assert rows_of(again) == {}
        model.put(again)
    with closing(Catalog(tmp_path, STORE)) as again:
        assert chunk_entries(again, model.entry) == model.chunks()


@pytest.mark.parametrize("target", ["file", "nothing"])
def test_a_symlink_in_its_place_is_refused(tmp_path: Path, target: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    if target == "file":
        elsewhere.write_bytes(b"not yours")
    store = tmp_path / "store"
    store.mkdir()
    (store / CATALOG).symlink_to(elsewhere)
    with pytest.raises(StoreError, match=CATALOG):
        Catalog(store, STORE)
    assert elsewhere.exists() == (target == "file")
    assert target != "file" or elsewhere.read_bytes() == b"not yours"


def test_a_symlink_to_the_store_is_no_hindrance(tmp_path: Path, model: Model) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with closing(Catalog(tmp_path / "link", STORE)) as made:
        model.put(made)
    with closing(Catalog(tmp_path / "real", STORE)) as same:
        assert chunk_entries(same, model.entry) == model.chunks()


USES: dict[str, Callable[[Catalog, Model], object]] = {
    "opened": lambda _, __: None,
    "written": lambda made, model: model.put(made),
    "read": lambda made, _: made.summaries(),
    "rebuilt": lambda made, _: made.rebuild(),
}


@pytest.mark.parametrize("use", USES)
def test_one_in_memory_takes_the_place_of_a_locked_file(
    tmp_path: Path, model: Model, monkeypatch: pytest.MonkeyPatch, use: str
) -> None:
    """Somebody writes for longer than one waits: that is told, and nothing is deleted."""
    monkeypatch.setattr(module, "_BUSY_S", 0.05)
    with closing(Catalog(tmp_path, STORE)) as made:
        model.put(made)
    with closing(sqlite3.connect(tmp_path / CATALOG, isolation_level=None)) as db:
        other = None if use == "opened" else Catalog(tmp_path, STORE)
        db.execute("begin exclusive")
        with closing(other or Catalog(tmp_path, STORE)) as made:
            for _ in range(2):
                with suppress(CatalogError):  # what is asked for is read from the files
                    USES[use](made, model)
            assert made.locked == tmp_path / CATALOG
            assert made.is_in_memory
            assert not made.was_damaged
            assert rows_of(made).keys() == ({model.id} if use == "written" else set())
            model.put(made)
            assert chunk_entries(made, model.entry) == model.chunks()
        db.execute("rollback")
    with closing(Catalog(tmp_path, STORE)) as same:
        assert rows_of(same).keys() == {model.id}
        assert same.locked is None


def test_a_full_disk_leaves_it_as_it_was(catalog: Catalog, model: Model) -> None:
    model.put(catalog)
    (pages,) = catalog._db.execute("pragma page_count").fetchone()
    catalog._db.execute(f"pragma max_page_count = {pages}")
    with pytest.raises(DiskFullError, match="No space left"):
        Model(4, "other").put(catalog)
    catalog._db.execute("pragma max_page_count = 1000000")
    assert rows_of(catalog).keys() == {model.id}
    assert chunk_entries(catalog, model.entry) == model.chunks()


def test_what_is_interrupted_leaves_it_as_it_was(
    catalog: Catalog, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    model.put(catalog)

    def stop(_: object) -> bytes:
        raise KeyboardInterrupt

    again = Model(3, segments=2)
    again.id = again.entry.id = model.id
    with monkeypatch.context() as patch:
        patch.setattr(ChunkTable, "to_bytes", stop)
        with pytest.raises(KeyboardInterrupt):
            again.put(catalog)
    assert rows_of(catalog)[model.id][1] == model.entry
    assert chunk_entries(catalog, model.entry) == model.chunks()
    again.put(catalog)
    assert chunk_entries(catalog, again.entry) == again.chunks()


# Several at once.


def test_two_that_have_it_open_see_what_the_other_does(tmp_path: Path, model: Model) -> None:
    with closing(Catalog(tmp_path, STORE)) as one, closing(Catalog(tmp_path, STORE)) as other:
        model.put(one)
        assert rows_of(other).keys() == {model.id}
        assert chunk_entries(other, model.entry) == model.chunks()
        other.remove(model.id)
        assert rows_of(one) == {}
        model.put(other)
        one.rebuild()
        assert rows_of(other) == {}
        model.put(other)
        assert chunk_entries(one, model.entry) == model.chunks()


@pytest.mark.parametrize("how", ["deleted", "damaged"])
def test_one_that_was_made_anew_is_taken_up(tmp_path: Path, model: Model, how: str) -> None:
    """Whoever has the old file open must not go on with it."""
    with closing(Catalog(tmp_path, STORE)) as one:
        model.put(one)
        if how == "deleted":
            (tmp_path / CATALOG).unlink()
        else:
            # The tree of the recordings is no tree any more.
            with closing(sqlite3.connect(tmp_path / CATALOG)) as db:
                (root,) = db.execute(
                    "select rootpage from sqlite_master where name = 'recordings'"
                ).fetchone()
            with (tmp_path / CATALOG).open("r+b") as file:
                file.seek((root - 1) * 4096)
                file.write(b"\xff" * 4096)
        with closing(Catalog(tmp_path, STORE)) as other:
            if how == "damaged":
                other.rebuild()
            other_model = Model(8, "other")
            other_model.put(other)
            assert rows_of(one).keys() == {other_model.id}
            model.put(one)
            assert rows_of(other).keys() == {model.id, other_model.id}
            assert chunk_entries(other, model.entry) == model.chunks()


WRITER = """
import sys
from pathlib import Path
from tests.storage.test_catalog import STORE, Catalog, Model, chunk_entries, rows_of

first, count = int(sys.argv[2]), int(sys.argv[3])
catalog = Catalog(Path(sys.argv[1]), STORE)
for number in range(first, first + count):
    model = Model(number, f"run{number}", segments=2, chunks=3)
    model.put(catalog)
    catalog.put_damage(model.id, {(0, number): "x"})
    assert chunk_entries(catalog, model.entry) == model.chunks()
    assert rows_of(catalog)[model.id][1] == model.entry
    if number % 5 == 0:
        catalog.remove(model.id)
print("done")
"""


def test_two_processes_write_at_the_same_time(tmp_path: Path) -> None:
    """From the first moment on: they also make the file at the same time."""
    count = 40
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(tmp_path), str(first), str(count)],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "storage")])},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for first in (0, 1000)
    ]
    for process in processes:
        assert process.communicate(timeout=120) == ("done\n", "")
    want: Mapping[str, Model] = {
        model.id: model
        for first in (0, 1000)
        for number in range(first, first + count)
        if number % 5 and (model := Model(number, f"run{number}", segments=2, chunks=3))
    }
    with closing(Catalog(tmp_path, STORE)) as opened:
        assert rows_of(opened).keys() == want.keys()
        for model in want.values():
            assert chunk_entries(opened, model.entry) == model.chunks()
            assert len(opened.damage(model.id)) == 1


def test_several_threads_use_one(catalog: Catalog) -> None:
    failures: list[BaseException] = []

    def use(first: int) -> None:
        try:
            for number in range(first, first + 10):
                model = Model(number, f"run{number}", segments=2, chunks=3)
                model.put(catalog)
                assert chunk_entries(catalog, model.entry) == model.chunks()
                catalog.remove(model.id)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=use, args=(100 * n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert rows_of(catalog) == {}
