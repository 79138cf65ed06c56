from __future__ import annotations

import contextlib
import time
from datetime import UTC, date, datetime, timedelta, timezone

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridlog.query.times import (
    format_duration,
    format_time,
    parse_duration,
    parse_range,
    parse_time,
)
from hybridlog_storage.errors import TimeError

START = 1_425_407_313_000_000_007
END = START + 60_000_000_000
NS = 1_425_407_313_123_456_789

times = st.integers(0, 2**63 - 1)


def at(text: object) -> int:
    return parse_time(text, start=START, end=END)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("2015-03-03T18:28:33.123456789Z", NS),
        ("2015-03-03T18:28:33.123456789", NS),
        ("2015-03-03 18:28:33.123456789 UTC", NS),
        ("2015-03-03t19:28:33,123456789+01:00", NS),
        ("2015-03-03T13:58:33.123456789-0430", NS),
        ("20150303T182833.123456789Z", NS),
        ("2015-03-03T18:28:33.5Z", 1_425_407_313_500_000_000),
        ("2015-03-03", 1_425_340_800_000_000_000),
        ("1425407313.123456789", NS),
        ("1425407313.1234567890000", NS),
        ("99999999999999", None),
        ("0", 0),
        ("0.000000001", 1),
        (str(NS), NS),
        (f"{NS}ns", NS),
        ("100000000000000", 10**14),
        ("+5", START + 5_000_000_000),
        ("+ 1m 30s", START + 90_000_000_000),
        ("1m30s", START + 90_000_000_000),
        ("+500ms", START + 500_000_000),
        ("500ms", START + 500_000_000),
        ("+5ns", START + 5),
        ("+1.5s", START + 1_500_000_000),
        ("-10s", END - 10_000_000_000),
        ("start", START),
        (" END ", END),
        (5, 5),
        (NS, NS),
        (1425407313.5, 1_425_407_313_500_000_000),
        (1425407313.1, 1_425_407_313_100_000_000),
        (1.5e18, 15 * 10**17),
        (np.int64(NS), NS),
        (np.float64(2.5), 2_500_000_000),
        (datetime(2015, 3, 3, 18, 28, 33, 123456), NS - 789),
        (datetime(2015, 3, 3, 18, 28, 33, 123456, tzinfo=UTC), NS - 789),
        (datetime(2015, 3, 3, 23, 28, 33, tzinfo=timezone(timedelta(hours=5))), NS - 123456789),
        (date(2015, 3, 3), 1_425_340_800_000_000_000),
        (pd.Timestamp(NS), NS),
        (pd.Timestamp(NS, tz="Europe/Berlin"), NS),
        (np.datetime64(NS, "ns"), NS),
        (np.datetime64("2015-03-03T18:28:33"), 1_425_407_313_000_000_000),
    ],
)
def test_forms(text: object, ns: int | None) -> None:
    if ns is None:  # the largest number of seconds: past 2**63 nanoseconds
        with pytest.raises(TimeError, match="out of range"):
            at(text)
    else:
        assert at(text) == ns


def test_now() -> None:
    before = time.time_ns()
    assert before <= parse_time("now", start=None, end=None) <= time.time_ns()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "yesterday",
        "2015-13-01",
        "2015-03-03T25:00",
        "2015-03-03T18:28:33+25:00",
        "2262-04-12",
        "1e9",
        "+-5s",
        "+5 parsecs",
        "1425407313.1234567891",
        "+0.5ns",
        "1425407313123456789.5",
        "9223372036854775808",
        "9" * 150,
        "١٢٣",
        "1_000",
        -(2**63) - 1,
        "1677-09-21",
        True,
        float("nan"),
        float("inf"),
        2**63,
        None,
        [],
        b"5",
        pd.NaT,
        np.datetime64("NaT"),
        np.datetime64(2**62, "s"),
    ],
)
def test_what_is_no_time(text: object) -> None:
    with pytest.raises(TimeError) as caught:
        at(text)
    assert len(str(caught.value)) < 700


