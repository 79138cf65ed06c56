"""The loss ledger as questions see it: its rows, their times, and sentences about them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.query.intervals import Intervals
from hybridlog.query.planner import resolved
from hybridlog.query.question import windows_in
from hybridlog.record.losses import CRASH, Cause, losses_of
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import TimeError
from hybridlog_storage.times import BEGIN, END, span_of, touches

if TYPE_CHECKING:
    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry

    Row = Mapping[str, Any]
    """A row of a ledger."""


MANIFEST_LOST: Final = "manifest lost"
"""Cause of a row for what may have been lost with a manifest."""
NOT_LOST: Final = {Cause.THROTTLE: "left out by a throttle", Cause.DEGRADE: "without their payload"}
"""Causes of rows about messages that are no loss: not wanted, or with their fields kept."""
MAX_NAMES: Final = 5


def about_losses(name: str, rows: Sequence[Row]) -> Iterator[str]:
    """Sentences about rows of the ledger of a recording."""
    if any(row["cause"] == MANIFEST_LOST for row in rows):
        yield f"{name} has lost its manifest once, so this answer may not be complete."
    for row in rows:
        if row["cause"] == Cause.THROTTLE:
            yield f"{name}: {line_of(row)} while it was recorded."
    lost = [row for row in rows if row["cause"] not in {MANIFEST_LOST, *NOT_LOST}]
    if lost:
        causes = listed(dict.fromkeys(row["cause"] for row in lost), MAX_NAMES)
        yield (
            f"{name} is not complete, so this answer may not be: {in_words(lost)} ({causes}); "
            f"`hybridlog info {quote(name)}` says where."
        )


def in_words(losses: Collection[Row]) -> str:
    """The number of lost messages: `at least 4 messages lost in 2 places`."""
    is_exact = all(loss["count"] is not None for loss in losses)
    known = number_of(sum(loss["count"] or 0 for loss in losses), is_exact=is_exact)
    return f"{known} lost in {counted(len(losses), 'place')}"


def number_of(lost: int, *, is_exact: bool) -> str:
    """A number of lost messages, which is the least one if it is not exact."""
    known = counted(lost, "message")
    return known if is_exact else f"at least {known}" if lost else "an unknown number of messages"


def line_of(loss: Row) -> str:
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


def coverage(entry: RecordingEntry, losses: Collection[Row]) -> str:
    """The completeness of a recording in words: `complete`, or the number of missing messages."""
    from hybridlog.schema.states import expired_messages, without_payload

    found = [_coverage(entry, [loss for loss in losses if loss["cause"] not in NOT_LOST])]
    for cause, what in NOT_LOST.items():
        if messages := sum(loss["count"] or 0 for loss in losses if loss["cause"] == cause):
            found.append(f"{counted(messages, 'message')} {what}")
    found += (without_payload(number, state) for state, number in expired_messages(entry).items())
    return "; ".join([*found, *copies_of(entry)])


def copies_of(entry: RecordingEntry) -> list[str]:
    """Sentences that name the copies with payloads that a recording lacks."""
    copies = sorted({file.copy for file in entry.manifest.files if file.copy})
    return [f"{address} has more payloads of {entry.name}; ask there" for address in copies]


def _coverage(entry: RecordingEntry, losses: Collection[Row]) -> str:
    if not losses:
        if entry.status == "open":
            return "being recorded"
        if entry.status == "unproven":
            return "not known: its manifest was lost, so a segment may be missing"
        # An empty log is complete; a robot that sent nothing may not have been reached.
        is_live = not entry.manifest.source.bytes
        return "nothing was received" if is_live and not entry.messages else "complete"
    lost = sum(loss["count"] or 0 for loss in losses)
    if any(loss["count"] is None for loss in losses):
        return in_words(losses)
    if not lost:
        return f"complete, although its source was damaged in {counted(len(losses), 'place')}"
    share = min(100 * entry.messages / (entry.messages + lost), 99.99)
    return f"{in_words(losses)} ({share:.2f} % there)"


def losses_in(session: Session, question: Question) -> Iterator[Row]:
    """Rows of the ledger about topics and times of a question, with their `recording`'s name."""
    with suppress(TimeError):  # nothing is in the range
        yield from ({"recording": entry.name, **row} for entry, row in _losses(session, question))


def _losses(session: Session, question: Question) -> Iterator[tuple[RecordingEntry, Row]]:
    """The rows, those of a recording together.

    A lost manifest leaves open what was lost: one more row.
    """
    doubtful = {entry.id: entry for entry in session.doubtful(question)}
    for summary, windows, _ in resolved(session, question) if doubtful else ():
        entry = doubtful.get(summary.id)
        ledger = [] if entry is None else losses_of(entry)
        if entry is not None and "unproven" in {entry.status, entry.manifest.status}:
            ledger += [{"cause": MANIFEST_LOST, "count": None, "topic": None}]
        for row in ledger:
            assert entry is not None
            first, last = _span_of(entry, row)
            is_asked = row["count"] != 0 and row.get("topic") in {None, *question.topics}
            if is_asked and touches(windows_in(windows), first, last):
                yield entry, row


def _span_of(entry: RecordingEntry, row: Row) -> Span:
    """First and last log time of a loss, ns; all times if it may be anywhere."""
    if row["cause"] == CRASH and entry.span is not None:
        return min(entry.span[1] + 1, END), END
    if row.get("from") is None or row.get("to") is None:
        return BEGIN, END
    return int(row["from"]), int(row["to"])


def lost_times(session: Session, question: Question) -> Intervals:
    """Log time in which messages were lost, cut to nothing; ends are included."""
    return Intervals(
        (entry.id, np.array([[*span_of(*_span_of(entry, row)), 0]], np.int64))
        for entry, row in _losses(session, question)
        if row["cause"] not in NOT_LOST
    )
