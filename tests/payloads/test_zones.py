"""Zones exclude row groups only if no row of them can match."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.payloads import writer
from hybridlog.payloads.zones import MAX_REGIONS, Zone, may_hold
from hybridlog.query.predicate.parser import parse
from hybridlog.schema.column import offsets
from hybridlog_storage.segment_writer import SegmentSettings
from tests.payloads.logs import BASE, COUNT, SCAN, STEP, scan, write_log

FLOATS = st.one_of(st.floats(width=32), st.sampled_from([math.inf, -math.inf, math.nan, 0.0, 1.0]))


def zone_of(rows: list[list[float]]) -> Zone:
    bounds = offsets(np.array([len(row) for row in rows], np.int64))
    values = np.array([value for row in rows for value in row], np.float32)
    return Zone.of(values, bounds)


@given(
    rows=st.lists(st.lists(FLOATS, max_size=70), min_size=1, max_size=6),
    order=st.sampled_from(["<", "<=", ">", ">=", "=="]),
    wanted=FLOATS.filter(math.isfinite),
    element=st.integers(0, 80),
)
def test_no_match_is_excluded(
    rows: list[list[float]], order: str, wanted: float, element: int
) -> None:
    zone = Zone.from_json(zone_of(rows).to_json())
    zones = {"a": zone}
    compare = {
        "<": lambda v: v < wanted,
        "<=": lambda v: v <= wanted,
        ">": lambda v: v > wanted,
        ">=": lambda v: v >= wanted,
        "==": lambda v: v == wanted,
    }[order]
    exact = [[float(np.float32(v)) for v in row] for row in rows]
    text = repr(wanted)
    if any(compare(v) for row in exact for v in row):
        assert may_hold(parse(f"a {order} {text}").root, zones)
    if any(compare(row[element]) for row in exact if len(row) > element):
        assert may_hold(parse(f"a[{element}] {order} {text}").root, zones)
    finite = [[v for v in row if math.isfinite(v)] for row in exact]
    for name, summary in (("min", min), ("max", max)):
        if any(compare(summary(row)) for row in finite if row):
            assert may_hold(parse(f"a.{name} {order} {text}").root, zones)


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
        read = {}
        for text in ("ranges[350] < 0.5", "ranges[20] < 0.5", "ranges[10] < 1.05", "ranges < 0.5"):
            query = opened.topic("scan").where(text)
            planner = Planner(opened.session, query.question, query.counters)
            (part,) = planner.parts()
            counts = [engine.count([part]) for engine in (planner._scan, planner._columns)]
            assert counts[0] == counts[1]
            query.counters.bytes_read = 0
            found = list(planner._columns.outcomes(part))
            assert sum(len(one.holds) for one in found) == COUNT
            assert sum(int(one.holds.sum()) for one in found) == counts[0]
            query.counters.bytes_read = 0
            planner._columns.count([part])
            read[text] = counts[0], query.counters.bytes_read
        assert read["ranges[20] < 0.5"] == (0, 0)
        assert read["ranges[350] < 0.5"][0] == read["ranges < 0.5"][0] == 5
        assert 0 < read["ranges[350] < 0.5"][1] < read["ranges[10] < 1.05"][1] / 5
