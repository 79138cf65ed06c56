"""Messages that hold until they are replaced: a slice begins with those still in force."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hybridlog.query.plan import Lane
    from hybridlog.reader import Query
    from hybridlog_storage.messages import Batch, Channel

_TRANSIENT_LOCAL = re.compile(r"durability:\s*(?:1|transient_local)\b")
_DEEPEST = 1000


def depth_of(channel: Channel) -> int:
    """How many of a channel's last messages a late subscriber gets; 0 without latching.

    A ROS 1 connection latches one message. A ROS 2 channel mixes the publishers of its
    topic, and the depth of each says nothing of their number: all are kept, within reason.
    """
    metadata = channel.metadata
    if metadata.get("latching") in {"1", "true"}:
        return 1
    if _TRANSIENT_LOCAL.search(metadata.get("offered_qos_profiles", "")):
        return _DEEPEST
    return 0


def in_force(query: Query) -> Iterator[tuple[Batch, Sequence[Lane]]]:
    """Latched messages from before a query's time range, to be put in front of it.

    Their log time becomes the beginning of the range, so that the slice spans no more
    than was asked for; the publish time keeps saying when they were sent.
    """
    for recording, begin in query.beginnings():
        topics = sorted(
            {
                lane.channel.topic
                for lane in query.lanes()
                if lane.recording.id == recording.id and depth_of(lane.channel)
            }
        )
        if not topics:
            continue
        before = replace(
            query.store.query(topics, [recording.id]).between("0ns", f"{begin}ns"), _reverse=True
        )
        yield from _last(before, begin)


def _last(before: Query, begin: int) -> Iterator[tuple[Batch, Sequence[Lane]]]:
    """The last messages of each latching channel, oldest first."""
    plan = before.plan()
    room = [depth_of(lane.channel) for lane in plan.lanes]
    kept: list[Batch] = []
    for piece in before.pieces(plan):
        rows = []
        for row, lane in enumerate(piece.batch.channel.tolist()):
            if room[lane] > 0:
                room[lane] -= 1
                rows.append(row)
        if rows:
            kept.append(piece.batch.take(np.array(rows[::-1], np.intp)))
        if not any(room):
            break
    for batch in reversed(kept):
        batch.publish_time = np.where(
            np.array([lane.channel.has_publish_time for lane in plan.lanes])[batch.channel],
            batch.publish_time,
            batch.log_time,
        )
        batch.log_time = np.full(len(batch), begin, np.int64)
        yield batch, plan.lanes
