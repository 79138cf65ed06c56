"""The catalog: against the same questions asked of a list, and with its bytes changed."""

from __future__ import annotations

import errno
import json
import math
import os
import random
import subprocess
import sys
import threading
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path
from typing import Any
from zlib import compress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.entries import summary_of, topic_types
from hybridlog.query.chunk_columns import ChunkColumns
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
from hybridlog_storage.catalog_parts import (
    BOUNDS,
    DAMAGE,
    ENTRY,
    MAX_PART_BYTES,
    STAMPS,
    SUMMARY,
    TOPICS,
    VERSION,
    DiskFolder,
    PartContent,
)
from hybridlog_storage.disk import files
from hybridlog_storage.errors import DiskFullError, StoreError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.chunk_table import CHUNK, OTHER, PART, ChunkTable
from tests.imports import ROOT
from tests.limits import Limit

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
            table = model.tables[number]
            stamps = catalog.stamps(model.entry, number, table)
            columns = ChunkColumns(number, table, channels)
            got += columns.chunks(columns.within(bounds, clock, stamps=stamps, timed=timed))
        assert [(c.segment, c.number) for c in got] == [(c.segment, c.number) for c in want]
        kinds.add((len(want) > 0, len(want) < 36))
    if decoded or clock != "header":
        assert kinds == {(True, True), (True, False), (False, True)}


def decoded_of(catalog: Catalog, model: Model) -> list[bytes | None]:
    """What a catalog says of the decoding of each segment."""
    found = [catalog.stamps(model.entry, number, table) for number, table in model.tables.items()]
    return [None if one is None else one.tobytes() for one in found]


def decoded_in(model: Model) -> list[bytes | None]:
    """What it should say."""
    return [
        stamps_of(table, dict(enumerate(model.told[number]))).tobytes()
        for number, table in model.tables.items()
    ]


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


def test_results_belong_to_one_content_of_a_segment(catalog: Catalog, model: Model) -> None:
    model.put(catalog)
    assert decoded_of(catalog, model) == decoded_in(model)
    again = Model(3, segments=2)
    again.id = again.entry.id = model.id
    assert decoded_of(catalog, again) == [None, None]
    again.put(catalog)
    assert decoded_of(catalog, again) == decoded_in(again)
    assert decoded_of(catalog, model)[:2] == [None, None]


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


def test_bounds_are_of_one_content(tmp_path: Path) -> None:
    models = [Model(number, f"run{number}") for number in range(3)]
    first, second, third = models
    ends = {first.id: (1, 2.5), second.id: (None, None), third.id: (-math.inf, 2**70)}
    with closing(Catalog(tmp_path, STORE)) as one, closing(Catalog(tmp_path, STORE)) as other:
        for model in models:
            model.put(one)
        assert len(other.summaries()) == 3
        for model in models:
            other.note_bounds("x", model.entry, ends[model.id])
            other.note_bounds("y", model.entry, (5, 6))
        assert other.bounds("x") == ends
        first.entry.digests["0"] = "sha256:0"
        first.put(one)
    del ends[first.id]
    with closing(Catalog(tmp_path, STORE)) as one:
        one.summaries()
        assert one.bounds("x") == ends
        one.put_damage(third.id, {(0, 0): "x"})
        second.put(one)  # the same again
        assert one.bounds("x") == ends
        second.entry.digests["1"] = "sha256:1"
        second.put(one)
        del ends[second.id]
        assert (one.bounds("x"), one.bounds("y")) == (ends, {third.id: (5, 6)})
        one.note_bounds("x", third.entry, (7, 8))
        assert one.bounds("x") == {third.id: (7, 8)}
        one.remove(third.id)
        assert one.bounds("x") == {}
        assert one.is_sound()


