"""Completeness of an answer: the losses of the recordings that it comes from."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING, Any

from hybridlog.cli.output import counted
from hybridlog.losses import Cause, losses_of, was_cut_short
from hybridlog_storage.errors import TimeError

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry


def describe(entry: RecordingEntry, losses: list[dict[str, Any]]) -> str:
    """The completeness of a recording in words: `complete`, or the number of missing messages."""
    wished = sum(loss["count"] or 0 for loss in losses if loss["cause"] == Cause.THROTTLE)
    losses = [loss for loss in losses if loss["cause"] != Cause.THROTTLE]
    thinned = f"; {counted(wished, 'message')} left out by a throttle" if wished else ""
    return _completeness(entry, losses) + thinned


def _completeness(entry: RecordingEntry, losses: list[dict[str, Any]]) -> str:
    if not losses:
        if entry.status == "open":
            return "being recorded"
        if entry.status == "unproven":
            return "not known: its journal was lost, so a segment may be missing"
        # An empty log is complete; a robot that sent nothing may not have been reached.
        is_live = not entry.source["bytes"]
        return "nothing was received" if is_live and not entry.messages else "complete"
    lost = sum(loss["count"] or 0 for loss in losses)
    if any(loss["count"] is None for loss in losses):
        known = f"at least {counted(lost, 'message')}" if lost else "an unknown number of messages"
        return f"{known} lost in {counted(len(losses), 'place')}"
    if not lost:
        return f"complete, although its source was damaged in {counted(len(losses), 'place')}"
    share = 100 * entry.messages / (entry.messages + lost)
    return (
        f"{counted(lost, 'message')} lost in {counted(len(losses), 'place')} ({share:.2f} % there)"
    )


def line_of(loss: dict[str, Any]) -> str:
    """A row of the ledger in words."""
    count = "messages" if loss["count"] is None else counted(loss["count"], "message")
    place = f" at byte {loss['offset']}" if loss.get("offset") is not None else ""
    file = f" {loss['file']}{place}:" if loss.get("file") else ""
    topic = f" on {loss['topic']}" if loss.get("topic") else ""
    if loss["cause"] == Cause.THROTTLE:
        return f"{count}{topic} left out by a throttle"
    said = f"{file} {loss['reason']}".rstrip()
    lost = "" if loss["count"] == 0 else f"{count}{topic} lost, "
    return f"{lost}{loss['cause']}{':' if said else ''}{said}"


def gaps(
    recordings: Collection[RecordingEntry],
    topics: Collection[str],
    between: tuple[str, str] | None,
) -> Iterator[str]:
    """Lines about what an answer may lack, one a recording.

    Args:
        recordings: The recordings of the answer.
        topics: Its topics.
        between: The time range as typed, by the log clock; None for all times.
    """
    for entry in recordings:
        if entry.status == "open":
            yield f"{entry.label} is still being recorded; later messages are not in this answer."
        if entry.status == "unproven":
            yield f"{entry.label} has lost its journal, so this answer may not be complete."
        if between is not None and not _touches(entry, between):
            continue
        losses = [
            loss
            for loss in losses_of(entry)
            # None is an unknown number, and any topic.
            if loss["count"] != 0 and loss.get("topic") in {None, *topics}
        ]
        wished = [loss for loss in losses if loss["cause"] == Cause.THROTTLE]
        for loss in wished:
            yield f"{entry.label}: {line_of(loss)} while it was recorded."
        if len(losses) > len(wished):
            yield (
                f"{entry.label} is not complete, so this answer may not be: "
                f"{describe(entry, losses)}; `hybridlog info {entry.label}` says where."
            )


def _touches(entry: RecordingEntry, between: tuple[str, str]) -> bool:
    """True when a time range may contain losses; they may lie after the last message."""
    from hybridlog.losses import extent_of
    from hybridlog.query.times import parse_range

    if entry.span is None:
        return True
    start, end = extent_of(entry)
    try:
        low, high = parse_range(*between, start=start, end=end)
    except TimeError:  # empty in this recording: nothing of the answer is from there
        return False
    is_cut = entry.status == "unfinished" or was_cut_short(entry)
    return high > start and (low < end or is_cut)
