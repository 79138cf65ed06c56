"""Completeness of a recording in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlog.record.losses import Cause, in_words
from hybridlog.wording import counted

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

_NOT_LOST = {Cause.THROTTLE: "left out by a throttle", Cause.DEGRADE: "without their payload"}


def describe(entry: RecordingEntry, losses: list[dict[str, Any]]) -> str:
    """The completeness of a recording in words: `complete`, or the number of missing messages."""
    found = _completeness(entry, [loss for loss in losses if loss["cause"] not in _NOT_LOST])
    for cause, what in _NOT_LOST.items():
        messages = sum(loss["count"] or 0 for loss in losses if loss["cause"] == cause)
        found += f"; {counted(messages, 'message')} {what}" if messages else ""
    return found


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
        return in_words(losses)
    if not lost:
        return f"complete, although its source was damaged in {counted(len(losses), 'place')}"
    share = min(100 * entry.messages / (entry.messages + lost), 99.99)
    return f"{in_words(losses)} ({share:.2f} % there)"