def test_bounds_take_little_room(tmp_path: Path) -> None:
    models = [Model(number, f"run{number}", segments=1, chunks=3) for number in range(20)]
    for turn in range(3):
        with closing(Catalog(tmp_path, STORE)) as catalog:
            for model in models if not turn else ():
                model.put(catalog)
            catalog.summaries()
            for kind in range(40):
                for model in models:
                    catalog.note_bounds(f"{turn}-{kind}", model.entry, (0.1, 0.2))
    sizes = [path.stat().st_size for path in (tmp_path / CATALOG).glob("part-*")]
    assert max(sizes) < 64 << 10
    with closing(Catalog(tmp_path, STORE)) as catalog:
        assert len(catalog.summaries()) == 20
        assert {*map(len, (catalog.bounds(f"2-{kind}") for kind in range(40)))} - {0}


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
    assert decoded_of(catalog, model) == [None] * 3
    assert decoded_of(catalog, other) == decoded_in(other)
    parts = (tmp_path / CATALOG).glob("part-*")
    assert not [path for path in parts if model.id.encode() in path.read_bytes()]
    catalog.remove(other.id)
    assert not [*(tmp_path / CATALOG).glob("part-*")]


class Counting(files.System):
    """Counts the bytes that are written."""

    count = 0

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        done = super().writev(fd, parts)
        self.count += done
        return done


