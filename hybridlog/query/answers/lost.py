"""Messages that are missing from the range of a question: lost, or not written yet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.query.intervals import Intervals
from hybridlog.query.ranges import RangeResolver
from hybridlog.record.losses import CRASH, Cause, losses_of
from hybridlog.wording import counted
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary

JOURNAL_LOST = "journal lost"
"""Cause of a row for what may have been lost with a journal."""
_INTERVAL_S = 1.0  # flush interval of recorders that do not say it
_EVERYTHING = np.array([[BEGIN, END]], np.int64)


@dataclass(frozen=True, slots=True)
class Lost:
    """Messages that are missing from the range of a question.

    Attributes:
        messages: Number of messages that are known to be lost; of a loss that reaches out of
            the range, all of it.
        is_exact: False if an unknown number is lost besides.
        reduced: Messages of which only the fields are stored.
        rows: Rows of the loss ledger, with the label of their `recording`.
        unwritten: Messages that a running recorder has taken and not written yet, which are not
            lost; None for an unknown number.
    """

    messages: int
    is_exact: bool
    reduced: int
    rows: tuple[Mapping[str, Any], ...]
    unwritten: int | None = 0

    def __bool__(self) -> bool:
        """True if any message is lost."""
        return bool(self.messages) or not self.is_exact

    @property
    def told(self) -> str:
        """The losses in words: `4 messages are lost`."""
        if not self:
            return "no message is lost"
        if not self.messages:
            return "an unknown number of messages are lost"
        is_one = self.messages == 1 and self.is_exact
        number = f"{'' if self.is_exact else 'at least '}{self.messages}"
        return f"{number} message is lost" if is_one else f"{number} messages are lost"

    def limits(self, count: int, limit: int | None = None) -> tuple[int, int | None]:
        """Least and greatest number of messages if none had been lost; None for any number.

        Args:
            count: Number of messages that are there.
            limit: Greatest number that was asked for; None for any.
        """
        most = count + self.messages if self.is_exact else limit
        return count, most if limit is None or most is None else min(most, limit)

    def describe(self, count: int, limit: int | None = None) -> str:
        """A count with its limits in words: `297; 4 lost in this range: 297 to 301`."""
        least, most = self.limits(count, limit)
        known = str(self.messages) if self.messages else "an unknown number"
        if self.messages and not self.is_exact:
            known = f"at least {self.messages}"
        limits = f"{least} or more" if most is None else f"{least} to {most}"
        return f"{count}; {known} lost in this range: {limits}"


def lost_in(session: Session, question: Question) -> Lost:
    """The messages that are missing from the range of a question.

    Raises:
        TimeError: the range is empty, or outside all recordings.
    """
    messages = reduced = 0
    is_exact = True
    found = []
    for entry, row in losses_in(session, question):
        count = row["count"]
        if row["cause"] == Cause.THROTTLE:
            continue  # the user wished it
        if row["cause"] == Cause.DEGRADE:
            reduced += count or 0
            continue
        is_exact = is_exact and count is not None
        messages += count or 0
        found.append({"recording": entry.label, **row})
    late = [count for count, _ in unwritten(session, question)]
    known = [count for count in late if count is not None]
    missing = sum(known) if len(known) == len(late) else None
    return Lost(messages, is_exact, reduced, tuple(found), missing)


def lost_times(session: Session, question: Question) -> Intervals:
    """Log time in which messages were lost, cut to nothing; ends are included."""
    parts = []
    for entry, row in losses_in(session, question):
        if row["cause"] in {Cause.DEGRADE, Cause.THROTTLE}:
            continue
        low, end = span_of(*(_span_of(entry, row) or (BEGIN, END)))
        parts.append((entry.id, np.array([[low, end, 0]], np.int64)))
    return Intervals.of(parts)


def losses_in(
    session: Session, question: Question
) -> Iterator[tuple[RecordingEntry, Mapping[str, Any]]]:
    """Rows of the ledger about topics and times of a question, those of a recording together.

    Raises:
        TimeError: the range is empty, or outside all recordings.
    """
    doubtful = {entry.id: entry for entry in session.doubtful(question)}
    if not doubtful:
        return
    for summary, bounds, windows in RangeResolver(session, question).resolve():
        entry = doubtful.get(summary.id)
        if entry is None:
            continue
        asked = _asked(bounds if question.clock == "log" else None, windows)
        for row in _ledger(entry):
            if row["count"] == 0:
                continue
            if row.get("topic") is not None and row["topic"] not in question.topics:
                continue
            span = _span_of(entry, row)
            if span is None or bool(((asked[:, 0] <= span[1]) & (span[0] < asked[:, 1])).any()):
                yield entry, row


def _asked(bounds: Span | None, windows: NDArray[np.int64] | None) -> NDArray[np.int64]:
    asked = _EVERYTHING if windows is None else windows
    if bounds is not None:
        asked = np.clip(asked, *bounds)
    return asked[asked[:, 1] > asked[:, 0]]


def _ledger(entry: RecordingEntry) -> list[dict[str, Any]]:
    """The loss ledger of a recording, with a row for what a lost journal leaves open."""
    unproven = {"cause": JOURNAL_LOST, "count": None, "topic": None}
    return losses_of(entry) + [unproven] * (entry.status == "unproven")


def _span_of(entry: RecordingEntry, row: Mapping[str, Any]) -> Span | None:
    """First and last log time of a loss, ns; None if it may be anywhere."""
    if row["cause"] == CRASH and entry.span is not None:
        return min(entry.span[1] + 1, END), END
    if row.get("from") is None or row.get("to") is None:
        return None
    return int(row["from"]), int(row["to"])


def unwritten(session: Session, question: Question) -> list[tuple[int | None, str]]:
    """What running recordings have not written, if a question reaches past the last flush.

    Returns:
        For each, the number of messages, None if its recorder does not answer, and a sentence.
    """
    places = session.chosen(question)
    snapshot = session.snapshot()
    found: list[tuple[int | None, str]] = []
    for place in places[snapshot.is_open[places]].tolist():
        one = snapshot.summaries[place]
        if one.status != "open" or not _reaches_past(session, question, one):
            continue
        from hybridlog.live.control_server import request

        messages: int | None = None
        with suppress(HybridlogError, KeyError):  # no socket, or it has just begun or ended
            taken = request(session.directory.path, one.label, "state")["taken"]
            written = session.entry_of(one).messages_by_topic()
            messages = sum(max(taken.get(t, 0) - written[t], 0) for t in question.topics)
        what = f"up to {flush_interval_ns(one) / 1e9:g} s"
        what = what if messages is None else counted(messages, "message")
        if messages != 0:
            told = f"{one.label} is being recorded: {what} not written yet, nor in this answer."
            found.append((messages, told))
    return found


def flush_interval_ns(recording: RecordingSummary) -> int:
    """Time after which a running recording has written a message at the latest, ns."""
    said = recording.source.get("flush_interval_s")
    return int(1e9 * (said if isinstance(said, int | float) else _INTERVAL_S))


def _reaches_past(session: Session, question: Question, one: RecordingSummary) -> bool:
    """True if a question is about times after the last flush of a recording."""
    begin, end = BEGIN, END
    if question.bounds is not None and question.clock == "log":
        begin, end = RangeResolver(session, question).bounds_in(one)
    if question.during is not None:
        windows = question.during.of_recording(one.id)
        end = min(end, int(windows[-1, 1])) if len(windows) else begin
    return end > (begin if one.span is None else max(begin, one.span[1]))


def unindexed(messages: int) -> str:
    """What an answer of MongoDB lacks, in words."""
    are = "is" if messages == 1 else "are"
    return f"{counted(messages, 'message')} {are} not indexed yet, nor in this answer of MongoDB."
