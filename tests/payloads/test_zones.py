"""Zones exclude row groups only if no row of them can match."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.columns import payload_writer as writer
from hybridlog.columns.zones import MAX_REGIONS, Zone, may_hold
from hybridlog.query.engines import Need
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.to_bool import to_bool
from hybridlog.schema.column import offsets
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.payloads.logs import BASE, COUNT, SCAN, STEP, scan, write_log

FLOATS = st.one_of(st.floats(width=32), st.sampled_from([math.inf, -math.inf, math.nan, 0.0, 1.0]))


def zone_of(rows: list[list[float]]) -> Zone:
    bounds = offsets(np.array([len(row) for row in rows], np.int64))
    values = np.array([value for row in rows for value in row], np.float32)
    return Zone.of(values, bounds)


def is_slice(text: str) -> bool:
    begin, end = text[2:-1].split(":")
    return not end or int(begin or 0) < int(end)


COMPARISONS = st.builds(
    "{} {}".format,
    st.sampled_from(["<", "<=", ">", ">=", "==", "!="]),
    st.one_of(FLOATS.filter(math.isfinite).map(repr), st.sampled_from(["0", "1"])),
)
CONDITIONS = st.one_of(
    COMPARISONS, st.sampled_from(["== nan", "!= nan", "== inf", "== -inf", "== null", "exists"])
)
ENDS = st.one_of(st.just(""), st.integers(0, 80).map(str))
PLACES = st.one_of(
    st.just("a"),
    st.builds("a[{}]".format, st.integers(0, 80)),
    st.builds("a[{}:{}]".format, ENDS, ENDS).filter(is_slice),
)
STATS = st.sampled_from(["", "", ".min", ".max", ".mean", ".n"])


@settings(max_examples=400)
@given(
    rows=st.lists(st.lists(FLOATS, max_size=70), min_size=1, max_size=6),
    place=PLACES,
    stat=STATS,
    condition=CONDITIONS,
)
@example([[0.0] * 16 + [10.0] * 16], "a", ".mean", "== 5")
@example([[0.1] * 3], "a", ".mean", "> 0.1")
@example([[], []], "a", "", "!= 3")
@example([[math.nan]], "a", "", "== nan")
def test_no_match_is_excluded(
    rows: list[list[float]], place: str, stat: str, condition: str
) -> None:
    zones = {"a": Zone.from_json(zone_of(rows).to_json())}
    predicate = parse(f"{place}{stat} {condition}")
    holds = to_bool(predicate, {"a": "float32[]"})
    exact = [[float(np.float32(value)) for value in row] for row in rows]
    if any(holds({"a": row}) for row in exact):
        assert may_hold(predicate.root, zones)


def test_zones_are_by_region() -> None:
    row = np.concatenate([np.full(40, 5.0), np.full(40, 1.0), np.full(40, 9.0)])
    zones = {"a": zone_of([row.tolist(), row[:100].tolist()])}
    assert zones["a"].width == 16
    for text, expected in {
        "a[3] < 2": False,
        "a[50] < 2": True,
        "a[100] < 2": False,
        "a[500] > 0": False,
        "a < 1": False,
        "a <= 1": True,
        "a.max > 9": False,
        "a.min < 1": False,
        "a.mean > 9.5": False,
        "a == 20": False,
        "a != 20": True,
        "a.n > 500": True,
        "not a < 1": True,
        "a < 1 or b > 3": True,
        "a < 1 or a > 9": False,
        "a < 1 and b > 3": False,
        "a[3] == true": True,
        "a[40:80] < 2": True,
        "a[0:32] < 2": False,  # of the regions of 16 elements
        "a[:32].min < 2": False,
        "a[96:] < 2": False,
        "a[80:96] < 2": False,
        "a[79:96] < 2": True,
        "a[500:] > 0": False,
        "a[:32].mean > 6": False,
        "a[0:].mean < 0.5": False,
        "a[0:32].n > 500": True,
    }.items():
        assert may_hold(parse(text).root, zones) is expected, text


def test_there_are_few_regions_and_none_of_nothing() -> None:
    zone = Zone.of(np.arange(100_000), np.array([0, 100_000]))
    assert len(zone.low) <= MAX_REGIONS
    assert zone_of([[], []]).low == ()
    assert zone_of([[math.nan] * 20]).low == (None, None)
    for wrong in ([0, [], []], [8, [1], []], [8, ["x"], [1]], [8, [[]], [1]], "abc"):
        with pytest.raises((TypeError, ValueError)):
            Zone.from_json(wrong)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans of which only some in the middle are near, in many row groups."""
    path = tmp_path_factory.mktemp("zones")

    def ranges(n: int) -> np.ndarray:
        found = np.full(400, 5.0, np.float32)
        found[340:380] = 0.3 if 60 <= n < 65 else 4.0
        found[10] = 0.1 * (n % 7) + 1
        return found

    said = [("/scan", SCAN, BASE + n * STEP, scan(ranges(n), n=n)) for n in range(COUNT)]
    log = write_log(path / "log.mcap", said)
    with pytest.MonkeyPatch.context() as patch, hl.open(path / "store", create=True) as opened:
        patch.setattr(writer, "GROUP_BYTES", 8 << 10)
        opened.record(log, name="log", settings=SegmentSettings(chunk_size=4 << 10))
        opened.compact(topics=["scan"])
    return path / "store"


