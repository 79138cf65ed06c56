"""Counts by pixel against counts of queries, and what they cost."""

from __future__ import annotations

import random
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from numpy.typing import NDArray

import hybridlog as hl
from hybridlog.drawing import density_cache
from hybridlog.drawing.chunk_parts import RecordedChunks
from hybridlog.drawing.density import count, density, reading_work
from hybridlog.drawing.density_cache import DensityCache
from hybridlog_storage.cache import Cache
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.errors import TopicError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.open_segment import Flushed
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.calls import Calls
from tests.waiting import wait_for

from .conftest import BASE, MS

LENGTH = 4000 * MS
SETTINGS = SegmentSettings(chunk_size=4096, segment_size=60_000, compression="none")


def _times() -> dict[str, list[int]]:
    rng = random.Random(7)
    return {
        "/steady": [BASE + n * 2 * MS + rng.randrange(MS) for n in range(2000)],
        "/burst": [BASE + 1000 * MS + n // 40 for n in range(700)],
        "/rare": [BASE, BASE + 1999 * MS, BASE + LENGTH - 1],
        "/late": [BASE + rng.randrange(LENGTH) for _ in range(300)],
        "/large": [BASE + n * 100 * MS for n in range(40)],
        "/one": [BASE + 5],
        "/two": [BASE + 5, BASE + 7 * MS],  # in one chunk
    }


TIMES = _times()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    folder = tmp_path_factory.mktemp("density")
    # In order of arrival; late messages come later than newer ones.
    sent = sorted(
        (t + (700 * MS if topic == "/late" else 0), t, topic)
        for topic, times in TIMES.items()
        for t in times
    )
    with (folder / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Any", "jsonschema", b"{}")
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in TIMES}
        for _, t, topic in sent:
            text = "x" * (3000 if topic == "/large" else 20)
            writer.add_message(channels[topic], t, f'"{text}"'.encode(), t)
        writer.finish()
    with hl.open(folder / "store", create=True) as opened:
        opened.record(folder / "a.mcap", settings=SETTINGS)
        assert opened.entry("a").segments > 2
        yield opened


def _truth(topic: str, edges: NDArray[np.int64]) -> NDArray[np.intp]:
    return np.diff(np.searchsorted(sorted(TIMES[topic]), edges))


SPANS = st.tuples(
    st.integers(-LENGTH // 4, LENGTH + LENGTH // 4),
    st.one_of(st.integers(1, 2 * LENGTH), st.integers(1, 1000), st.just(LENGTH)),
).map(lambda both: (BASE + both[0], BASE + sum(both)))


@given(span=SPANS, pixels=st.integers(1, 300), number=st.integers(0, 299))
@settings(max_examples=40)
def test_pixels_have_what_queries_count(
    store: hl.Store, span: tuple[int, int], pixels: int, number: int
) -> None:
    found = density(store.session, store.entry("a"), span, pixels)
    assert found.topics == tuple(sorted(TIMES))
    assert (found.edges[0], found.edges[-1], len(found.edges)) == (*span, pixels + 1)
    assert np.ptp(np.diff(found.edges)) <= 1
    assert found.exact.all()
    for topic, counts in zip(found.topics, found.counts, strict=True):
        assert (counts == _truth(topic, found.edges)).all()
    begin, end = found.edges[number % pixels : number % pixels + 2].tolist()
    if begin < end and begin < BASE + LENGTH and end > BASE:  # queries refuse other times
        for topic in ("/steady", "/late"):
            pixel = found.counts[found.topics.index(topic), number % pixels]
            assert pixel == store.topic(topic).between(begin, end).count()


@given(st.lists(st.tuples(SPANS, st.sampled_from([1, 9, 250, 2000])), min_size=1, max_size=6))
@settings(max_examples=40)
def test_zooming_and_panning_change_nothing(
    store: hl.Store, views: list[tuple[tuple[int, int], int]]
) -> None:
    cache = DensityCache(store.shared)
    for span, pixels in views:
        found = cache.density(store.entry("a"), span, pixels, ["/late", "/steady"])
        widths = np.diff(found.edges)
        assert found.edges[0] <= span[0] < found.edges[1]
        assert found.edges[-2] < span[1] <= found.edges[-1]
        assert len(widths) <= pixels + 1
        assert widths[0] == 1 or (span[1] - span[0]) / widths[0] > pixels / 2
        assert (widths == widths[0]).all()
        assert widths[0] & (widths[0] - 1) == 0
        assert found.edges[0] % widths[0] == 0
        for row, topic in enumerate(("/late", "/steady")):
            assert (found.counts[row] == _truth(topic, found.edges)).all()


def test_the_ends_of_time(store: hl.Store) -> None:
    cache = DensityCache(store.shared)
    for span in ((0, 2**63 - 1), (2**63 - 3, 2**63 - 1), (0, 1)):
        for pixels in (1, 1000):
            found = cache.density(store.entry("a"), span, pixels, ["/steady"])
            wanted = 2000 if span == (0, 2**63 - 1) else 0
            assert (found.counts.sum(), found.exact.all()) == (wanted, True)
            plain = density(store.session, store.entry("a"), span, pixels, ["/steady"])
            assert plain.counts.sum() == wanted


def test_a_small_cache_forgets_and_stays_right(store: hl.Store) -> None:
    shared = store.shared
    before, shared.cache = shared.cache, Cache(20_000)
    try:
        cache = DensityCache(shared)
        for begin in range(0, LENGTH, LENGTH // 16):
            span = BASE + begin, BASE + begin + LENGTH // 16
            found = cache.density(store.entry("a"), span, 500, sorted(TIMES))
            for topic, counts in zip(found.topics, found.counts, strict=True):
                assert (counts == _truth(topic, found.edges)).all()
    finally:
        shared.cache = before


class Reads:
    """Counts the chunks whose message indexes are read; nothing else may be read of a chunk."""

    def __init__(self, calls: Calls) -> None:
        self.read = calls(SegmentReader, "read_times")
        calls.fail(SegmentReader, "read_chunk", AssertionError("a payload was read"))

    def of(self, cache: DensityCache, store: hl.Store, span: tuple[int, int]) -> int:
        self.read.clear()
        cache.density(store.entry("a"), span, 100, ["/steady", "/rare"])
        return len(self.read)


def test_the_cost_is_that_of_the_span(store: hl.Store, calls: Calls) -> None:
    reads = Reads(calls)
    cache = DensityCache(store.shared)
    store.session.cache.drop("recording")  # of other tests
    store.session.cache.drop("density")
    whole = (BASE, BASE + LENGTH)
    narrow = (BASE + LENGTH // 3, BASE + LENGTH // 3 + 20 * MS)
    # A narrow span reads the chunks around it, wherever it is.
    assert 0 < reads.of(cache, store, narrow) <= 8
    assert reads.of(cache, store, narrow) == 0
    assert reads.of(cache, store, whole) > 20
    assert reads.of(cache, store, whole) == 0
    # Zooming in reads nothing until pixels are eight times as narrow.
    for steps in (1, 2, 3):
        assert reads.of(cache, store, (BASE, BASE + (LENGTH >> steps))) == 0


def test_chunks_within_a_pixel_are_not_read(store: hl.Store, calls: Calls) -> None:
    reads = Reads(calls)
    found = density(store.session, store.entry("a"), (BASE - LENGTH, BASE + 2 * LENGTH), 1)
    assert (len(reads.read), found.counts.sum()) == (0, sum(map(len, TIMES.values())))


def test_usual_periods(store: hl.Store) -> None:
    """Of messages in chunks of many, and in chunks of their own."""
    topics = ["/steady", "/large", "/one"]
    span = BASE, BASE + LENGTH
    steady, large, one = DensityCache(store.shared).periods(store.entry("a"), span, topics)
    steps = np.diff(np.sort(TIMES["/steady"]))
    assert steady == pytest.approx(np.quantile(steps, 0.9), rel=0.02)
    assert (large, one) == (100 * MS, 0)


def test_too_many_messages_are_estimated(store: hl.Store) -> None:
    chunks = RecordedChunks(store.session, store.entry("a"))
    topics = sorted(TIMES)
    edges = np.linspace(BASE - 10 * MS, BASE + LENGTH + 10 * MS, 400).astype(np.int64)
    exact, is_exact = count(chunks, topics, edges)
    work = reading_work(chunks, topics, edges)
    assert work > 1000
    assert (count(chunks, topics, edges, most_work=work)[0] == exact).all()
    counts, is_right = count(chunks, topics, edges, most_work=work - 1)
    assert is_exact.all()
    right = dict(zip(topics, is_right.tolist(), strict=True))
    assert not right["/steady"]
    assert not right["/late"]
    assert right["/one"]
    assert right["/large"]
    assert (counts[is_right] == exact[is_right]).all()
    assert (counts.sum(axis=1) == exact.sum(axis=1)).all()
    steady = topics.index("/steady")
    assert np.abs(counts[steady] - exact[steady]).max() <= 2
    assert (counts >= 0).all()
    # Cut at both sides: the estimate is of the share inside.
    middle = BASE + np.arange(1000, 2001, 500) * MS
    some = count(chunks, ["/steady"], middle, most_work=0)[0][0]
    assert np.abs(some - 250).max() <= 3


def test_damaged_message_indexes(store: hl.Store, tmp_path: Path) -> None:
    skipped = shutil.ignore_patterns("mongod*")
    shutil.copytree(store.directory.path, tmp_path / "store", ignore=skipped)
    with hl.open(tmp_path / "store") as damaged:
        entry = damaged.entry("a")
        segment = entry.spans[1][0]
        table = damaged.session.chunk_table(entry, segment)
        chunk = table.chunks[len(table.chunks) // 2]
        path = places.segment(damaged.directory.path, "a", segment)
        content = bytearray(path.read_bytes())
        # Both the messages and their indexes: nothing tells the times any more.
        for place in (int(chunk["offset"]) + 60, int(chunk["offset"] + chunk["length"]) + 20):
            content[place] ^= 0xFF
        path.write_bytes(content)
        found = density(damaged.session, entry, (BASE, BASE + LENGTH), 500)
        steady = found.topics.index("/steady")
        assert not found.exact[steady]
        assert found.counts[steady].sum() == len(TIMES["/steady"])
        wrong = found.counts[steady] != _truth("/steady", found.edges)
        begin, end = (np.searchsorted(found.edges, int(chunk[n])) for n in ("first", "last"))
        assert not wrong[: begin - 1].any()
        assert not wrong[end + 1 :].any()


A, B = (Channel(name, "json", None) for name in ("/a", "/b"))


def test_a_recording_that_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is flushed counts once, and sealing changes nothing."""
    settings = SegmentSettings(chunk_size=4096, segment_size=30_000, compression="none")
    span = BASE, BASE + 1000
    added: list[int] = []
    count = density_cache.count

    def counted(chunks: RecordedChunks, *args: Any, since: int = 0) -> Any:
        added.append(chunks.size - since)
        return count(chunks, *args, since=since)

    monkeypatch.setattr(density_cache, "count", counted)
    with (
        hl.open(tmp_path / "store", create=True) as writing,
        writing.start("live", settings=settings, flush_interval_s=0.05) as recording,
        hl.open(tmp_path / "store") as store,
    ):
        cache = DensityCache(store.shared)
        with pytest.raises(TopicError, match="'/a'"):
            cache.density(store.entry("live"), span, 10, ["/a"])

        def live() -> RecordingEntry:
            return store.entry("live")

        def ask() -> NDArray[np.int64]:
            return cache.density(store.entry("live"), span, 1000, ["/a", "/b"]).counts

        written = 0
        for channel, messages in ((A, 100), (B, 60), (A, 1500)):
            for _ in range(messages):
                recording.write(channel, b"[1, 2, 3]", log_time=BASE + written // 2)
                written += 1
            # Segments are sealed meanwhile.
            wait_for(lambda n=written: (n <= 160 or len(ask())) and live().messages == n)
            if channel is B:
                assert ask().sum() == 160
        found = ask()
        assert found.sum() == written
        assert found[0][:50].tolist() == [2] * 50
        assert found[1][50:80].tolist() == [2] * 30
        entry = live()
        assert entry.flushed
        assert entry.digests
        parts = sum(len(store.session.chunk_table(entry, n).parts) for n, _, _ in entry.spans)
        # All topics are counted together, but for /b, which came later.
        assert sum(added) <= 2 * parts
        added.clear()
        assert (ask() == found).all()
        assert not added
        plain = density(store.session, entry, span, 1000, ["/a", "/b"])
        assert (plain.counts == found).all()
        recording.close()
        assert store.entry("live").status == "complete"
        assert (ask() == found).all()


def test_parts_of_chunks_are_known_as_they_come(store: hl.Store) -> None:
    entry = store.entry("a")
    topics = sorted(TIMES)
    span = BASE - MS, BASE + 2 * LENGTH
    (segment, first, last) = entry.spans[0]
    whole = store.session.chunk_table(entry, segment)
    reader = store.session.segment(entry.id, segment)
    assert (whole.chunks["parts"] > 1).any()

    def flushed(count: int) -> RecordingEntry:
        parts = whole.parts[: int(whole.chunks["parts"][:count].sum())]
        now = replace(whole, chunks=whole.chunks[:count], parts=parts, is_flushed=True)
        content = {segment: Flushed(now, (), (), reader)}
        spans = [(segment, first, last)]
        return replace(entry, status="open", digests={}, flushed=content, spans=spans)

    step = RecordedChunks(store.session, flushed(1))
    for known in range(1, len(whole.chunks) + 1):
        assert step.follow(flushed(known))
        found = step.parts(span, topics)
        wanted = RecordedChunks(store.session, flushed(known)).parts(span, topics)
        for name, column in found._asdict().items():
            assert column.tolist() == getattr(wanted, name).tolist(), (known, name)
    # On a full disk a writer takes back what it wrote last.
    longer = RecordedChunks(store.session, flushed(2))
    longer.load(span)
    assert not longer.follow(flushed(1))
    # A chunk of the same size and times, but of other messages.
    chunks = whole.chunks.copy()
    chunks["trailer_crc"][-1] ^= 1
    other = flushed(len(chunks))
    other.flushed[segment] = Flushed(replace(whole, chunks=chunks, is_flushed=True), (), (), reader)
    assert not RecordedChunks(store.session, other).parts(span, []).segment.size
    assert not step.follow(other)
    assert not step.follow(flushed(len(chunks)))
    assert step.follow(replace(entry, status="open"))
    assert step.parts(span, topics).messages.sum() == sum(map(len, TIMES.values()))
    digests = {number: f"{digest}?" for number, digest in entry.digests.items()}
    assert not step.follow(replace(entry, status="open", digests=digests))


def test_the_last_time_of_a_segment_is_in_it(store: hl.Store) -> None:
    entry = store.entry("a")
    for segment, first, last in entry.spans:
        for time_ns in (first, last):
            chunks = RecordedChunks(store.session, entry)
            found = chunks.parts((time_ns, time_ns + 1), sorted(TIMES))
            assert segment in found.segment
        for time_ns in (first - 1, last + 1):
            found = chunks.parts((time_ns, time_ns + 1), sorted(TIMES))
            assert segment not in found.segment
