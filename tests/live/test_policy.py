"""What is kept when not everything can be kept, or is wanted."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.live.recorder import (
    WHOLE_BELOW,
    Throttle,
    first_fit,
    priority_rule,
    throttle_rule,
)
from hybridlog_storage.errors import TopicError, UsageError

SECOND = 1_000_000_000


@given(
    source_hz=st.floats(1, 2000),
    wanted_hz=st.floats(0.1, 2000),
    seconds=st.integers(2, 10),
    jitter=st.floats(0, 0.2),
    seed=st.integers(0, 1000),
)
def test_a_throttle_gives_the_rate_that_is_wanted(
    source_hz: float, wanted_hz: float, seconds: int, jitter: float, seed: int
) -> None:
    throttle = Throttle(wanted_hz)
    period, shake = SECOND / source_hz, random.Random(seed)
    times = [
        round(SECOND + (n + jitter * (shake.random() - 0.5)) * period)
        for n in range(int(seconds * source_hz))
    ]
    kept = [t for t in times if throttle.lets_through(t)]
    # Never more than wanted, but for what lets jitter pass; never two of them close together.
    assert len(kept) <= wanted_hz * seconds * 1.01 + 2
    interval = SECOND / wanted_hz
    assert all(b - a >= interval / 2 - period for a, b in pairwise(kept))
    # And as many as there can be: the source's own rate, or what an even thinning leaves.
    if source_hz <= wanted_hz * 0.99:
        assert len(kept) == len(times)
    else:
        assert len(kept) >= min(wanted_hz, source_hz) * seconds * 0.49 - 2


def test_a_clock_that_is_set_back_does_not_silence_a_topic() -> None:
    throttle = Throttle(1)
    assert throttle.lets_through(1_000_000 * SECOND)
    assert throttle.lets_through(10 * SECOND)
    assert not throttle.lets_through(10 * SECOND + 1000)
    assert throttle.lets_through(11 * SECOND)


def test_rules() -> None:
    rules = [throttle_rule("/camera/**", "5Hz"), throttle_rule("image_raw", " 0.5 hz")]
    assert first_fit(rules, "/camera/image_raw") == 5
    assert first_fit(rules, "/front/image_raw") == 0.5
    assert first_fit(rules, "/scan") is None
    assert first_fit([priority_rule("scan", "HIGH")], "/base/scan") == WHOLE_BELOW["high"]


@pytest.mark.parametrize("rate", ["", "fast", "-1", "0", "0Hz", "1e400", "nan", "5 kHz"])
def test_a_rate_that_is_none(rate: str) -> None:
    with pytest.raises(UsageError, match="is no rate"):
        throttle_rule("/scan", rate)


def test_a_priority_that_is_none() -> None:
    with pytest.raises(UsageError, match="low, normal or high"):
        priority_rule("/scan", "urgent")
    with pytest.raises(TopicError):
        priority_rule("re:(", "low")
