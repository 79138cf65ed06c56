"""Finds what an answer lacks: messages that are lost, not written or not indexed yet."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.query.answers.completeness import (
    MANIFEST_LOST,
    NOT_LOST,
    Completeness,
    about_losses,
    copies_of,
    left_out,
    not_indexed,
    not_written,
)
from hybridlog.query.intervals import Intervals
from hybridlog.query.planner import Planner
from hybridlog.query.question import Counters, windows_in
from hybridlog.query.ranges import RangeResolver
from hybridlog.record.losses import CRASH, Cause, losses_of
from hybridlog.schema.states import CAUSES, GONE, State
from hybridlog.snapshot import UNFINISHED
from hybridlog.wording import counted
from hybridlog_storage.errors import HybridlogError, TimeError, TopicError
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary

_INTERVAL_S = 1.0  # flush interval of recorders that do not say it


def completeness_of(
    session: Session,
    question: Question,
    counters: Counters | None = None,
    *others: tuple[Question, Counters | None],
) -> Completeness:
    """Completeness of an answer.

    Args:
        session: The open store.
        question: The question.
        counters: Of the answer; None before there is one. An answer that was limited lacks
            nothing that comes later.
        others: Questions that the answer depends on. What they have lost counts as an unknown
            number.
    """
    answered = [(question, counters), *others]
    ledgers = [_rows_of(session, one) for one, _ in answered]
    lost = [row for row in ledgers[0] if row["cause"] not in NOT_LOST]
    given = 0 if counters is None else counters.messages
    is_full = question.limit is not None and given >= question.limit and not question.reverse
    unwritten, late = (0, []) if is_full else _unwritten(session, [one for one, _ in answered])
    sentences: list[str] = []
    unindexed = 0
    for one, cost in answered:
        lacks = _unindexed(session, one, cost)
        unindexed += sum(number for _, number in lacks)
        late += not_indexed(lacks)
        if cost is not None:
            is_short = cost.lacking or cost.without_arrays
            sentences += left_out(one, cost, _why_expired(session, one) if is_short else "")
    unreadable = _unreadable(session, question)
    by_recording: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    own = {tuple(row.items()) for row in ledgers[0]}
    more = {key: row for rows in ledgers[1:] for row in rows if (key := (*row.items(),)) not in own}
    for row in (*ledgers[0], *more.values()):  # a loss of unknown topics is in several
        by_recording[row["recording"]].append(row)
    sentences += [*late, *unreadable]
    for name, rows in by_recording.items():
        sentences += about_losses(name, rows)
    expired = _expired(session, question)
    if expired:
        sentences += _elsewhere(session, question)
    return Completeness(
        sum(row["count"] or 0 for row in lost),
        is_exact=not unreadable
        and not any(row["count"] is None for row in lost)
        and all(row["cause"] in NOT_LOST for rows in ledgers[1:] for row in rows),
        reduced=sum(row["count"] or 0 for row in ledgers[0] if row["cause"] == Cause.DEGRADE)
        + expired.total(),
        expired=expired[State.EXPIRED],
        not_copied=expired[State.NOT_COPIED],
        rows=tuple(lost),
        unwritten=unwritten,
        unindexed=unindexed,
        untransformed=sum(n for _, cost in answered if cost for _, n in cost.no_transform),
        untested=sum(cost.without_arrays for _, cost in answered if cost),
        late=tuple(dict.fromkeys(late)),
        sentences=tuple(dict.fromkeys(sentences)),
    )


def _unreadable(session: Session, question: Question) -> list[str]:
    """A sentence about recordings that cannot be read, if a question is about all."""
    known = session.snapshot().by_id
    number = sum(one not in known for one in [*session.shared.repairs.unreadable])
    if not number or question.recordings is not None:
        return []
    are = "is" if number == 1 else "are"
    return [
        f"{counted(number, 'recording')} cannot be read and {are} left out; `hybridlog verify` "
        "says why."
    ]


def _why_expired(session: Session, question: Question) -> str:
    """Why payloads that an answer lacks are gone: a copy may be waiting for them."""
    found = _expired(session, question)
    return ", or ".join(CAUSES[state] for state in GONE if found[state]) or CAUSES[State.REDUCED]


def _expired(session: Session, question: Question) -> Counter[State]:
    """Number of messages in the range of a question whose payloads are gone, by state."""
    summaries = session.snapshot().summaries
    if not any(one.expired or one.not_copied or one.status in UNFINISHED for one in summaries):
        return Counter()
    with suppress(TimeError, TopicError):  # nothing is in the range, or has this clock
        return Planner(session, question).count_expired()
    return Counter()


def _elsewhere(session: Session, question: Question) -> list[str]:
    """Sentences about copies with payloads that recordings of a question lack here."""
    entries = (session.entry_of(one) for one, _, _ in RangeResolver(session, question).resolve())
    return [f"{what}." for entry in entries for what in copies_of(entry)]


def _rows_of(session: Session, question: Question) -> list[Mapping[str, Any]]:
    """Rows of the ledger about a question, with the name of their recording."""
    with suppress(TimeError):  # nothing is in the range
        return [{"recording": e.name, **row} for e, row in _losses_in(session, question)]
    return []


def lost_times(session: Session, question: Question) -> Intervals:
    """Log time in which messages were lost, cut to nothing; ends are included."""
    parts = []
    for entry, row in _losses_in(session, question):
        if row["cause"] in NOT_LOST:
            continue
        low, end = span_of(*(_span_of(entry, row) or (BEGIN, END)))
        parts.append((entry.id, np.array([[low, end, 0]], np.int64)))
    return Intervals(parts)


def _losses_in(
    session: Session, question: Question
) -> Iterator[tuple[RecordingEntry, Mapping[str, Any]]]:
    """Rows of the ledger about topics and times of a question, those of a recording together."""
    doubtful = {entry.id: entry for entry in session.doubtful(question)}
    if not doubtful:
        return
    for summary, bounds, windows in RangeResolver(session, question).resolve():
        entry = doubtful.get(summary.id)
        if entry is None:
            continue
        chosen = windows_in(windows, bounds if question.clock == "log" else None)
        for row in _ledger(entry):
            if row["count"] == 0:
                continue
            if row.get("topic") is not None and row["topic"] not in question.topics:
                continue
            span = _span_of(entry, row)
            if span is None or bool(((chosen[:, 0] <= span[1]) & (span[0] < chosen[:, 1])).any()):
                yield entry, row


def _ledger(entry: RecordingEntry) -> list[dict[str, Any]]:
    """The loss ledger of a recording, with a row for what a lost manifest leaves open."""
    unproven = {"cause": MANIFEST_LOST, "count": None, "topic": None}
    return losses_of(entry) + [unproven] * ("unproven" in {entry.status, entry.end.get("status")})


def _span_of(entry: RecordingEntry, row: Mapping[str, Any]) -> Span | None:
    """First and last log time of a loss, ns; None if it may be anywhere."""
    if row["cause"] == CRASH and entry.span is not None:
        return min(entry.span[1] + 1, END), END
    if row.get("from") is None or row.get("to") is None:
        return None
    return int(row["from"]), int(row["to"])


def _unwritten(session: Session, questions: Sequence[Question]) -> tuple[int | None, list[str]]:
    """Messages that are not written yet, if questions reach past the last flush.

    Returns:
        Their number, None if a recorder does not answer; and a sentence for each recording.
    """
    running: dict[str, RecordingSummary] = {}
    topics: dict[str, set[str]] = defaultdict(set)
    for question in questions:
        for one in session.summaries_of(question):
            if one.status == "open" and _reaches_past(session, question, one):
                running[one.id] = one
                topics[one.id].update(question.topics)
    missing: int | None = 0
    sentences: list[str] = []
    for one in running.values():
        late = _taken(session, one)
        number = None if late is None else sum(late.get(topic, 0) for topic in topics[one.id])
        missing = None if number is None or missing is None else missing + number
        if number != 0:
            sentences.append(not_written(one.name, number, flush_interval_ns(one)))
    return missing, sentences


def _taken(session: Session, recording: RecordingSummary) -> dict[str, int] | None:
    """Messages that a recorder has taken and not written, by topic; None if it does not say it."""
    from hybridlog.live.state import read

    with suppress(HybridlogError):  # it has just begun or ended, or is no recorder's
        taken = read(session.directory.path, recording.id).taken
        written = session.entry_of(recording).messages_by_topic()
        return {topic: max(count - written[topic], 0) for topic, count in taken.items()}
    return None


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


def _unindexed(
    session: Session, question: Question, counters: Counters | None
) -> Sequence[tuple[str, int]]:
    """Messages that the index lacks, where MongoDB has answered or must answer."""
    if counters is not None and counters.not_indexed:
        return counters.not_indexed
    if question.predicate is None or not question.predicate.filters:
        return ()
    with suppress(TimeError):  # nothing is in the range
        return Planner(session, question).not_indexed()
    return ()


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
