"""Pictures of a running recording: sealed segments and flushed chunks together."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.drawing.log import Log, kind_of
from hybridlog.drawing.series import series
from hybridlog.live import LiveRecording
from hybridlog.query.times import TIME_LIMIT
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.odd_messages import MS, START
from tests.waiting import wait_for

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
        for n in range(COUNT):
            recording.write(SAID, json.dumps(message(n)).encode(), log_time=time_of(n))
            recording.write(OTHER, b"{}", log_time=time_of(n))
        wait_for(lambda: store.entry("live").messages >= 2 * COUNT)
        assert store.entry("live").flushed
        assert store.entry("live").digests
        yield recording, store


def test_lines_are_in_order_both_ways(running: tuple[LiveRecording, hl.Store]) -> None:
    _, store = running
    log = Log(store.topic("/said"), kind_of("foxglove.Log"))
    wanted = [f"said {n}" for n in ORDER]
    for count in (7, COUNT):
        found, place = [], (0, -1)
        while lines := log.after(*place, count):
            found += lines
            place = lines[-1].time, lines[-1].seq
        assert [line.text for line in found] == wanted
        back, place = [], (TIME_LIMIT - 2, 0)
        while lines := log.before(*place, count):
            back = lines + back
            place = lines[0].time, lines[0].seq
        assert [line.text for line in back] == wanted
    assert log.count() == COUNT
    some = Log(log.query, log.kind, "error", "SAID 1")
    texts = [f"said {n}" for n in ORDER if n % 5 >= 3 and f"{n}".startswith("1")]
    assert [line.text for line in some.after(0, -1, COUNT)] == texts
    assert some.count() == len(texts)


def test_series_are_exact_and_coarse(running: tuple[LiveRecording, hl.Store]) -> None:
    _, store = running
    query = store.topic("/said")
    (n, second) = series(query, ["n", "list[1]"], pixels=COUNT)
    assert n.exact
    kept = ~np.isnan(n.least)
    assert n.times[kept].tolist() == [time_of(n) for n in ORDER]
    assert n.least[kept].tolist() == ORDER
    assert second.least[kept].tolist() == [2 * n for n in ORDER]
    (coarse,) = series(query, ["n"], pixels=10)
    assert (np.nanmin(coarse.least), np.nanmax(coarse.greatest)) == (0, COUNT - 1)
    with pytest.raises(UsageError, match="no number"):
        series(query, ["message"], pixels=10)
    begin, end = time_of(60), time_of(290)
    (n,) = series(query, ["n"], pixels=COUNT, span=(begin, end))
    kept = ~np.isnan(n.least)
    assert n.least[kept].tolist() == [n for n in ORDER if begin <= time_of(n) < end]
