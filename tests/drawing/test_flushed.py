"""Messages of a running recording, while it is written and after a segment is sealed."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.drawing.flushed import END, Flushed, FlushedMessages
from hybridlog.drawing.log import Log, kind_of
from hybridlog.drawing.series import series
from hybridlog.live import LiveRecording
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segment_writer import SegmentSettings
from tests.odd_messages import MS, START

SAID = Channel("/said", "json", Schema("foxglove.Log", "jsonschema", b"{}"))
OTHER = Channel("/other", "json", None)
COUNT = 300


def message(n: int) -> dict[str, object]:
    said = {"level": n % 5 + 1, "message": f"said {n}", "name": "it", "n": n, "list": [n, 2 * n]}
    return said | {"pad": "." * 1000}


def time_of(n: int) -> int:
    """Three messages at each time; each tenth one is 40 ms late."""
    return START + n // 3 * 10 * MS - (40 * MS if n % 10 == 0 and n else 0)


ORDER = sorted(range(COUNT), key=lambda n: (time_of(n), n))


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LiveRecording, hl.Store]]:
    path = tmp_path_factory.mktemp("running") / "store"
    # Segments are sealed on the way, which a store sees that looks again.
    settings = SegmentSettings(chunk_size=1024, segment_size=1 << 16, compression="none")
    with (
        hl.open(path, create=True) as writing,
        writing.start("live", settings=settings, flush_interval_s=0.05) as recording,
        hl.open(path) as store,
    ):
        following = FlushedMessages(store.session)
        for n in range(COUNT):
            recording.write(SAID, json.dumps(message(n)).encode(), log_time=time_of(n))
            recording.write(OTHER, b"{}", log_time=time_of(n))
        until = time.monotonic() + 60
        # What is followed from the beginning is the same as what is read at once.
        while following.of(store.entry("live"), "/said").count < COUNT:
            assert time.monotonic() < until
            time.sleep(0.02)
        now = following.of(store.entry("live"), "/said")
        assert numbers(now.messages((0, END))) == ORDER
        yield recording, store


def flushed(store: hl.Store, topic: str = "/said") -> Flushed:
    return FlushedMessages(store.session).of(store.entry("live"), topic)


def numbers(messages: Iterator[hl.Message]) -> list[object]:
    return [one.fields["n"] for one in messages]


def test_messages_are_in_order_both_ways(running: tuple[LiveRecording, hl.Store]) -> None:
    _, store = running
    found = flushed(store)
    assert found.span == (time_of(ORDER[0]), time_of(ORDER[-1]) + 1)
    assert numbers(found.messages((0, END))) == ORDER
    assert numbers(found.messages((0, END), reverse=True)) == ORDER[::-1]
    begin, end = START + 55 * 10 * MS, START + 70 * 10 * MS
    inside = [n for n in ORDER if begin <= time_of(n) < end]
    assert numbers(found.messages((begin, end))) == inside
    assert numbers(found.messages((begin, end), reverse=True)) == inside[::-1]
    assert not list(found.messages((0, time_of(ORDER[0]))))
    none = flushed(store, "/nothing")
    assert (none.channels, none.span, none.count) == ([], None, 0)


def test_lines_and_series_are_those_of_a_query(running: tuple[LiveRecording, hl.Store]) -> None:
    _, store = running
    log = Log(None, kind_of("foxglove.Log"), flushed=flushed(store))
    found, place = [], (0, -1)
    while lines := log.after(*place, 7):
        found += lines
        place = lines[-1].time, lines[-1].seq
    assert [line.text for line in found] == [f"said {n}" for n in ORDER]
    assert log.before(*place, 3) == found[-4:-1]
    assert log.count() == COUNT
    some = Log(None, log.kind, "error", "SAID 1", log.flushed)
    wanted = [f"said {n}" for n in ORDER if n % 5 >= 3 and f"{n}".startswith("1")]
    assert [line.text for line in some.after(0, -1, COUNT)] == wanted
    assert some.count() is None
    (n, second) = series(None, ["n", "list[1]"], pixels=COUNT, flushed=flushed(store))
    assert n.exact
    kept = ~np.isnan(n.least)
    assert n.times[kept].tolist() == [time_of(n) for n in ORDER]
    assert n.least[kept].tolist() == ORDER
    assert second.least[kept].tolist() == [2 * n for n in ORDER]
    (coarse,) = series(None, ["n"], pixels=10, flushed=flushed(store))
    assert (np.nanmin(coarse.least), np.nanmax(coarse.greatest)) == (0, COUNT - 1)
    with pytest.raises(UsageError, match="no number"):
        series(None, ["message"], pixels=10, flushed=flushed(store))


def test_sealed_and_flushed_messages_meet(running: tuple[LiveRecording, hl.Store]) -> None:
    _, store = running
    store.refresh()
    rest = flushed(store)
    assert 0 < rest.count < COUNT
    query = store.query(["/said"])
    assert query.count() == COUNT - rest.count
    log = Log(query, kind_of("foxglove.Log"), flushed=rest)
    wanted = [f"said {n}" for n in ORDER]
    for count in (7, COUNT):
        found, place = [], (0, -1)
        while lines := log.after(*place, count):
            found += lines
            place = lines[-1].time, lines[-1].seq
        assert [line.text for line in found] == wanted
        back, place = [], (END - 1, 0)
        while lines := log.before(*place, count):
            back = lines + back
            place = lines[0].time, lines[0].seq
        assert [line.text for line in back] == wanted
    assert log.count() == COUNT
    (n,) = series(query, ["n"], pixels=COUNT, flushed=rest)
    kept = ~np.isnan(n.least)
    assert n.least[kept].tolist() == ORDER
    begin, end = time_of(60), time_of(290)
    (n,) = series(query, ["n"], pixels=COUNT, span=(begin, end), flushed=rest)
    kept = ~np.isnan(n.least)
    assert n.least[kept].tolist() == [n for n in ORDER if begin <= time_of(n) < end]


def test_what_a_query_sees_is_not_seen_twice(running: tuple[LiveRecording, hl.Store]) -> None:
    recording, store = running
    recording.close()
    # The entry is from before the last segment was sealed; that is read all the same.
    sealed = store.topic("/said").count()
    assert flushed(store).count == COUNT - sealed
    store.refresh()
    assert flushed(store).count == 0
    assert store.topic("/said").count() == COUNT