def test_message_lists_the_forms() -> None:
    with pytest.raises(TimeError, match=r"ISO 8601.*\+5s.*-10s"):
        at("noon")


@pytest.mark.parametrize("text", ["+5s", "-5s", "5s", "start", "end"])
def test_relative_to_nothing(text: str) -> None:
    with pytest.raises(TimeError, match="relative to a recording"):
        parse_time(text, start=None, end=None)


def test_before_1970() -> None:
    assert parse_time("-10s", start=0, end=5 * 10**9) == -5 * 10**9
    assert at("1969-12-31T23:59:59.999999999Z") == at(-1) == at(np.datetime64(-1, "ns")) == -1
    assert at(-1.5) == at(datetime(1969, 12, 31, 23, 59, 58, 500_000)) == -1_500_000_000


@given(st.integers(-(2**63) + 1, 2**63 - 1))
def test_every_nanosecond_survives(ns: int) -> None:
    assert at(format_time(ns)) == at(ns) == at(np.datetime64(ns, "ns")) == ns
    if ns >= 0:
        assert at(f"{ns}ns") == ns
        assert at(f"{ns // 10**9}.{ns % 10**9:09d}") == ns
    assert format_time(ns) == format_time(at(format_time(ns)))
    # An independent reader.
    assert pd.Timestamp(format_time(ns)).as_unit("ns").value == ns


@given(st.text(alphabet="0123456789.+-: TZmshdnu"))
def test_nothing_but_times_and_time_errors(text: str) -> None:
    with contextlib.suppress(TimeError):
        assert -(2**63) <= at(text) < 2**63


def test_ranges() -> None:
    def between(a: object, b: object) -> tuple[int, int]:
        return parse_range(a, b, start=START, end=END)  # type: ignore[arg-type]

    assert between("+5s", "+6s") == (START + 5 * 10**9, START + 6 * 10**9)
    assert between(None, None) == (START, END)
    assert between("-10s", None) == (END - 10 * 10**9, END)
    assert parse_range(None, None, start=None, end=None) == (-(2**63), 2**63 - 1)
    with pytest.raises(
        TimeError, match=r"'\+6s'.*2015-03-03T18:28:39.*'\+5s'.*2015-03-03T18:28:38"
    ):
        between("+6s", "+5s")
    with pytest.raises(TimeError, match="not later"):
        between("+6s", "+6s")
    with pytest.raises(TimeError, match="the end"):
        between("2100-01-01", None)


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("5s", 5 * 10**9),
        ("1d2h3m4.5s", 93_784_500_000_000),
        ("1 min 30 sec", 90 * 10**9),
        ("0.1", 10**8),
        ("2us", 2_000),
        ("2µs", 2_000),
        (3, 3 * 10**9),
        (0.1, 10**8),
        (timedelta(milliseconds=5), 5 * 10**6),
        (pd.Timedelta(7, "ns"), 7),
        ("0s", 0),
    ],
)
def test_durations(text: object, ns: int) -> None:
    assert parse_duration(text) == ns  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "-5s",
        "5 apples",
        "0.1ns",
        "s",
        "1s1s",
        "1000000d",
        50_000_000,  # nanoseconds?
        "50000000",
        1e9,
        -1,
        True,
        float("nan"),
        None,
        "5" * 300,
    ],
)
def test_what_is_no_duration(text: object) -> None:
    with pytest.raises(TimeError):
        parse_duration(text)  # type: ignore[arg-type]


@given(times)
def test_durations_survive(ns: int) -> None:
    assert parse_duration(format_duration(ns)) == ns


@pytest.mark.parametrize(
    ("ns", "text"),
    [
        (0, "0s"),
        (1, "1ns"),
        (1_500, "1.5us"),
        (12_500_000, "12.5ms"),
        (90 * 10**9, "1m30s"),
        (3_723_500_000_000, "1h2m3.5s"),
        (3_600 * 10**9, "1h"),
        (-(10**9), "-1s"),
    ],
)
def test_duration_text(ns: int, text: str) -> None:
    assert format_duration(ns) == text
