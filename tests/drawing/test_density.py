"""Counts by pixel against counts of queries, and what they cost."""

from __future__ import annotations

import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import hybridlog as hl
from hybridlog.drawing.times import aligned, lane_of
from hybridlog.query.planner import Planner
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.calls import Calls
from tests.independent import write_mcap

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
    channels = {topic: Channel(topic, "json", None) for topic in TIMES}
    texts = {topic: b'"%s"' % (b"x" * (3000 if topic == "/large" else 20)) for topic in TIMES}
    write_mcap(folder / "a.mcap", [(channels[topic], t, texts[topic]) for _, t, topic in sent])
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
def test_pixels_have_what_queries_count(
    store: hl.Store, span: tuple[int, int], pixels: int, number: int
) -> None:
    edges = aligned(span, pixels)
    lanes = {topic: lane_of(store.session, store.entry("a"), topic) for topic in TIMES}
    for topic, lane in lanes.items():
        assert lane.exact
        assert (lane.counts(edges) == _truth(topic, edges)).all()
    number %= len(edges) - 1
    begin, end = edges[number : number + 2].tolist()
    if begin < end and begin < BASE + LENGTH and end > BASE:  # queries refuse other times
        for topic in ("/steady", "/late"):
            pixel = lanes[topic].counts(edges)[number]
            assert pixel == store.topic(topic).between(begin, end).count()


@given(span=SPANS, pixels=st.sampled_from([1, 9, 250, 2000]))
def test_zooming_and_panning_change_nothing(span: tuple[int, int], pixels: int) -> None:
    edges = aligned(span, pixels)
    widths = np.diff(edges)
    assert edges[0] <= span[0] < edges[1]
    assert edges[-2] < span[1] <= edges[-1]
    assert len(widths) <= pixels + 1
    assert widths[0] == 1 or (span[1] - span[0]) / widths[0] > pixels / 2
    assert (widths == widths[0]).all()
    assert widths[0] & (widths[0] - 1) == 0
    assert edges[0] % widths[0] == 0


def test_a_picture_reads_its_topics_once_and_no_payload(store: hl.Store, calls: Calls) -> None:
    store.session.cache.drop("times")  # of other tests
    calls.fail(SegmentReader, "read_chunk", AssertionError("a payload was read"))
    asked = calls(Planner, "parts")
    for span in ((BASE, BASE + LENGTH), (BASE + 100 * MS, BASE + 120 * MS)):
        for topic in ("/steady", "/rare"):
            lane_of(store.session, store.entry("a"), topic).counts(aligned(span, 100))
    assert len(asked) == 2


def test_too_many_messages_are_estimated(store: hl.Store) -> None:
    edges = aligned((BASE - 10 * MS, BASE + LENGTH + 10 * MS), 400)
    for topic, times in TIMES.items():
        lane = lane_of(store.session, store.entry("a"), topic, max_times=1999)
        assert lane.exact == (topic != "/steady")
        found = lane.counts(edges)
        assert found.sum() == len(times)
        assert np.abs(found - _truth(topic, edges)).max() <= (0 if lane.exact else 2)


def test_damaged_message_indexes(store: hl.Store, tmp_path: Path) -> None:
    skipped = shutil.ignore_patterns("mongod*", "tables")
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
        lane = lane_of(damaged.session, entry, "/steady")
        edges = np.arange(BASE, BASE + LENGTH + 1, LENGTH // 500)
        assert not lane.exact
        assert lane.counts(edges).sum() == len(TIMES["/steady"])
        wrong = lane.counts(edges) != _truth("/steady", edges)
        begin, end = (np.searchsorted(edges, int(chunk[n])) for n in ("first", "last"))
        assert not wrong[: begin - 1].any()
        assert not wrong[end + 1 :].any()