def test_a_change_writes_little(
    catalog: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many recordings there are: one part, or two, of bounded size."""
    models = [Model(number, f"run{number}", segments=1, chunks=3) for number in range(100)]
    for model in models:
        model.put(catalog)
    parts = {path: path.stat() for path in (tmp_path / CATALOG).glob("part-*")}
    assert len(parts) > 5
    sizes = sorted(about.st_size for about in parts.values())
    assert sizes[-1] <= 1.2 * MAX_PART_BYTES
    assert sizes[len(sizes) // 4] > MAX_PART_BYTES / 4
    for change in (
        lambda: catalog.put(models[7].described),
        lambda: catalog.put_damage(models[50].id, {(0, 0): "x"}),
        lambda: catalog.remove(models[80].id),
    ):
        with monkeypatch.context() as patch:
            written = Counting()
            patch.setattr(files, "system", written)
            change()
        assert 0 < written.count <= 1.2 * MAX_PART_BYTES
    assert len(catalog.summaries()) == 99


def test_a_large_recording_has_a_part_of_its_own(catalog: Catalog, tmp_path: Path) -> None:
    small, large = Model(1), Model(2, "large")
    large.entry.source["text"] = "x" * MAX_PART_BYTES
    small.put(catalog)
    for _ in range(3):
        large.put(catalog)
        assert len([*(tmp_path / CATALOG).glob("part-*")]) == 2
        assert rows_of(catalog).keys() == {small.id, large.id}
    small.put(catalog)
    assert rows_of(catalog)[large.id][1] == large.entry


def test_one_in_memory_leaves_no_file(tmp_path: Path, model: Model) -> None:
    with closing(Catalog(tmp_path, STORE, in_memory=True)) as made:
        assert made.is_in_memory
        model.put(made)
        assert decoded_of(made, model) == decoded_in(model)
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
        self.models = [Model(n, f"run{n}", segments=2, chunks=2) for n in range(3)]
        self.damage = {(0, 1): "unreadable", (1, 0): "gone"}
        with closing(Catalog(folder, STORE)) as made:
            self.fill(made)
        self.files = {path.name: path.read_bytes() for path in (folder / CATALOG).iterdir()}

    def fill(self, catalog: Catalog) -> None:
        for model in self.models:
            model.put(catalog)
            catalog.put_damage(model.id, self.damage)
            catalog.note_bounds("x", model.entry, (-1.5, 2))

    def check(self, catalog: Catalog) -> bool:
        """That nothing that it says is wrong; returns whether it says all."""
        summaries = {one.id: one for one in catalog.summaries()}
        assert summaries.items() <= {m.id: m.described.summary for m in self.models}.items()
        complete = len(summaries) == len(self.models)
        same = catalog.with_fingerprint("f")
        assert same is None or same in [model.entry for model in self.models]
        for model in self.models:
            row = catalog.recording(model.id)
            assert row in (None, (f"looks of {model.id}", model.entry))
            damage = catalog.damage(model.id)
            assert damage in ({}, self.damage)
            decoded = decoded_of(catalog, model)
            assert all(
                one in (None, want) for one, want in zip(decoded, decoded_in(model), strict=True)
            )
            complete &= row is not None and bool(damage) and None not in decoded
            if model.id in summaries:
                assert {*catalog.topics(summaries[model.id].topics)} == model.described.topics
        assert catalog.bounds("x").items() <= {m.id: (-1.5, 2) for m in self.models}.items()
        known = {schema_hash(s): s for s in SCHEMAS.values() if s is not None}
        found = catalog.schemas(known)
        assert found.items() <= known.items()
        return complete and found == known


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return Truth(tmp_path_factory.mktemp("truth"))


def open_and_ask(truth: Truth, folder: Path, *, is_reported: bool = True) -> None:
    """Nothing wrong is said of a file that was changed, and it can be made again."""
    with closing(Catalog(folder, STORE)) as opened:
        complete = truth.check(opened)
        assert opened.was_damaged or not (complete or is_reported)
        opened.mend()
        assert opened.is_sound()
        truth.fill(opened)
        assert truth.check(opened)
    with closing(Catalog(folder, STORE)) as opened:
        assert truth.check(opened)
        assert opened.is_sound()
        assert not opened.was_damaged


def test_whatever_byte_of_a_part_changes_nothing_wrong_is_said(
    truth: Truth, tmp_path: Path
) -> None:
    rng = random.Random(5)
    content = truth.files["part-000000"]
    (tmp_path / CATALOG).mkdir()
    for name, data in truth.files.items():
        (tmp_path / CATALOG / name).write_bytes(data)
    for spot in sorted({*rng.sample(range(len(content)), 30), *range(0, 70, 10)}):
        data = bytearray(content)
        data[spot] ^= rng.choice([1, 1 << rng.randrange(8), 0xFF])
        (tmp_path / CATALOG / "part-000000").write_bytes(data)
        try:
            # A part with another head may be one of another store.
            open_and_ask(truth, tmp_path, is_reported=spot > content.index(b"\n"))
        except Exception as error:
            raise AssertionError(f"byte {spot} of {len(data)}") from error


@pytest.mark.parametrize("kind", ["zeros", "lines", "cut", "empty", "text", "folder", "link"])
def test_whatever_is_lost_of_a_part_nothing_wrong_is_said(
    truth: Truth, tmp_path: Path, kind: str
) -> None:
    content = truth.files["part-000000"]
    (tmp_path / CATALOG).mkdir()
    path = tmp_path / CATALOG / "part-000000"
    lines = content.splitlines(keepends=True)
    changed = {
        "zeros": content[:200] + bytes(500) + content[700:],
        "lines": b"".join(lines[:3] + lines[4:]),
        "cut": content[: len(content) // 2],
        "text": b"what somebody has written\n" * 50,
    }
    for name, data in truth.files.items():
        if name != path.name:
            path.with_name(name).write_bytes(data)
    if kind == "folder":
        path.mkdir()
    elif kind == "link":
        path.symlink_to("elsewhere")
    else:
        path.write_bytes(changed.get(kind, b""))
    open_and_ask(truth, tmp_path)


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


@pytest.mark.parametrize("kind", [SUMMARY, ENTRY, DAMAGE, TOPICS, f"{STAMPS}0", f"{BOUNDS}x"])
def test_a_forged_line_is_no_error(truth: Truth, tmp_path: Path, kind: str) -> None:
    """Its checksum is right. Of types that do not fit nothing is believed."""
    folder = tmp_path / CATALOG
    folder.mkdir()
    for name, data in truth.files.items():
        (folder / name).write_bytes(data)
    content = PartContent.from_bytes(STORE, truth.files["part-000000"])
    recording = truth.models[0].id
    if kind == TOPICS:
        ((key, text),) = [(k, t) for k, t in content.shared.items() if k[0] == TOPICS]
        texts: Iterator[str] = (json.dumps(one) for one in changed_anywhere(json.loads(text)))
    elif kind.startswith(STAMPS):
        digest, _, rows = content.rows[recording][kind].partition(" ")
        bomb = b64encode(compress(bytes(1 << 24))).decode()
        texts = iter((digest, f"{digest} x", f"{digest} {rows[:-8]}", f"{digest} {bomb}", rows))
    else:
        first, _, rest = content.rows[recording][kind].partition(" ")
        head, text = (f"{first} ", rest) if kind == SUMMARY else ("", f"{first} {rest}".strip())
        texts = (head + json.dumps(one) for one in changed_anywhere(json.loads(text)))
    for forged in some_of(texts, 150):
        if kind == TOPICS:
            content.shared[key] = forged
        else:
            content.rows[recording][kind] = forged
        (folder / "part-000000").write_bytes(content.to_bytes(STORE))
        with closing(Catalog(tmp_path, STORE)) as opened:
            known = {one.id: one for one in opened.summaries()}
            for one in known.values():
                assert opened.topics(one.topics)
                assert one.span is None or all(type(time) is int for time in one.span)
                assert [type(value) for value in one if value is not None] == [
                    type(value)
                    for value, has in zip(truth.models[0].described.summary, one, strict=True)
                    if has is not None
                ]
            assert known.keys() <= {model.id for model in truth.models}
            opened.with_fingerprint("f")
            row = opened.recording(recording)
            if row is not None:
                assert types_of(row[1]) == types_of(truth.models[0].entry)
                for channel in row[1].channels:
                    assert type(channel.stats.messages) is type(channel.id) is int
                    assert type(channel.topic) is type(channel.message_encoding) is str
            opened.damage(recording)
            for ends in opened.bounds("x").values():
                assert ends == (None, None) or {*map(type, ends)} <= {int, float}
            decoded = decoded_of(opened, truth.models[0])
            wanted = decoded_in(truth.models[0])
            assert all(one in (None, it) for one, it in zip(decoded, wanted, strict=True))


def types_of(entry: RecordingEntry) -> list[type]:
    return [type(getattr(entry, name)) for name in entry.__slots__]


def some_of(texts: Iterator[str], count: int) -> list[str]:
    everything = [*texts]
    return random.Random(7).sample(everything, min(count, len(everything)))


@pytest.mark.parametrize("change", ["gone", "empty", "changed", "another"])
def test_a_schema_that_is_lost_is_written_again(truth: Truth, tmp_path: Path, change: str) -> None:
    (tmp_path / CATALOG).mkdir()
    for name, data in truth.files.items():
        (tmp_path / CATALOG / name).write_bytes(data)
    one, other, *_ = sorted((tmp_path / CATALOG).glob("schema-*"))
    if change == "gone":
        one.unlink()
    else:
        changed = {"changed": one.read_bytes() + b"x", "another": other.read_bytes()}
        one.write_bytes(changed.get(change, b""))
    with closing(Catalog(tmp_path, STORE)) as opened:
        assert not truth.check(opened)
        truth.fill(opened)
        assert truth.check(opened)


# Files that are not ours.


@pytest.mark.parametrize("old", ["store", "version"])
def test_a_part_of_another_catalog_is_removed(tmp_path: Path, model: Model, old: str) -> None:
    path = tmp_path / CATALOG / "part-000000"
    with closing(Catalog(tmp_path, STORE)) as made:
        model.put(made)
    if old == "version":
        now = b"catalog %d" % VERSION
        path.write_bytes(path.read_bytes().replace(now, b"catalog %d" % (VERSION - 1), 1))
    with closing(Catalog(tmp_path, STORE if old == "version" else "6" * 32)) as other:
        assert rows_of(other) == {}
        assert not other.was_damaged
        another = Model(2, "another")
        another.put(other)
        assert rows_of(other).keys() == {another.id}
        assert model.id.encode() not in path.read_bytes()


def test_files_that_are_left_over_are_removed(tmp_path: Path, model: Model) -> None:
    (tmp_path / CATALOG).mkdir()
    (tmp_path / CATALOG / ".part-000000.0123").write_bytes(b"half")
    with closing(Catalog(tmp_path, STORE)) as made:
        model.put(made)
        assert {path.name[:5] for path in (tmp_path / CATALOG).iterdir()} == {"part-", "schem"}


@pytest.mark.parametrize("target", ["folder", "nothing"])
def test_a_symlink_in_its_place_is_refused(tmp_path: Path, target: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    if target == "folder":
        elsewhere.mkdir()
    store = tmp_path / "store"
    store.mkdir()
    (store / CATALOG).symlink_to(elsewhere)
    with pytest.raises(StoreError, match=CATALOG):
        Catalog(store, STORE)
    assert not elsewhere.exists() or not [*elsewhere.iterdir()]


def test_a_symlink_to_the_store_is_no_hindrance(tmp_path: Path, model: Model) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with closing(Catalog(tmp_path / "link", STORE)) as made:
        model.put(made)
    with closing(Catalog(tmp_path / "real", STORE)) as same:
        assert rows_of(same).keys() == {model.id}


def test_one_in_memory_takes_the_place_of_a_locked_one(
    tmp_path: Path, model: Model, limit: Limit
) -> None:
    """Somebody writes for longer than one waits: that is told, and nothing is deleted."""
    limit(catalog_busy_s=0.05)
    other = Model(2, "other")
    with closing(Catalog(tmp_path, STORE)) as made:
        model.put(made)
        with DiskFolder(tmp_path / CATALOG).lock(0):
            assert made.locked is None
            other.put(made)
            assert made.locked == tmp_path / CATALOG
            assert made.is_in_memory
            assert not made.was_damaged
            assert rows_of(made).keys() == {model.id, other.id}
            made.rebuild()
            assert rows_of(made) == {}
    with closing(Catalog(tmp_path, STORE)) as same:
        assert rows_of(same).keys() == {model.id}
        assert same.locked is None


class Failing(files.System):
    """A disk that is full, or a process that is stopped, when a part is written."""

    def __init__(self, error: BaseException) -> None:
        self._error = error

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        super().writev(fd, [parts[0][:10]])
        raise self._error


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(errno.ENOSPC, "full"), DiskFullError),
        (OSError(errno.EIO, "broken"), StoreError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
    ids=["full", "broken", "interrupted"],
)
def test_a_change_that_fails_leaves_it_as_it_was(
    catalog: Catalog,
    model: Model,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    told: type[BaseException],
) -> None:
    model.put(catalog)
    again = Model(3, segments=2)
    again.id = again.entry.id = model.id
    with monkeypatch.context() as patch:
        patch.setattr(files, "system", Failing(error))
        for one in (again, Model(4, "other")):
            with pytest.raises(told):
                one.put(catalog)
    for opened in (catalog, Catalog(tmp_path, STORE)):
        assert rows_of(opened) == {model.id: (f"looks of {model.id}", model.entry)}
        assert decoded_of(opened, model) == decoded_in(model)
    again.put(catalog)
    assert rows_of(catalog)[model.id][1] == again.entry


# Several at once.


def test_two_that_have_it_open_see_what_the_other_does(tmp_path: Path, model: Model) -> None:
    with closing(Catalog(tmp_path, STORE)) as one, closing(Catalog(tmp_path, STORE)) as other:
        model.put(one)
        assert rows_of(other).keys() == {model.id}
        assert decoded_of(other, model) == decoded_in(model)
        other.remove(model.id)
        assert rows_of(one) == {}
        model.put(other)
        one.rebuild()
        assert rows_of(other) == {}
        model.put(other)
        assert decoded_of(one, model) == decoded_in(model)


WRITER = """
import sys
from pathlib import Path
from tests.storage.test_catalog import STORE, Catalog, Model, decoded_in, decoded_of, rows_of

first, count = int(sys.argv[2]), int(sys.argv[3])
catalog = Catalog(Path(sys.argv[1]), STORE)
for number in range(first, first + count):
    model = Model(number, f"run{number}", segments=2, chunks=3)
    model.put(catalog)
    catalog.put_damage(model.id, {(0, number): "x"})
    assert decoded_of(catalog, model) == decoded_in(model)
    assert rows_of(catalog)[model.id][1] == model.entry
    if number % 5 == 0:
        catalog.remove(model.id)
print("done")
"""


def test_two_processes_write_at_the_same_time(tmp_path: Path) -> None:
    """From the first moment on: they also make the folder at the same time."""
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
            assert decoded_of(opened, model) == decoded_in(model)
            assert len(opened.damage(model.id)) == 1


def test_several_threads_use_one(catalog: Catalog) -> None:
    failures: list[BaseException] = []

    def use(first: int) -> None:
        try:
            for number in range(first, first + 10):
                model = Model(number, f"run{number}", segments=2, chunks=3)
                model.put(catalog)
                assert decoded_of(catalog, model) == decoded_in(model)
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
