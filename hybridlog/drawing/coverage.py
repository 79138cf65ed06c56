"""Parts of a recording in which messages were lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridlog.record.losses import Cause, losses_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.catalog import RecordingEntry


def lost_parts(entry: RecordingEntry, span: tuple[int, int], parts: int) -> NDArray[np.bool_]:
    """Parts of a span of time in which messages were lost.

    Losses whose time is unknown are in none; messages that the user did not want are no loss.

    Args:
        entry: The recording.
        span: Log time `[begin, end)`, ns.
        parts: Number of parts of equal length.

    Returns:
        bool[parts].
    """
    begin, length = span[0], max(span[1] - span[0], 1)
    found = np.zeros(parts, np.bool_)
    for loss in losses_of(entry):
        first, last = loss.get("from"), loss.get("to")
        is_lost = loss["count"] != 0 and loss["cause"] != Cause.THROTTLE
        if first is None or last is None or not is_lost or last < begin or first >= span[1]:
            continue
        low = max(first - begin, 0) * parts // length
        found[low : (last - begin) * parts // length + 1] = True
    return found
