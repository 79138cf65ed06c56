"""Gaps of topics in a picture: pixels without messages for longer than usual."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog.query.periods import GAP_PERIODS, usual_period
from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.drawing.chunk_parts import RecordedChunks
    from hybridlog.query.chunk_counts import Parts

_SAMPLED: Final = 16  # chunks that are read for one topic


def sampled_period(chunks: RecordedChunks, parts: Parts) -> float:
    """The usual time from one message of a topic to the next, ns, in some of its chunks.

    Args:
        chunks: The chunks of the recording.
        parts: Those of the topic.

    Returns:
        0 if there is only one message, or none.
    """
    several = parts.take(parts.messages > 1)
    steps = [np.empty(0, np.int64)]
    if 2 * int(several.messages.sum()) >= int(parts.messages.sum()):
        last = len(several.first) - 1
        rows = np.unique(np.linspace(0, last, min(last + 1, _SAMPLED)).astype(np.intp))
        for segment, chunk, channel in zip(
            *(column[rows].tolist() for column in several[:3]), strict=True
        ):
            with suppress(SegmentError, KeyError):
                times = chunks.times(segment, chunk)[channel]
                steps.append(times[1:] - times[:-1])
    else:
        first = np.sort(parts.first)
        steps.append(first[1:] - first[:-1])
    return usual_period(np.concatenate(steps))


def gaps(counts: NDArray[np.int64], edges: NDArray[np.int64], period: float) -> NDArray[np.intp]:
    """Runs of pixels without messages that last longer than is usual.

    A gap that a picture shows is one of the recording, but for how exact its ends are; one
    that is shorter than two pixels may not be shown.

    Args:
        counts: int64[p], messages of a topic by pixel.
        edges: int64[p + 1], ns.
        period: The usual time from one message to the next, ns; 0 if unknown.

    Returns:
        intp[n, 2], first pixel and the one behind the last.
    """
    if period <= 0:
        return np.empty((0, 2), np.intp)
    is_empty = np.concatenate([[False], counts == 0, [False]])
    runs = np.flatnonzero(is_empty[1:] != is_empty[:-1]).reshape(-1, 2)
    is_long = edges[runs[:, 1]] - edges[runs[:, 0]] > GAP_PERIODS * period
    return runs[is_long]
