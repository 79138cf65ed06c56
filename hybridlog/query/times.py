"""Times in the forms that people write, converted exactly to integer nanoseconds.

A time is nanoseconds since the Unix epoch in 64 bits, `-2**63 <= t < 2**63`. No text is
converted through a float: `1425407313.123456789` retains its last digit.

Forms that `parse_time` accepts:

| written | means |
|---|---|
| `2015-03-03T18:28:33.123456789Z`, `…+01:00` | ISO 8601, to nine digits |
| `2015-03-03T18:28:33`, `2015-03-03` | the same in UTC |
| `1425407313`, `1425407313.123456789` | seconds since the epoch, below 10**14 |
| `1425407313123456789` | nanoseconds since the epoch, from 10**14 |
| the int `1425407313123456789` | nanoseconds since the epoch, whatever the size |
| the float `1425407313.5` | seconds since the epoch |
| `5000000000ns` | nanoseconds since the epoch, whatever the size (simulated clocks start at 0) |
| `+5s`, `+1m30s`, `+500ms`, `+5`, `1m30s` | from the start of the recording (`+5` is seconds) |
| `-10s`, `-10` | before the end of the recording |
| `start`, `end`, `now` | start and end of the recording, current time |

A date without a zone is UTC on every machine, because logs travel between zones. A space
may replace the `T`.

A bare number without a unit is always counted from the epoch, a number with a unit from
the start of the recording.
"""

from __future__ import annotations

import math
import re
import time
from datetime import UTC, date, datetime, timedelta
from fractions import Fraction
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

from hybridlog_storage.errors import TimeError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    import numpy as np

TimeLike: TypeAlias = (
    "str | int | float | date | np.datetime64 | np.integer[Any] | np.floating[Any]"
)
"""Types that `parse_time` accepts; `datetime` and `pandas.Timestamp` are dates."""

DurationLike: TypeAlias = "str | float | timedelta"
"""Types that `parse_duration` accepts."""

TIME_LIMIT = 2**63
"""Times are less than this many nanoseconds (the year 2262)."""

ACCEPTED = (
    "write a time as ISO 8601 (2015-03-03T18:28:33.5Z, UTC when no zone is given; "
    "2015-03-03), as seconds since the epoch (1425407313.123), as nanoseconds "
    "(1425407313123456789 or 5000ns), counted from the start (+5s, +1m30s, 500ms) or from "
    "the end (-10s), or as start, end or now"
)
"""The forms `parse_time` accepts, for messages and help texts."""

_LONGEST_BARE = 10**7 * 10**9  # 115 days, ns

DURATIONS = "write a duration as 5s, 1m30s, 2h, 500ms, 250us, 100ns, or a number of seconds"
"""The forms `parse_duration` accepts."""

_NANOSECONDS_FROM = 10**14
_SECOND = 10**9
_EARLY_NS = 10**17
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_LONGEST_TEXT = 200

_NUMBER = re.compile(r"([0-9]+)(?:\.([0-9]*))?")
_NS = re.compile(r"([0-9]+)\s*ns", re.IGNORECASE)
_ISO = re.compile(
    r"(?P<date>[0-9]{4}-[0-9]{2}-[0-9]{2}|[0-9]{8}(?=[Tt]))"
    r"(?:(?:[Tt]|\s+)(?P<time>[0-9]{2}(?::?[0-9]{2}(?P<second>:?[0-9]{2})?)?)"
    r"(?(second)(?:[.,](?P<fraction>[0-9]+))?)"
    r"\s*(?P<zone>[Zz]|UTC|utc|[+-][0-9]{2}(?::?[0-5][0-9](?::[0-5][0-9])?)?)?)?"
)
_PART = r"(?:([0-9]+)(?:\.([0-9]+))?\s*{}\s*)?"
_UNITS: tuple[tuple[str, int], ...] = (
    ("y", 365 * 86_400 * _SECOND),
    ("d", 86_400 * _SECOND),
    ("h", 3_600 * _SECOND),
    ("m(?:in)?", 60 * _SECOND),
    ("s(?:ec)?", _SECOND),
    ("ms", 10**6),
    ("(?:us|µs|μs)", 10**3),
    ("ns", 1),
)
_DURATION = re.compile("".join(_PART.format(unit) for unit, _ in _UNITS), re.IGNORECASE)


