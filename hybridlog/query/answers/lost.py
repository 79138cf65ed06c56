"""The loss ledger as questions see it: its rows and their times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.query.answers.loss_words import MANIFEST_LOST, NOT_LOST
from hybridlog.query.intervals import Intervals
from hybridlog.query.question import windows_in
from hybridlog.query.ranges import RangeResolver
from hybridlog.record.losses import CRASH, Cause, losses_of
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry

    Row = Mapping[str, Any]
    """A row of a ledger."""


def losses_in(session: Session, question: Question) -> Iterator[tuple[RecordingEntry, Row]]:
    """Rows of the ledger about topics and times of a question, those of a recording together.

    A lost manifest leaves open what was lost: one more row.
    """
    doubtful = {entry.id: entry for entry in session.doubtful(question)}
    for summary, bounds, windows in RangeResolver(session, question).resolve() if doubtful else ():
        entry = doubtful.get(summary.id)
        if entry is None:
            continue
        chosen = windows_in(windows, bounds if question.clock == "log" else None)
        ledger = losses_of(entry)
        if "unproven" in {entry.status, entry.end.get("status")}:
            ledger += [{"cause": MANIFEST_LOST, "count": None, "topic": None}]
        for row in ledger:
            span = _span_of(entry, row)
            is_inside = span is None or bool(
                ((chosen[:, 0] <= span[1]) & (span[0] < chosen[:, 1])).any()
            )
            if is_inside and row["count"] != 0 and row.get("topic") in {None, *question.topics}:
                yield entry, row


def _span_of(entry: RecordingEntry, row: Row) -> Span | None:
    """First and last log time of a loss, ns; None if it may be anywhere."""
    if row["cause"] == CRASH and entry.span is not None:
        return min(entry.span[1] + 1, END), END
    if row.get("from") is None or row.get("to") is None:
        return None
    return int(row["from"]), int(row["to"])


def lost_times(session: Session, question: Question) -> Intervals:
    """Log time in which messages were lost, cut to nothing; ends are included."""
    parts = []
    for entry, row in losses_in(session, question):
        if row["cause"] not in NOT_LOST:
            low, high = span_of(*(_span_of(entry, row) or (BEGIN, END)))
            parts.append((entry.id, np.array([[low, high, 0]], np.int64)))
    return Intervals(parts)


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
