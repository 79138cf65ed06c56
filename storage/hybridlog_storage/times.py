"""Half-open ranges of log time, `[begin, end)`, in 64 bits.

The nanosecond after the last representable one cannot be written. Ranges therefore place a
message of that time one nanosecond earlier: a range without an end holds it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

END: Final = (1 << 63) - 1
"""The last representable time, ns; as the end of a range: no end."""
BEGIN: Final = -(1 << 63)
"""The first representable time, ns; as the beginning of a range: no beginning."""


def placed(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Times as ranges compare them: less than `END`."""
    return times.clip(max=END - 1)


def span_of(first: int, last: int) -> tuple[int, int]:
    """The range from a first to a last time, ns, which is never empty."""
    return min(first, END - 1), min(last + 1, END)


_BACK_NS: Final = 1_000_000_000
_FURTHER: Final = 64


def earlier(time: int, start: int = 0) -> Iterator[int]:
    """Starts of ever longer spans before a time, ns, to look for the last message in.

    What is looked for is mostly near. The last span begins at `start`.
    """
    back = _BACK_NS
    while time - back > start:
        yield time - back
        back *= _FURTHER
    yield start


def touches(windows: NDArray[np.int64], first: int, last: int) -> bool:
    """True if any window reaches into the time from `first` to `last`, ns.

    `windows` is int64[n, 2], `[begin, end)`, ns, apart and in order.
    """
    place = int(windows[:, 1].searchsorted(min(first, END - 1), "right"))
    return place < len(windows) and bool(windows[place, 0] <= last)


def inside(times: NDArray[np.int64], windows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """True for times, ns, that lie in any of some windows, as for `touches`."""
    times = placed(times)
    found = windows[:, 1].searchsorted(times, "right")
    known = found < len(windows)
    known[known] = windows[found[known], 0] <= times[known]
    return known