def parse_time(text: TimeLike, *, start: int | None, end: int | None) -> int:
    """One time, in nanoseconds since the epoch.

    It is in one of the forms of this module's table, an int (nanoseconds since the epoch), a float
    (seconds since the epoch, by its shortest decimal form), a `datetime` or `pandas.Timestamp`
    (naive: UTC), a `date`, or a `numpy.datetime64`. `+5s` counts from `start`, `-10s` from `end`,
    one past the last message, which makes `[start, end)` the whole recording; both are None without
    one.
    """
    if isinstance(text, bool):
        raise _no_time(text)
    if isinstance(text, str):
        ns = _parse_text(text, start, end)
    elif isinstance(text, Integral):
        ns = int(text)
    elif isinstance(text, Real):
        ns = _from_float(float(text))
    else:  # dates of Python, pandas and numpy show themselves as ISO 8601
        found = _absolute(str(text))
        if found is None:
            raise _no_time(text)
        ns = found
    if not -TIME_LIMIT <= ns < TIME_LIMIT:
        raise TimeError(
            f"{_shown(text)} is out of range: times lie from 1677-09-21 to 2262-04-11 "
            "(-2**63 to 2**63 nanoseconds since 1970)"
        )
    return ns


def is_relative(time: TimeLike | None) -> bool:
    """True if a time depends on the recording: `+5s`, `-10s`, `500ms`, `start`, `end`."""
    if not isinstance(time, str):
        return False
    word = time.strip()
    return word.lower() != "now" and _absolute(word) is None


def is_early(time: TimeLike | None) -> TypeGuard[str]:
    """True for a number without sign and unit that is a time before 1973: `10`."""
    if not isinstance(time, str) or _NUMBER.fullmatch(time.strip()) is None:
        return False
    return 0 < parse_time(time, start=None, end=None) < _EARLY_NS


def parse_range(
    begin: TimeLike | None, stop: TimeLike | None, *, start: int | None, end: int | None
) -> tuple[int, int]:
    """A half-open range `[begin, stop)` in nanoseconds, not empty.

    Without a begin it is from `start` or -2**63, without a stop until `end` or 2**63 - 1; relative
    times count from these, the first log time and one past the last.
    """
    low, high = BEGIN if start is None else start, END if end is None else end
    if begin is not None:
        low = parse_time(begin, start=start, end=end)
    if stop is not None:
        high = parse_time(stop, start=start, end=end)
    if high <= low:
        raise TimeError(
            f"the range is empty: it begins at {_spelled(begin, 'the start', low)} and ends "
            f"at {_spelled(stop, 'the end', high)}, which is not later (ranges are half-open, "
            "the end is not part of them)"
        )
    return low, high


def parse_duration(text: DurationLike) -> int:
    """A duration in nanoseconds, not negative, less than 2**63.

    `5s`, `1m30s`, `2h`, `500ms`, `250us`, `100ns`, `1d`, `2y` (730 days): units are in descending
    order, each number may have a fraction; one without unit is seconds, less than ten million.
    """
    ns: int | None = None
    if isinstance(text, str):
        ns = _duration(text.strip()) if len(text) <= _LONGEST_TEXT else None
    elif isinstance(text, timedelta):
        ns = _timedelta(text)
    elif isinstance(text, Real) and not isinstance(text, bool) and math.isfinite(text):
        ns = round(Fraction(str(text)) * _SECOND)
    if ns is None:
        raise TimeError(f"{_shown(text)} is not a duration: {DURATIONS}")
    if not 0 <= ns < TIME_LIMIT:
        raise TimeError(f"{_shown(text)} is out of range for a duration: {DURATIONS}")
    is_bare = _NUMBER.fullmatch(text.strip()) if isinstance(text, str) else isinstance(text, Real)
    if is_bare and ns >= _LONGEST_BARE:
        raise TimeError(
            f"{_shown(text)} without a unit is that many seconds; write {text}s if they are meant, "
            f"else {text}ns"
        )
    return ns


def decoded_time(value: object) -> int | None:
    """A time in the fields of a message, ns; JSON has seconds and nanoseconds. None for others."""
    if isinstance(value, dict):
        parts = value.get("sec", 0), value.get("nsec", 0)
        if not all(isinstance(part, int) for part in parts):
            return None
        value = parts[0] * 10**9 + parts[1]
    return value if isinstance(value, int) and BEGIN <= value <= END else None


def format_time(ns: int) -> str:
    """A time as ISO 8601 in UTC, the fraction without trailing zeros.

    `format_time(1425407313_500000000)` is `2015-03-03T18:28:33.5Z`; `parse_time` reads
    it back exactly.
    """
    seconds, rest = divmod(int(ns), _SECOND)
    base = datetime(1970, 1, 1) + timedelta(seconds=seconds)
    return f"{base.isoformat()}{_fraction(rest, 9)}Z"


