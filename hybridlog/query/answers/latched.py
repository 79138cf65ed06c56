"""Latched messages: those still in force when a slice begins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.latching import depth_of
from hybridlog.query.planner import Planner
from hybridlog.query.ranges import RangeResolver

if TYPE_CHECKING:
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Question, RecordedChannel
    from hybridlog.session import Session
    from hybridlog_storage.messages import Batch


def in_force(
    session: Session, question: Question, counters: Counters
) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
    """Latched messages from before the time range of a question, which precede its answer.

    Their log time becomes the beginning of the range, which keeps the slice within the
    range. The publish time remains the time at which they were sent.
    """
    for recording, begin in RangeResolver(session, question).beginnings():
        channels = session.channels(session.entry_of(recording))
        latching = {c.channel.topic for c in channels if depth_of(c.channel)}
        topics = sorted(latching.intersection(question.topics))
        if not topics:
            continue
        before = replace(
            question,
            topics=tuple(topics),
            recordings=(recording.id,),
            bounds=(0, begin),
            clock="log",
            predicate=None,
            during=None,
            limit=None,
            every=1,
            reverse=True,
        )
        yield from _last(session, before, counters, begin)


def _last(
    session: Session, before: Question, counters: Counters, begin: int
) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
    """The last messages of each latching channel, oldest first."""
    room: list[int] = []
    found: list[Batch] = []
    channels: Sequence[RecordedChannel] = ()
    # The runs of one recording have the same channels.
    for run in Planner(session, before, counters).runs():
        if not channels:
            channels = run.channels
            room = [depth_of(channel.channel) for channel in channels]
        rows = []
        for row, index in enumerate(run.batch.channel.tolist()):
            if room[index] > 0:
                room[index] -= 1
                rows.append(row)
        if rows:
            found.append(run.batch.take(np.array(rows[::-1], np.intp)))
        if not any(room):
            break
    has_publish_time = np.array([c.channel.has_publish_time for c in channels])
    for batch in reversed(found):
        batch.publish_time = np.where(
            has_publish_time[batch.channel], batch.publish_time, batch.log_time
        )
        batch.log_time = np.full(len(batch), begin, np.int64)
        yield batch, channels
