"""Numbers and names for people: three digits, sizes, backends."""

from __future__ import annotations

from math import floor, isfinite, log10

from benchmarks.backends.registry import BACKENDS
from hybridlog.cli.output import printable

OURS = "hybridlog"
FLOORS = frozenset({"nothing", "mcap", "bagfile"})
"""Backends that are no databases: a file, or nothing at all."""


def title(backend: str) -> str:
    """A backend's name for people."""
    return BACKENDS[backend].title if backend in BACKENDS else printable(backend)


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
    text = f"{rounded:,.{max(0, 2 - floor(log10(abs(rounded))))}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def size(count: float) -> str:
    """Bytes: `5 kB`, `640 kB`, `1.5 GB`."""
    for unit, name in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
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
