"""What a search tries next, and that it finds the rate up to which all is kept."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from benchmarks.studies import search

BOUNDS = search.Bounds(start=64.0, lowest=1.0, highest=16384.0, halvings=2)


def tried(truth: float, **bounds: float) -> dict[float, bool]:
    """Trials of a backend that keeps all up to a rate."""
    kept: dict[float, bool] = {}
    while (rate := search.next_rate(kept, replace(BOUNDS, **bounds))) is not None:
        assert rate not in kept
        kept[rate] = rate <= truth
        assert len(kept) < 30
    return kept


def test_the_search_doubles_then_halves_the_gap() -> None:
    assert list(tried(300)) == [64, 128, 256, 512, 384, 320]
    assert list(tried(400)) == [64, 128, 256, 512, 384, 448]
    assert list(tried(10)) == [64, 32, 16, 8, 12, 10]
    assert list(tried(0.5)) == [64, 32, 16, 8, 4, 2, 1]
    assert list(tried(1e9, highest=512)) == [64, 128, 256, 512]


@given(truth=st.floats(1, 16384), start=st.sampled_from([4.0, 50.0, 64.0, 100.0]))
def test_the_search_comes_within_a_quarter(truth: float, start: float) -> None:
    kept = tried(truth, start=start)
    best = max((rate for rate, good in kept.items() if good), default=None)
    lost = min((rate for rate, good in kept.items() if not good), default=None)
    if best is None:
        assert lost is not None
        assert lost / 2 < 1
    elif lost is None:
        assert best * 2 > 16384
    else:
        assert best <= truth < lost <= best * 1.2501
