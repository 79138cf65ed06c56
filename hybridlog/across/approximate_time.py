"""Sets of messages with about the same time: the policy `ApproximateTime` of ROS.

`message_filters` matches messages of several topics so that each is used once, sets do not
cross, and no smaller set can be made of the messages between two sets. The latest of the
first messages of all topics is the *pivot*: the set with the shortest duration that holds it
is the answer. Later sets have to be shorter by the *age penalty* to be preferred.

This is the algorithm of its C++ version with the defaults: an age penalty of 0.1, no lower
bounds between messages. Its queue has no limit here, so that nothing is dropped, and a log
has an end: there, the best set found so far is taken, where a robot would wait for more.
"""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


def approximate_sets(
    times: Sequence[NDArray[np.int64]], tolerance: int | None = None
) -> NDArray[np.int64]:
    """The sets that `ApproximateTime` makes of the messages of some topics.

    Args:
        times: Times of the messages of each topic, ns, ascending.
        tolerance: Longest duration of a set, ns (`setMaxIntervalDuration`); None for any.

    Returns:
        int64[k, n]: the row of each topic's message, set by set.
    """
    topics = range(len(times))
    # Views give Python numbers one by one, and take no memory.
    rows = [np.ascontiguousarray(column, np.int64).data for column in times]
    # `first` is the earliest message of a topic that may be in a set with the pivot, and the
    # candidate's, once there is one; `now` is the one that is looked at.
    first = [0] * len(rows)
    now = [0] * len(rows)
    counts = [len(column) for column in rows]
    found = array("q")
    pivot, pivot_time = -1, 0  # the topic; -1 while there is no candidate
    begin = end = 0  # of the candidate
    while True:
        is_over = any(now[n] == counts[n] for n in topics)
        if not is_over:
            heads = [rows[n][now[n]] for n in topics]
            start_time, end_time = min(heads), max(heads)
            start = heads.index(start_time)
            if pivot < 0 and tolerance is not None and end_time - start_time > tolerance:
                now[start] += 1
                first[start] += 1
                continue
            # A later set must be shorter by a tenth of what it ends later.
            is_better = pivot < 0 or 11 * (end_time - end) < 10 * (start_time - begin)
            if pivot < 0:
                pivot = max(n for n in topics if heads[n] == end_time)
                pivot_time = end_time
            if is_better:
                first = list(now)
                begin, end = start_time, end_time
            now[start] += 1
            # Later sets contain the time from the pivot to here, or lack the pivot.
            if start != pivot and 11 * (end_time - end) < 10 * (pivot_time - begin):
                continue
        elif pivot < 0:
            break
        found.extend(first)
        first = [row + 1 for row in first]
        now = list(first)
        pivot = -1
    return np.array(found, np.int64).reshape(-1, len(rows))
