"""The loss ledger: what was sent and is not there, from when to when, and why.

A loss is noted where it is seen, often, and by any thread. Rows come out at every flush:
one for all that a topic has lost for one reason since the last one, so that a loss that
goes on for an hour costs no more than one row a flush. Who reads them joins what follows
on one another again.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

_JOINED_NS = 12_000_000_000
_SLOW_NS = 10_000_000_000  # rows of what the user wants are written so often


class Cause(StrEnum):
    """Why messages are missing; one word a row of the loss ledger."""

    TRANSPORT = "transport"
    """They were sent and never reached the recorder: a gap in the sender's numbers."""

    CONNECTION = "connection"
    """A connection broke in the middle of a message."""

    UNREADABLE = "unreadable"
    """They came, and cannot be kept: a type that nobody can say, a broken record."""

    THROTTLE = "throttle"
    """The user wants fewer of them."""

    DEGRADE = "degrade"
    """The memory budget was spent: the payload was given up, the fields were kept."""

    QUEUE = "queue"
    """The memory budget was spent, and there was nothing smaller to keep."""

    DISK = "disk"
    """No space."""

    SEGMENT = "segment"
    """They were stored, and what held them is missing from the store, or damaged."""


@dataclass(slots=True)
class _Open:
    """A row that may still grow."""

    first: int
    last: int
    count: int | None


class Ledger:
    """Notes losses, gives rows. Thread safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[tuple[str, Cause, str], _Open] = {}

    def note(
        self,
        topic: str,
        cause: Cause,
        count: int | None,
        *,
        first: int,
        last: int,
        detail: str = "",
    ) -> None:
        """Note messages that are lost.

        Args:
            topic: Whose; empty when nobody knows.
            cause: Why.
            count: How many, None when that cannot be known.
            first: From when on, ns since the epoch, by the recorder's clock.
            last: Until when, likewise.
            detail: For people.
        """
        with self._lock:
            row = self._open.get((topic, cause, detail))
            if row is None:
                self._open[topic, cause, detail] = _Open(first, last, count)
            else:
                row.first, row.last = min(row.first, first), max(row.last, last)
                row.count = _sum(row.count, count)

    def take(self, *, everything: bool = False) -> list[dict[str, Any]]:
        """The rows since the last time; they are the caller's now.

        Args:
            everything: Also those that need not be written so often.
        """
        with self._lock:
            ready = [
                key
                for key, row in self._open.items()
                if everything or key[1] is not Cause.THROTTLE or row.last - row.first >= _SLOW_NS
            ]
            return [_as_dict(*key, self._open.pop(key)) for key in ready]


def joined(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows that follow on one another as one, in the order in which the losses began.

    Args:
        rows: Rows of one recording; those without times are left as they are.
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


def topics_of(entry: RecordingEntry) -> set[str]:
    """Topics of a recording, those included of which all stored messages are lost.

    A question about such a topic must miss the recording, and say so.
    """
    lost = {row["topic"] for row in _lost_from_store(entry)} - {None}
    return lost | {channel.topic for channel in entry.channels}


def lost_spans(entry: RecordingEntry) -> Iterator[tuple[int, int]]:
    """First and last log time (ns) of stored messages that are lost, a row of the ledger each."""
    for row in _lost_from_store(entry):
        if row["from"] is not None:
            yield row["from"], row["to"]


def _lost_from_store(entry: RecordingEntry) -> Iterator[Mapping[str, Any]]:
    return (row for row in entry.end.get("losses", ()) if row["cause"] == Cause.SEGMENT)


def _sum(one: int | None, other: int | None) -> int | None:
    return None if one is None or other is None else one + other


def _as_dict(topic: str, cause: Cause, detail: str, row: _Open) -> dict[str, Any]:
    """A row as segments and catalog hold it."""
    return {
        "cause": cause.value,
        "count": row.count,
        "file": "",
        "from": row.first,
        "length": None,
        "offset": None,
        "reason": detail,
        "to": row.last,
        "topic": topic or None,
    }
