"""Completeness of an answer: the loss ledger as questions see it, and what else it lacks.

An answer may lack messages that are lost, not written or not indexed yet, or that it could not
read. All is said as a value and in sentences.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from hybridlog.query.intervals import Intervals
from hybridlog.query.planner import Planner, bounds_in, resolved
from hybridlog.query.question import Counters, Question, Span, windows_in
from hybridlog.record.losses import CRASH, Cause, losses_of
from hybridlog.schema.states import CAUSES, GONE, State, without_fields, without_payload
from hybridlog.snapshot import UNFINISHED
from hybridlog.wording import counted, listed, unfit
from hybridlog_storage.errors import HybridlogError, IncompleteError, TimeError, TopicError
from hybridlog_storage.times import BEGIN, END, span_of, touches

if TYPE_CHECKING:
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry, RecordingSummary

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


_INTERVAL_S: Final = 1.0  # flush interval of recorders that do not say it
_MAX_RECORDINGS: Final = 100  # looked at for remarks


class Completeness(Struct, frozen=True):
    """Completeness of an answer in its range.

    Attributes:
        messages: Number of messages that are known to be lost; of a loss that reaches out of
            the range, all of it.
        is_exact: False if an unknown number is lost besides.
        reduced: Messages of which only the fields are stored.
        expired: Those of them whose payloads were deleted to make room.
        not_copied: Those of them whose payloads were not copied yet.
        rows: Rows of the loss ledger, with the name of their `recording`.
        unwritten: Messages that a running recorder has taken and not written yet, which are not
            lost; None for an unknown number.
        unindexed: Messages that the index lacks, where MongoDB must answer.
        problems: What is not as it should be besides losses, in sentences: messages that are not
            written or indexed yet, or lack a transform or what the predicate asks for.
        sentences: Everything that the answer lacks, in sentences, and what may not have been meant.
    """

    messages: int
    is_exact: bool
    reduced: int = 0
    expired: int = 0
    not_copied: int = 0
    rows: tuple[Mapping[str, Any], ...] = ()
    unwritten: int | None = 0
    unindexed: int = 0
    problems: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()

    @property
    def has_losses(self) -> bool:
        """True if any message is lost."""
        return bool(self.messages) or not self.is_exact

    def __str__(self) -> str:
        """The missing messages in words: `4 messages are lost`, and payloads by cause."""
        return "; ".join([self._losses(), *_payloads_gone(self)])

    def _losses(self) -> str:
        if not self.has_losses:
            return "no message is lost"
        are = "is" if self.messages == 1 else "are"
        return f"{number_of(self.messages, is_exact=self.is_exact)} {are} lost"

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

    def check(self, *, payloads: bool = False) -> None:
        """Check that no message of the range is lost, or not written or indexed yet.

        Nor may any lack a transform to the frame asked for, or arrays that the predicate needs.

        Args:
            payloads: True to check that no payload is missing, too.

        Raises:
            IncompleteError: some are.
        """
        problem = " ".join(self.problems)
        if self.has_losses:
            problem = f"{self._losses()} in this range; `hybridlog info --losses` says where."
        elif not problem and payloads and self.reduced:
            problem = f"Of {self.reduced} messages in this range only the fields are stored."
        if problem:
            raise IncompleteError(f"{problem} Without --strict the rest is given.")


def completeness_of(
    session: Session,
    question: Question,
    counters: Counters | None = None,
    *others: tuple[Question, Counters | None],
) -> Completeness:
    """Completeness of an answer, or of a question without one (`counters` is None).

    What the `others` that it depends on have lost is an unknown number.
    """
    answered = [(question, counters), *others]
    given = 0 if counters is None else counters.messages
    is_full = question.limit is not None and given >= question.limit and not question.reverse
    gone, unread = _gone(session, question), _unread(session, question)
    unwritten = [] if is_full else [*_unwritten(session, [one for one, _ in answered])]
    unindexed = _unindexed(session, answered)
    left_out = [one for asked in answered for one in _left_out(session, *asked)]
    late = [*(_not_written(*one) for one in unwritten), *_not_indexed(unindexed)]
    ledgers = [[*losses_in(session, one)] for one, _ in answered]
    lost = [row for row in ledgers[0] if row["cause"] not in NOT_LOST]
    by_recording: dict[str, dict[Any, Mapping[str, Any]]] = defaultdict(dict)
    for row in (row for rows in ledgers for row in rows):  # one of unknown topics is in several
        by_recording[row["recording"]][(*row.items(),)] = row
    sentences = [*(text for text, _ in left_out), *late, *unread]
    for name, rows in by_recording.items():
        sentences += about_losses(name, [*rows.values()])
    for summary, *_ in resolved(session, question) if gone else ():
        sentences += [f"{what}." for what in copies_of(session.entry_of(summary))]
    for one, _ in answered:
        sentences += _unstamped(session, one)
    is_exact = not unread and all(row["count"] is not None for row in lost)
    is_exact &= all(row["cause"] in NOT_LOST for rows in ledgers[1:] for row in rows)
    dropped = sum(row["count"] or 0 for row in ledgers[0] if row["cause"] == Cause.DEGRADE)
    numbers = [number for _, number in unwritten]
    return Completeness(
        sum(row["count"] or 0 for row in lost),
        is_exact,
        reduced=dropped + gone.total(),
        expired=gone[State.EXPIRED],
        not_copied=gone[State.NOT_COPIED],
        rows=tuple(lost),
        unwritten=None if None in numbers else sum(number or 0 for number in numbers),
        unindexed=unindexed.total(),
        problems=(*dict.fromkeys(late), *(text for text, is_problem in left_out if is_problem)),
        sentences=tuple(dict.fromkeys(sentences)),
    )


# Messages without payload, and those that could not be read.


def _gone(session: Session, question: Question) -> Counter[State]:
    """Number of messages in the range of a question whose payloads are gone, by state."""
    summaries = session.snapshot().summaries
    if any(one.expired or one.not_copied or one.status in UNFINISHED for one in summaries):
        with suppress(TimeError, TopicError):  # nothing is in the range, or has this clock
            return +Planner(session, replace(question, predicate=None)).count_expired()
    return Counter()


def _payloads_gone(found: Completeness | Counters) -> Iterator[str]:
    """Messages without their payloads, by state."""
    numbers = {State.REDUCED: found.reduced - found.expired - found.not_copied}
    numbers |= {state: getattr(found, state) for state in GONE}
    yield from (without_payload(number, state) for state, number in numbers.items() if number)


def _left_out(
    session: Session, question: Question, counters: Counters | None
) -> Iterator[tuple[str, bool]]:
    """What an answer could not read or has no payload of; true of what was asked for."""
    if counters is None:
        return
    predicate, unreadable = question.predicate, counters.unreadable - counters.without_arrays
    if question.clock == "header" and question.bounds is not None:
        unreadable = 0  # `_unstamped` tells it
    if unreadable > 0 and (predicate is None or not predicate.asks_fields):
        how = "--format raw, mcap or bag gives payloads"
        yield f"{unfit(unreadable)}: not in this answer; {how}.", False
    elif unreadable > 0:
        what = "fields in the index" if predicate and predicate.filters else "definition that fits"
        yield f"{counted(unreadable, 'message')} could not be tested: no {what}.", False
    if counters.lacking or counters.without_arrays:  # a copy may be waiting for them
        causes = [CAUSES[state] for state in _gone(session, question) or [State.REDUCED]]
        why = ", or ".join(causes)
        if number := counters.without_arrays:
            text = f"{counted(number, 'message')} could not be tested: their arrays were {why}."
            yield text, True
        if number := counters.lacking:
            yield f"{without_fields(number, State.EXPIRED, why)}; these are null.", False
    for gone in _payloads_gone(counters):
        yield f"{gone}: not in this answer; --where and --fields find the fields.", False
    reasons: Counter[str] = Counter()
    for reason, number in counters.no_transform:
        reasons[reason] += number
    for reason, number in reasons.items():
        yield f"{counted(number, 'message')} without a transform {reason}.", True
    yield from ((text, False) for text in counters.of_frames)


def _unread(session: Session, question: Question) -> list[str]:
    """A sentence about recordings that cannot be read, if a question is about all."""
    number = len({*session.shared.repairs.unreadable} - session.snapshot().by_id.keys())
    if not number or question.recordings is not None:
        return []
    which = f"{counted(number, 'recording')} cannot be read and {'is' if number == 1 else 'are'}"
    return [f"{which} left out; `hybridlog verify` says why."]


# Messages that are not written or not indexed yet.


def flush_interval_ns(recording: RecordingSummary) -> int:
    """Time after which a running recording has written a message at the latest, ns."""
    said = recording.source.get("flush_interval_s")
    return int(1e9 * (said if isinstance(said, int | float) else _INTERVAL_S))


def _unwritten(
    session: Session, questions: Sequence[Question]
) -> Iterator[tuple[RecordingSummary, int | None]]:
    """Messages that are not written yet, where questions reach past the last flush.

    None for an unknown number, of a recorder that does not answer.
    """
    topics: dict[str, set[str]] = defaultdict(set)
    for question in questions:
        for one in session.summaries_of(question):
            if one.status == "open" and _reaches_past(session, question, one):
                topics[one.id].update(question.topics)
    for recording, own in topics.items():
        summary = session.snapshot().by_id[recording]
        number = _taken(session, summary, own)
        if number != 0:
            yield summary, number


def _taken(session: Session, recording: RecordingSummary, topics: set[str]) -> int | None:
    """Messages of topics that a recorder has taken and not written; None if it does not say it."""
    from hybridlog.live.state import read

    with suppress(HybridlogError):  # it has just begun or ended, or is no recorder's
        taken = read(session.directory.path, recording.id).taken
        written = session.entry_of(recording).messages_by_topic()
        return sum(max(taken.get(topic, 0) - written[topic], 0) for topic in topics)
    return None


def _reaches_past(session: Session, question: Question, one: RecordingSummary) -> bool:
    """True if a question is about times after the last flush of a recording."""
    during = None if question.during is None else question.during.of_recording(one.id)
    is_log = question.is_by_log_time
    windows = windows_in(during, bounds_in(session, question, one) if is_log else (BEGIN, END))
    return len(windows) > 0 and (one.span is None or int(windows[-1, 1]) > one.span[1])


def _not_written(recording: RecordingSummary, messages: int | None) -> str:
    what = f"up to {flush_interval_ns(recording) / 1e9:g} s"
    if messages is not None:
        what = counted(messages, "message")
    return f"{recording.name} is being recorded: {what} not written yet, nor in this answer."


def _unindexed(
    session: Session, answered: Sequence[tuple[Question, Counters | None]]
) -> Counter[str]:
    """Messages that the index lacks, by recording, where MongoDB has answered or must answer."""
    found: Counter[str] = Counter()
    for question, counters in answered:
        lacks = () if counters is None else counters.not_indexed
        if not lacks and question.predicate is not None and question.predicate.filters:
            with suppress(TimeError):  # nothing is in the range
                lacks = Planner(session, question).not_indexed()
        for name, number in lacks:
            found[name] += number
    return found


def _not_indexed(lacks: Counter[str]) -> Iterator[str]:
    if total := lacks.total():
        yield (
            f"{counted(total, 'message')} of {listed(lacks, MAX_NAMES)} "
            f"{'is' if total == 1 else 'are'} not in the index, nor in this answer of MongoDB; "
            "`hybridlog index rebuild` brings in those of recordings that have ended."
        )


def _unstamped(session: Session, question: Question) -> Iterator[str]:
    """Messages at no time of the header clock."""
    if question.clock != "header" or question.bounds is None:
        return
    entries = map(session.entry_of, session.summaries_of(question)[:_MAX_RECORDINGS])
    channels = [session.channels_of(one, {*question.topics}) for one in entries if one.is_decoded]
    stats = [channel.stats for own in channels for channel in own]
    if missing := sum(one.messages - one.stamped + one.unset for one in stats):
        are = "message is" if missing == 1 else "messages are"
        none = "no header stamp, or one of zero"
        yield f"{missing} {are} at no time of the header clock: {none}."
