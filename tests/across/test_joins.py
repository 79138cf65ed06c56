"""Random joins against a plain loop over what was written."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.across.match import UNKNOWN, match
from tests.limits import Limit
from tests.some import EXHAUSTIVE

from .conftest import MS, Logs, Said

TOPICS = ("/base", "/left/pose", "/right/pose")
CLOCKS: dict[str, Callable[[Said], int]] = {
    "log": lambda one: one.time,
    "publish": lambda one: one.stamp,
    "header": lambda one: one.stamp,
}


def naive(
    time: int, rows: list[int], how: str, tolerance: int | None
) -> tuple[int, int, int] | None:
    """Row before, row after and distance, by looking at every message."""
    before = [n for n, row in enumerate(rows) if row <= time]
    after = [n for n, row in enumerate(rows) if row > time]
    if how == "asof":
        pair = before[-1:]
    elif how == "nearest":
        near = sorted(before[-1:] + after[:1], key=lambda n: abs(rows[n] - time))
        pair = near[:1]
    else:
        is_exact = bool(before) and rows[before[-1]] == time
        pair = before[-1:] + ([] if is_exact else after[:1])
        pair = pair if is_exact or (len(pair) == 2 and before) else []
    if not pair or (tolerance is not None and any(abs(rows[n] - time) > tolerance for n in pair)):
        return None
    far = max(pair, key=lambda n: abs(rows[n] - time))
    return pair[0], pair[-1], rows[far] - time


@given(
    st.lists(st.integers(0, 40), max_size=15),
    st.lists(st.integers(0, 40), max_size=15).map(sorted),
    st.sampled_from(["asof", "nearest", "interpolate"]),
    st.none() | st.integers(0, 10),
)
def test_matches_are_those_of_a_loop(
    times: list[int], rows: list[int], how: str, tolerance: int | None
) -> None:
    found = match(np.array([*times, UNKNOWN]), np.array(rows, np.int64), how, tolerance)  # type: ignore[arg-type]
    assert found.before[-1] == -1
    for time, before, after, distance in zip(times, *found, strict=False):
        want = naive(time, rows, how, tolerance)
        if want is None:
            assert (before, after, distance) == (-1, -1, 0)
            continue
        # Of two that are equally far, either distance is right but for its sign.
        assert (before, after, abs(distance)) == (want[0], want[1], abs(want[2]))


class Asked:
    """A random question about a topic, and its messages."""

    def __init__(self, rng: Random, logs: Logs, topic: str) -> None:
        labels = ["b"] if topic == "/right/pose" else rng.choice([["b"], ["c"], ["b", "c"]])
        self.query = logs.store.topic(topic).in_recording(*labels).fields("header.seq", "x")
        self.topic, self.labels, self._logs = topic, labels, logs
        self.low, self.high = 0, 10**6
        self._is_on = rng.random() < 0.3
        if rng.random() < 0.5:
            self.low = rng.randrange(300)
            self.high = self.low + rng.randrange(50, 600)
            self.query = self.query.between(f"+{self.low}ms", f"+{self.high}ms")
        if self._is_on:
            self.query = self.query.where("on == true")

    def of(self, label: str) -> list[Said]:
        """Those of a recording."""
        times = [self._logs.said[label][0].time + ms * MS for ms in (self.low, self.high)]
        said = self._logs.of(label, self.topic) if label in self.labels else []
        inside = (one for one in said if times[0] <= one.time < times[1])
        return [one for one in inside if one.fields["on"] or not self._is_on]

    def grid(self, label: str, step: int) -> list[int]:
        """Regular times in its range."""
        said = self._logs.said[label]
        begin = said[0].time + self.low * MS
        return [*range(begin, min(said[-1].time + 1, said[0].time + self.high * MS), step)]


@pytest.mark.parametrize(
    "seed", [*range(10), *(pytest.param(seed, marks=EXHAUSTIVE) for seed in range(10, 60))]
)
def test_joins_are_those_of_a_loop(logs: Logs, limit: Limit, seed: int) -> None:
    rng = Random(seed)
    for _ in range(5):
        size = rng.choice([3, 20, 65_536])
        limit(align_piece_bytes=size * 400, frame_block_rows=rng.choice([3, 20, 65_536]))
        how, clock = rng.choice(["asof", "nearest", "interpolate"]), rng.choice([*CLOCKS])
        tolerance = rng.choice([None, 0, 3 * MS, 20 * MS])
        near = None if tolerance is None else f"{tolerance}ns"
        base, *beside = (Asked(rng, logs, topic) for topic in rng.sample(TOPICS, 3))
        is_apart, step = rng.random() < 0.3, rng.choice([5, 35]) * MS
        if is_regular := rng.random() < 0.3:
            clock, is_apart, beside = "log", False, [base]
            aligned = base.query.resample(f"{step}ns", how, near)
        else:
            aligned = logs.store.align(
                base.query,
                [one.query for one in beside],
                how=how,
                tolerance=near,
                clock=clock,
                across_recordings=is_apart,
            )
        rows = [*aligned.to_arrow().to_pylist()]
        time = CLOCKS[clock]
        place, empty = 0, 0
        for label in base.labels:
            said = base.of(label)
            for at in base.grid(label, step) if is_regular else map(time, said):
                row, place = rows[place], place + 1
                assert (row.get("recording") == label) == (len(base.labels) > 1)
                for one in beside:
                    name = "" if is_regular else f"{one.topic[1:]}."
                    others = one.of(label)
                    if is_apart:
                        labels = sorted(one.labels, key=lambda one: logs.store.entry(one).id[-16:])
                        others = [m for each in labels for m in one.of(each)]
                        others.sort(key=lambda m: m.time)
                    others.sort(key=time)
                    want = naive(at, [*map(time, others)], how, tolerance)
                    distance = row[f"{name}distance"]
                    if want is None:
                        empty += 1
                        assert distance is row[f"{name}x"] is row[f"{name}header.seq"] is None
                        continue
                    low, high = others[want[0]], others[want[1]]
                    assert abs(distance.value) == abs(want[2])
                    length = time(high) - time(low)
                    part = (at - time(low)) / length if length else 0.0
                    for field, values in (
                        ("header.seq", (low.number, high.number)),
                        ("x", (low.fields["x"], high.fields["x"])),
                    ):
                        a, b = map(float, values)  # type: ignore[arg-type]
                        exact = a + (b - a) * part if part else a
                        np.testing.assert_allclose(row[name + field], exact, rtol=1e-9)
        assert place == len(rows) == aligned.rows
        reasons = {one.topic: sum(aligned.empty.get(one.topic, {}).values()) for one in beside}
        assert sum(reasons.values()) == empty
