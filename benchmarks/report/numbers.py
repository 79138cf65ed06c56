"""Numbers for people: three digits, sizes, spreads."""

from __future__ import annotations

from collections.abc import Iterable
from math import floor, isfinite, log10

from benchmarks.report.model import Cell, Value
from hybridlog.cli.output import printable

_SIZES = ((10**12, "TB"), (10**9, "GB"), (10**6, "MB"), (10**3, "kB"))

_SMALL = 0.01


def number(value: float) -> str:
    """Three digits: `0.012`, `1.23`, `123`, `12,300`."""
    if not isfinite(value):
        return "∞" if value > 0 else "—"
    if value == 0:
        return "0"
    digits = 2 - floor(log10(abs(value)))
    rounded = round(value, digits)
    if digits <= 0:
        return f"{rounded:,.0f}"
    # A number such as 9.999 has one digit less to show once it is rounded.
    places = max(0, 2 - floor(log10(abs(rounded))))
    text = f"{rounded:,.{places}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def size(count: float) -> str:
    """Bytes: `5 kB`, `640 kB`, `1.5 GB`."""
    for unit, name in _SIZES:
        if count >= unit:
            return f"{number(count / unit)} {name}"
    return f"{count:.0f} B"


def percent(value: float) -> str:
    """Percents: `100`, `98.2`, `99.997`; what is below 100 is never rounded up to it."""
    if value >= 100:
        return "100"
    for places in (1, 2, 3, 4):
        shown = f"{value:.{places}f}"
        if float(shown) < 100:
            return shown.rstrip("0").rstrip(".")
    return "99.9999"


def with_spread(value: Value) -> str:
    """`12.3 (11.9…12.8)`; a spread of less than a hundredth of the median is left out."""
    low, middle, high = number(value.low), number(value.median), number(value.high)
    if low == high or value.high - value.low < _SMALL * abs(value.median):
        return middle
    return f"{middle} ({low}…{high})"


def percents(value: Value) -> str:
    """`98.1 (97…99)`, in percent."""
    low, middle, high = (percent(part) for part in (value.low, value.median, value.high))
    return middle if low == high else f"{middle} ({low}…{high})"


def cell(value: Cell) -> str:
    """A cell of a table."""
    if value is None:
        return "—"
    return with_spread(value) if isinstance(value, Value) else value


def times(ratio: float) -> str:
    """A ratio: `3.2 times`."""
    return f"{number(ratio)} times"


def faster(ours: float, theirs: float, whose: str) -> str:
    """Our milliseconds beside another's: `2 ms (3 times as fast as MongoDB, 6 ms)`."""
    if ours <= theirs:
        relation = f"{times(theirs / ours)} as fast as" if ours else "faster than"
    else:
        relation = f"{times(ours / theirs)} the time of" if theirs else "slower than"
    return f"{number(ours)} ms ({relation} {whose}, {number(theirs)} ms)"


def listed(names: list[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def counted(counts: Iterable[int], one: str, many: str) -> str:
    """How many there are: `1 search`, `3 searches`, `2 to 5 searches`, `no searches`."""
    known = sorted(counts)
    if not known:
        return f"no {many}"
    low, high = known[0], known[-1]
    if low == high:
        return f"{low} {one if low == 1 else many}"
    return f"{low} to {high} {many}"


def plain(text: str) -> str:
    """Text on one line, without control characters: names out of logs are untrusted."""
    return printable(" ".join(text.split()))
