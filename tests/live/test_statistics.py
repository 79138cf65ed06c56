from __future__ import annotations

import pytest

from hybridlog.live.statistics import Lateness


def test_what_comes_evenly_is_late_only_when_the_index_does_not_keep_up() -> None:
    kept_up, fell_behind = Lateness(7.0), Lateness(7.0)
    for second in range(60):
        stored = 80 * second
        # Twenty topics at 4 Hz, indexed every four seconds; and an index that ends at 1600.
        indexed = 80 * max(second - 2 - second % 4, 0)
        assert kept_up.late(100.0 + second, stored, stored - indexed) == 0
        stuck = min(stored, 1600)
        late = fell_behind.late(100.0 + second, stored, stored - stuck)
        assert late == max(80 * (second - 7) - 1600, 0)


@pytest.mark.parametrize("pause", [6.9, 7.0, 30.0])
def test_a_look_after_a_long_time(pause: float) -> None:
    lateness = Lateness(7.0)
    assert lateness.late(0.0, 500, 500) == 0
    # Of what came in between nobody knows when it did.
    assert lateness.late(pause, 900, 900) == (500 if pause >= 7 else 0)
    assert lateness.late(pause, 900, 300) == 0