def test_only_row_groups_that_may_match_are_read(store: Path) -> None:
    from hybridlog.query.planner import Planner

    with hl.open(store) as opened:
        read, cost = {}, {}
        asked = ("ranges[350] < 0.5", "ranges[20] < 0.5", "ranges[10] < 1.05", "ranges < 0.5")
        slices = (
            "ranges[340:380] < 0.5",
            "ranges[340:380].min < 0.5",
            "ranges[20:40] < 0.5",
            "ranges > 0",
        )
        for text in (*asked, *slices):
            query = opened.topic("scan").where(text)
            planner = Planner(opened.session, query.question, query.counters)
            (part,) = planner.parts()
            cost[text] = planner._columns.cost(part, Need.COUNT) or math.inf
            counts = [engine.count([part]) for engine in (planner._scan, planner._columns)]
            assert counts[0] == counts[1]
            query.counters.bytes_read = 0
            found = list(planner._columns.outcomes(part))
            assert sum(len(one.holds) for one in found) == COUNT
            assert sum(int(one.holds.sum()) for one in found) == counts[0]
            query.counters.bytes_read = 0
            Planner(opened.session, query.question, query.counters)._columns.count([part])
            read[text] = counts[0], query.counters.bytes_read
        assert read["ranges[20] < 0.5"] == read["ranges[20:40] < 0.5"] == (0, 0)
        assert read["ranges[340:380] < 0.5"] == read["ranges[350] < 0.5"]
        assert read["ranges[340:380].min < 0.5"] == read["ranges[350] < 0.5"]
        assert read["ranges[350] < 0.5"][0] == read["ranges < 0.5"][0] == 5
        assert cost["ranges[20:40] < 0.5"] < cost["ranges[340:380] < 0.5"] < cost["ranges > 0"]
        query = opened.topic("scan").where("ranges[340:380] < 0.5")
        assert (query.count(), query.counters.chunks_read) == (5, 0)
        assert query.counters.bytes_read < read["ranges[10] < 1.05"][1] / 2
        assert 0 < read["ranges[350] < 0.5"][1] < read["ranges[10] < 1.05"][1] / 5


def test_sql_reads_each_row_group_once(store: Path) -> None:
    with hl.open(store) as opened:
        answer = opened.sql("select ranges[11], list_min(ranges[341:380]) from scan order by t")
        found = np.array(answer.rows(), np.float32)
        (file,) = opened.recordings()[0].payloads
        table = opened.session.arrays(opened.recordings()[0], file["topic"])
        assert table is not None
        groups = table.files[0].groups
        assert (answer.counts.chunks, answer.counts.row_groups) == (0, groups + 1)
    numbers = np.arange(COUNT)
    np.testing.assert_array_equal(found[:, 0], (0.1 * (numbers % 7) + 1).astype(np.float32))
    is_near = (numbers >= 60) & (numbers < 65)
    np.testing.assert_array_equal(found[:, 1], np.where(is_near, 0.3, 4.0).astype(np.float32))