def format_duration(ns: int) -> str:
    """A duration in the form that `parse_duration` reads: `1h2m3.5s`, `12.5ms`, `250ns`, `0s`.

    A negative one, which only occurs as a difference, has a leading minus.
    """
    ns = int(ns)
    if ns < 0:
        return "-" + format_duration(-ns)
    for unit, size, digits in (("ns", 1, 0), ("us", 10**3, 3), ("ms", 10**6, 6)):
        if 0 < ns < 1000 * size:
            whole, rest = divmod(ns, size)
            return f"{whole}{_fraction(rest, digits)}{unit}"
    seconds, rest = divmod(ns, _SECOND)
    text = ""
    for unit, size in (("d", 86_400), ("h", 3_600), ("m", 60)):
        count, seconds = divmod(seconds, size)
        text += f"{count}{unit}" if count else ""
    return text if text and not (seconds or rest) else f"{text}{seconds}{_fraction(rest, 9)}s"


def _parse_text(text: str, start: int | None, end: int | None) -> int:
    word = text.strip()
    if not word or len(word) > _LONGEST_TEXT:
        raise _no_time(text)
    if word.lower() == "now":
        return time.time_ns()
    absolute = _absolute(word)
    if absolute is not None:
        return absolute
    sign = word[0] if word[0] in "+-" else ""
    named = {"start": (start, 0), "end": (end, 0)}
    offset = _duration(word.removeprefix(sign).strip())
    base, offset = named.get(word.lower(), (end if sign == "-" else start, offset))
    if offset is None:
        raise _no_time(text)
    if base is None:
        raise TimeError(
            f"{_shown(word)} is relative to a recording, and none has messages: "
            "write a date or a number since the epoch"
        )
    return base - offset if sign == "-" else base + offset


def _absolute(word: str) -> int | None:
    """A date or a number since the epoch; None if the word is neither."""
    if _NUMBER.fullmatch(word):
        number = Fraction(word)
        if number < _NANOSECONDS_FROM:
            return _exact(number * _SECOND, word)
        if number.denominator != 1:
            raise TimeError(
                f"{_shown(word)} has a fraction of a nanosecond (numbers from 10**14 are "
                f"nanoseconds): {ACCEPTED}"
            )
        return number.numerator
    if nanoseconds := _NS.fullmatch(word):
        return int(nanoseconds[1])
    if iso := _ISO.fullmatch(word):
        return _from_iso(iso, word)
    return None


def _exact(ns: Fraction, word: str) -> int:
    if ns.denominator != 1:
        raise TimeError(
            f"{_shown(word)} is finer than a nanosecond: at most nine digits of a second"
        )
    return ns.numerator


def _from_iso(iso: re.Match[str], word: str) -> int:
    zone = iso["zone"] or "Z"
    zone = zone if zone[0] in "+-" else "Z"
    try:
        moment = datetime.fromisoformat(f"{iso['date']}T{iso['time'] or '00'}{zone}")
    except ValueError as error:
        raise TimeError(f"{_shown(word)} is no valid date: {error}") from None
    seconds = (moment - _EPOCH) // timedelta(seconds=1)
    return _exact((seconds + Fraction(f"0.{iso['fraction'] or 0}")) * _SECOND, word)


def _duration(word: str) -> int | None:
    """Nanoseconds of an unsigned duration; None if the word is no duration."""
    if _NUMBER.fullmatch(word):
        return _exact(Fraction(word) * _SECOND, word)
    match = _DURATION.fullmatch(word)
    if not word or match is None:
        return None
    parts = zip(match.groups()[::2], match.groups()[1::2], _UNITS, strict=True)
    found = [Fraction(f"{one}.{part or 0}") * size for one, part, (_, size) in parts if one]
    return _exact(sum(found, Fraction(0)), word)


def _from_float(number: float) -> int:
    if not math.isfinite(number) or not -TIME_LIMIT <= number < TIME_LIMIT:
        raise _no_time(number)
    # The shortest decimal of this float is the text that the user typed.
    exact = Fraction(repr(number))
    return round(exact if abs(exact) >= _NANOSECONDS_FROM else exact * _SECOND)


def _timedelta(delta: timedelta) -> int:
    whole = (delta.days * 86_400 + delta.seconds) * _SECOND + delta.microseconds * 1_000
    return whole + int(getattr(delta, "nanoseconds", 0))


def _spelled(source: object, default: str, ns: int) -> str:
    name = default if source is None else _shown(source)
    return f"{name} ({format_time(ns)}, {ns} ns)"


def _no_time(source: object) -> TimeError:
    return TimeError(f"{_shown(source)} is not a time: {ACCEPTED}")


def _shown(source: object) -> str:
    text = repr(source) if isinstance(source, str) else str(source)
    return text if len(text) <= 80 else text[:76] + "…" + text[-1]


def _fraction(rest: int, digits: int) -> str:
    return f".{rest:0{digits}d}".rstrip("0") if rest else ""
