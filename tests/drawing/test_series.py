"""Series against loops over what was written."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridlog.drawing.series import series
from hybridlog_storage.errors import TopicError, UsageError

from .conftest import BASE, MS, Drive

PAUSES = (1500, 4000)


def by_pixel(
    drive: Drive, values: NDArray[np.float64], span: tuple[int, int], pixels: int
) -> dict[int, tuple[int, float, float]]:
    """First time, least and greatest value of each pixel."""
    width = -(-(span[1] - span[0]) // pixels)
    found: dict[int, tuple[int, float, float]] = {}
    for time, value in zip(drive.times.tolist(), values.tolist(), strict=True):
        if not span[0] <= time < span[1]:
            continue
        pixel = (time - span[0]) // width
        first, low, high = found.get(pixel, (time, np.nan, np.nan))
        if np.isfinite(value):
            low, high = np.fmin(low, value), np.fmax(high, value)
        found[pixel] = first, float(low), float(high)
    return found


def test_few_messages_are_exact(drive: Drive) -> None:
    query = drive.store.topic("drive")
    span = int(drive.times[90]), int(drive.times[190])
    (x, y) = series(query, ["linear.x", "y"], pixels=50, span=span)
    assert (x.field, y.field) == ("linear.x", "y")
    assert x.exact
    assert y.exact
    assert np.array_equal(x.times, drive.times[90:190])
    assert np.array_equal(x.least, drive.x[90:190], equal_nan=True)
    assert np.array_equal(x.greatest, x.least, equal_nan=True)
    assert np.isnan(x.least[10])
    assert np.array_equal(y.least, np.arange(90, 190) / 4)
    # One more message than twice the pixels.
    (x,) = series(query, ["linear.x"], pixels=50, span=(span[0], span[1] + 1))
    assert not x.exact
    assert len(x.times) <= 50


def test_many_messages_are_least_and_greatest_by_pixel(drive: Drive) -> None:
    query = drive.store.topic("drive")
    span = int(drive.times[0]), int(drive.times[-1]) + 1
    for pixels in (1, 97, 700):
        for one in (None, span, (span[0] - 10_000 * MS, span[1] + 7)):
            x, z = series(query, ["linear.x", "linear.z"], pixels=pixels, span=one)
            for found, values in ((x, drive.x), (z, drive.z)):
                assert not found.exact
                want = by_pixel(drive, values, one or span, pixels)
                width = -(-((one or span)[1] - (one or span)[0]) // pixels)
                is_gap = ~np.isin(found.times, drive.times)
                rows = zip(
                    found.times[~is_gap].tolist(),
                    found.least[~is_gap].tolist(),
                    found.greatest[~is_gap].tolist(),
                    strict=True,
                )
                assert [*map(repr, rows)] == [*map(repr, (want[p] for p in sorted(want)))]
                assert np.isnan(found.least[is_gap]).all()
                assert np.isnan(found.greatest[is_gap]).all()
                # A pause is seen where it has a pixel of its own.
                gaps = found.times[is_gap].tolist()
                assert len(gaps) == (2 if width < 10_000 * MS else 0)
                for gap, pause in zip(gaps, PAUSES, strict=False):
                    assert drive.times[pause - 1] < gap < drive.times[pause]
        assert np.array_equal(x.times, z.times)


def test_gaps_of_exact_series(drive: Drive) -> None:
    query = drive.store.topic("drive")
    (z,) = series(query, ["linear.z"], pixels=2500)
    assert z.exact
    at = [pause + n for n, pause in enumerate(PAUSES)]
    assert np.isnan(z.least[at]).all()
    assert (z.times[at] > drive.times[[p - 1 for p in PAUSES]]).all()
    assert np.array_equal(np.delete(z.times, at), drive.times)
    assert np.array_equal(np.delete(z.least, at), drive.z)
    assert np.isfinite(np.delete(z.least, at)).all()


def test_infinite_values_hide_no_others(drive: Drive) -> None:
    query = drive.store.topic("drive")
    (x,) = series(query, ["linear.x"], pixels=10)
    assert np.isfinite(x.greatest[~np.isnan(x.greatest)]).all()
    span = int(drive.times[2990]), int(drive.times[3010])
    (x,) = series(query, ["linear.x"], pixels=10, span=span)
    assert x.exact
    assert x.greatest[10] == np.inf
    # A pixel without any finite value is a gap.
    span = int(drive.times[1600]), int(drive.times[1800])
    (x,) = series(query, ["linear.x"], pixels=10, span=span)
    assert len(x.times) == 10
    assert np.isnan(x.least).all()


def test_kinds_of_numbers(drive: Drive) -> None:
    query = drive.store.topic("drive")
    span = int(drive.times[30]), int(drive.times[40])
    names = ["ticks", "on", "age", "linear", "position[2]", "position.n", "wide[39]", "way[1].z"]
    found = {one.field: one.least for one in series(query, names, pixels=100, span=span)}
    rows = range(30, 40)
    assert [*found] == [*names[:3], "linear.x", "linear.z", *names[4:]]
    assert np.array_equal(found["ticks"], drive.ticks[30:40].astype(float))
    assert found["on"].tolist() == [n % 2 for n in rows]
    assert found["age"].tolist() == list(rows)
    assert np.array_equal(found["linear.z"], drive.z[30:40])
    third = [drive.joints[n][2] if n % 4 == 3 else np.nan for n in rows]
    assert np.array_equal(found["position[2]"], third, equal_nan=True)
    assert found["position.n"].tolist() == [n % 4 for n in rows]
    assert np.array_equal(found["wide[39]"], drive.wide[30:40, 39].astype(float))
    seconds = [n / 2 if n % 3 == 2 else np.nan for n in rows]
    assert np.array_equal(found["way[1].z"], seconds, equal_nan=True)


def test_fields_without_a_definition(drive: Drive) -> None:
    (w,) = series(drive.store.topic("loose"), ["w"], pixels=300)
    steps = np.arange(0, 5000, 50)
    at = [int(np.searchsorted(steps, pause)) + n for n, pause in enumerate(PAUSES)]
    want = np.where(steps % 150, steps / 2, np.nan)
    assert np.array_equal(np.delete(w.least, at), want, equal_nan=True)
    for other in ("name", "v", "on"):  # a text, a number or a text, true or a number
        with pytest.raises(UsageError, match=f"{other} is no number"):
            series(drive.store.topic("loose"), [other], pixels=300)
    with pytest.raises(TopicError, match="No message here has a field 'speed'"):
        series(drive.store.topic("loose"), ["speed"], pixels=300)


def test_only_columns_of_the_table_are_read(drive: Drive) -> None:
    query = drive.store.topic("drive")
    series(query, ["linear.z"], pixels=100)
    whole = query.counters.bytes_read
    assert query.counters.chunks_read == 0
    assert query.counters.messages == 5000
    assert whole < 5000 * 8 * 3
    span = int(drive.times[10]), int(drive.times[20])
    series(query, ["linear.z"], pixels=100, span=span)
    assert query.counters.messages == 10
    assert query.counters.bytes_read < whole / 10
    assert query.counters.chunks_read == 0


def test_predicates_ranges_and_steps(drive: Drive) -> None:
    query = drive.store.topic("drive").where("linear.z > 0.5").between("+1s", "+10s")
    (z,) = series(query, ["linear.z"], pixels=5000)
    times, values = drive.times - BASE, drive.z
    is_wanted = (values > 0.5) & (times >= 1000 * MS) & (times < 10_000 * MS)
    kept = ~np.isnan(z.least)
    assert np.array_equal(z.times[kept], drive.times[is_wanted])
    assert np.array_equal(z.least[kept], values[is_wanted])
    # The span narrows the range of the query and does not replace it.
    span = (BASE + 500 * MS, BASE + 2000 * MS)
    (z,) = series(query, ["linear.z"], pixels=5000, span=span)
    assert z.times.tolist() == drive.times[is_wanted & (times < 2000 * MS)].tolist()
    (z,) = series(drive.store.topic("drive").every(7), ["linear.z"], pixels=5000)
    assert np.array_equal(z.least[~np.isnan(z.least)], drive.z[::7])


@pytest.mark.parametrize("span", [(0, 5), (BASE - 9, BASE), (-(2**70), -(2**65))])
def test_nothing_in_the_span(drive: Drive, span: tuple[int, int]) -> None:
    x, linear = series(drive.store.topic("drive"), ["linear.x", "linear"], pixels=9, span=span)
    assert (len(x.times), len(x.least), len(linear.greatest)) == (0, 0, 0)
    assert x.exact


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ([], "Name a field"),
        (["state"], "state is no number"),
        (["position"], r"position is no number: .* of an array `x\[0\]`"),
        (["state[0]"], "no number"),
        (["way[0]"], "no number"),
        (["way[0].q"], "no number"),
        (["position[]"], "names no single number"),
        (["position[1"], "names no single number"),
        (["[1]"], "names no single number"),
        (["way"], "way is no number"),
    ],
)
def test_no_numbers(drive: Drive, fields: list[str], problem: str) -> None:
    with pytest.raises(UsageError, match=problem):
        series(drive.store.topic("drive"), fields, pixels=100)


def test_questions_without_a_picture(drive: Drive) -> None:
    query = drive.store.topic("drive")
    with pytest.raises(TopicError, match="linear"):
        series(query, ["linea"], pixels=100)
    with pytest.raises(UsageError, match="one pixel"):
        series(query, ["y"], pixels=0)
    with pytest.raises(UsageError, match="reverse"):
        series(query.reverse(), ["y"], pixels=9)
    with pytest.raises(UsageError, match="2 topics in 1 recordings"):
        series(drive.store.topic("drive", "loose"), ["y"], pixels=9)
