"""A running recording answers from tables of sealed segments and from flushed chunks."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.live import LiveRecording
from hybridlog.sql.engine import SqlConnection
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.open_segment import OpenSegment
from hybridlog_storage.segments.segment_reader import SegmentReader, places_of
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.limits import Limit
from tests.sql.conftest import SCAN, scan
from tests.tables.logs import BASE, STATE, payload

LARGE = Channel("/large", "ros1", STATE)
OTHER = Channel("/base/scan", "ros1", SCAN)
JSON = Channel("/note", "json", None)
SETTINGS = SegmentSettings(chunk_size=16 << 10, segment_size=400 << 10, compression="none")
ROWS = "select count(*), count(distinct seq), min(i8), max(i8), sum(covariance[1]) from large"


@pytest.fixture
def reader(tmp_path: Path, limit: Limit) -> Iterator[tuple[LiveRecording, hl.Store]]:
    """A recording that goes on, and the store opened a second time."""
    limit(long_table_rows=1000)
    folder = tmp_path / "store"
    with hl.open(folder, create=True) as store:
        options = {"settings": SETTINGS, "flush_interval_s": 0.05}
        with store.start("live", **options) as recording:
            with hl.open(folder, mongo="mongodb://127.0.0.1:1/") as opened:
                yield recording, opened


def wait_for(store: hl.Store | SqlConnection, query: str, wanted: int) -> None:
    ask = store.sql if isinstance(store, hl.Store) else store.query
    until = time.monotonic() + 60
    found = -1
    while found != wanted:
        assert time.monotonic() < until, f"{found} of {wanted} rows"
        time.sleep(0.02)
        ((found,),) = ask(query).rows()


def test_flushed_chunks_answer(reader: tuple[LiveRecording, hl.Store]) -> None:
    recording, store = reader
    assert store.sql("select status from recordings").rows() == [("open",)]
    for n in range(300):
        recording.write(LARGE, payload(n, i8=n % 100), log_time=BASE + n)
    while not store.sql("select * from topics").rows():
        time.sleep(0.02)
    wait_for(store, "select count(*) from large", 300)
    store.session.cache.drop("chunk")
    answer = store.sql(ROWS)
    assert answer.rows() == [(300, 300, 0, 99, 75.0)]
    assert (answer.counts.row_groups, answer.counts.chunks > 1) == (0, True)
    # A new topic, and more of the first one.
    recording.write(OTHER, scan(7), log_time=BASE + 500)
    recording.write(JSON, b'{"a": {"b": 1}}', log_time=BASE + 501)
    recording.write(JSON, b'{"a": {"b": 2.5}, "c": "x"}', log_time=BASE + 502)
    wait_for(store, "select count(*) from topics where topic in ('/note', '/base/scan')", 2)
    messages = "select messages from topics where topic = '/large'"
    assert store.sql(messages).rows() == [(300,)]
    assert store.sql("select ranges[1], echo.far[2] from scan").rows() == [(7.0, 1.75)]
    wait_for(store, "select count(*) from note", 2)
    assert store.sql("select a.b, c from note order by t").rows() == [(1.0, None), (2.5, "x")]
    # A prompt, which asks again in one connection.
    connection = store.sql_engine.connect()
    wait_for(connection, "select count(*) from note", 2)
    recording.write(JSON, b"{}", log_time=BASE + 503)
    wait_for(connection, "select count(*) from note", 3)
    times = store.sql(f"select t from large where t >= {BASE + 290}")
    assert [t for (t,) in times.rows()] == [BASE + n for n in range(290, 300)]
    assert times.counts.chunks <= 2


def test_sealed_segments_answer_from_tables(reader: tuple[LiveRecording, hl.Store]) -> None:
    recording, store = reader
    count = 5000
    for n in range(count):
        recording.write(LARGE, payload(n, i8=n % 100), log_time=BASE + n)
    until = time.monotonic() + 60
    while not store.sql("select * from topics").rows():
        assert time.monotonic() < until
        time.sleep(0.02)
    while True:  # the tables follow the segments, and are seen with the next flush
        wait_for(store, "select count(*) from large", count)
        store.session.cache.drop("chunk")
        answer = store.sql("select count(*), count(distinct seq), min(i8), max(i8) from large")
        assert answer.rows() == [(count, count, 0, 99)]
        if answer.counts.row_groups and answer.counts.chunks:
            break
        assert time.monotonic() < until
        for n in range(count, count + 100):
            recording.write(LARGE, payload(n, i8=n % 100), log_time=BASE + n)
        count += 100
    entry = store.entry("live")
    chunks = store.session.chunks(entry, [c.id for c in entry.channels], None, "log")
    messages: Counter[int] = Counter()
    for chunk in chunks:
        messages[chunk.segment] += chunk.messages
    found = store.session.tables.of_sealed(entry, "/large", messages)
    assert found is not None
    assert found[0].rows == sum(messages[segment] for segment in found[1])
    for wrong in (1, -1):  # a file that just lacks its name, or has another's
        changed = messages | {min(found[1]): messages[min(found[1])] + wrong}
        assert store.session.tables.of_sealed(entry, "/large", changed) is None
    assert store.sql(ROWS).rows() == [(count, count, 0, 99, count * 0.25)]
    before = store.sql("select * from large order by t").to_arrow()
    report = recording.close()
    store.refresh()
    after = store.sql("select * from large order by t")
    assert after.to_arrow().equals(before)
    assert report.entry.messages == count
    counted = store.sql("select count(*) from large")
    counted.rows()
    assert (counted.counts.chunks, counted.counts.row_groups > 0) == (0, True)


def test_a_segment_is_read_up_to_its_last_whole_chunk(
    reader: tuple[LiveRecording, hl.Store], tmp_path: Path
) -> None:
    recording, store = reader
    for n in range(300):
        recording.write(LARGE, payload(n), log_time=BASE + n)
    while not (found := places.files(store.directory.path, "*.mcap.open")):
        time.sleep(0.02)
    recording.close()
    (sealed,) = places.folder(store.directory.path, "live").glob("*.mcap")
    with SegmentReader(sealed, 0) as whole:
        summary = whole.summary()
    data = sealed.read_bytes()
    ends = [place.offset + place.length + place.trailer for place in summary.chunks]
    path = tmp_path / found[0].name
    for cut in (0, 7, ends[0] - 1, ends[0], ends[1] - 1, ends[1], ends[1] + 5, len(data)):
        path.write_bytes(data[:cut])
        segment = OpenSegment(tmp_path, 0)
        segment.follow()
        count = sum(end <= cut for end in ends)
        table = segment.flushed.table
        for name in ("offset", "length", "trailer", "trailer_crc", "first", "last", "parts"):
            assert (table.chunks[name] == summary.table.chunks[name][:count]).all()
        parts = int(table.chunks["parts"].sum())
        for name in ("channel", "messages", "payload_bytes", "first", "last"):
            assert (table.parts[name] == summary.table.parts[name][:parts]).all()
        known = {number: str(summary.channels[number]) for number in segment.channels}
        assert {n: str(channel) for n, channel in segment.channels.items()} == known
        assert not count or known.keys() == summary.channels.keys()
        for place in places_of(table):
            assert len(segment.reader.read_chunk(place).batch) > 0
    path.write_bytes(data[: ends[0]] + bytes(4096))  # room reserved by its writer
    segment = OpenSegment(tmp_path, 0)
    segment.follow()
    assert len(segment.flushed.table.chunks) == 1
    flipped = bytearray(data[: ends[0]])
    flipped[summary.chunks[0].offset + 100] ^= 1
    path.write_bytes(flipped)
    segment = OpenSegment(tmp_path, 0)
    segment.follow()
    with pytest.raises(SegmentError, match="damaged"):
        segment.reader.read_chunk(places_of(segment.flushed.table)[0])
    with pytest.raises(SegmentError):
        OpenSegment(tmp_path, 9)
    (tmp_path / "000008.mcap.open").mkdir()
    with pytest.raises(SegmentError):
        OpenSegment(tmp_path, 8)
