"""The loss ledger: missing messages, with time range and cause.

A loss is noted where it is detected, often, and by any thread. Each flush returns one row
for all losses of a topic with the same cause since the last flush. A continuous loss of an
hour therefore costs at most one row for each flush. Readers join successive rows.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from hybridlog_storage.manifest import LOST, Loss, replace

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

CRASH = "cut short by a crash"
"""Cause of the loss of what was not stored yet when a recorder died."""

_JOINED_NS = 12_000_000_000
_SLOW_NS = 10_000_000_000  # interval between rows for losses that the user wants


class Cause(StrEnum):
    """Reason for missing messages; one word in each row of the loss ledger."""

    TRANSPORT = "transport"
    """They were sent and never reached the recorder: a gap in the sender's numbers."""

    CONNECTION = "connection"
    """A connection broke in the middle of a message."""

    UNREADABLE = "unreadable"
    """They were received and cannot be stored: an unusable type, a broken record."""

    THROTTLE = "throttle"
    """The user wants fewer messages."""

    DEGRADE = "degrade"
    """The memory budget was exhausted: only the fields were stored."""

    QUEUE = "queue"
    """The memory budget was exhausted, and no smaller form could be stored."""

    CLOCK = "clock"
    """They came before the first message of `/clock`, which gives the log time."""

    DISK = "disk"
    """The disk was full."""

    SEGMENT = LOST
    """They were stored, and their part of the store is missing or damaged."""


class Ledger:
    """Collects losses with their times, by the recorder's clock, which may have gone back between.

    Thread safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[tuple[str, str, str], Loss] = {}  # rows that may still grow

    def note(self, loss: Loss) -> None:
        """Note lost messages."""
        key = loss.topic, loss.cause, loss.reason
        with self._lock:
            known = self._open.get(key)
            count = loss.count if known is None else _sum(known.count, loss.count)
            known = known or loss
            times = known.first, known.last, loss.first, loss.last
            span = [time for time in times if time is not None]
            self._open[key] = replace(loss, count=count, first=min(span), last=max(span))

    def take(self, *, everything: bool = False) -> list[Loss]:
        """The rows since the last call; the ledger forgets them.

        Args:
            everything: True to include rows that are written less often.
        """
        with self._lock:
            ready = [
                key
                for key, row in self._open.items()
                if everything
                or row.cause != Cause.THROTTLE
                or (row.last or 0) - (row.first or 0) >= _SLOW_NS
            ]
            return [self._open.pop(key) for key in ready]


def joined(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows that follow each other joined, in the order in which the losses began.

    Args:
        rows: Rows of one recording; those without times are unchanged.
    """
    found: list[dict[str, Any]] = []
    latest: dict[tuple[str, str, str], dict[str, Any]] = {}
    timed = [dict(row) for row in rows if row.get("from") is not None]
    for row in sorted(timed, key=lambda row: (row["from"], row["to"])):
        key = row["topic"] or "", row["cause"], row["reason"]
        before = latest.get(key)
        if before is not None and row["from"] - before["to"] <= _JOINED_NS:
            before["to"] = max(before["to"], row["to"])
            before["count"] = _sum(before["count"], row["count"])
        else:
            latest[key] = row
            found.append(row)
    return [dict(row) for row in rows if row.get("from") is None] + found


def losses_of(entry: RecordingEntry) -> list[dict[str, Any]]:
    """The loss ledger of a recording, with a row for what a crash cut off."""
    losses = [dict(loss) for loss in entry.losses]
    if entry.status == "unfinished":
        losses.append(_of_a_crash("what came after its last flushed message is lost"))
    if "recovered" in {entry.status, entry.manifest.status}:  # a crash ended it
        losses.append(_of_a_crash("what came after its last message was not stored"))
    return losses


def _of_a_crash(reason: str) -> dict[str, Any]:
    """A loss of an unknown number of messages."""
    row: dict[str, Any] = {"cause": CRASH, "file": "", "offset": None, "reason": reason}
    return row | {"count": None, "topic": None}


def _sum(one: int | None, other: int | None) -> int | None:
    return None if one is None or other is None else one + other
