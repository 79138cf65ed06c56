"""Completeness of an answer: the value, and the sentences about it.

An answer may lack messages that are lost, not written or not indexed yet, or that it could
not read. `lost.py` finds them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from shlex import quote
from typing import TYPE_CHECKING, Any

from hybridlog.record.losses import Cause
from hybridlog.wording import counted, listed, unfit
from hybridlog_storage.errors import IncompleteError

if TYPE_CHECKING:
    from hybridlog.query.question import Counters, Question
    from hybridlog.schema.states import State
    from hybridlog_storage.catalog import RecordingEntry

MANIFEST_LOST = "manifest lost"
"""Cause of a row for what may have been lost with a manifest."""
NOT_LOST = {Cause.THROTTLE: "left out by a throttle", Cause.DEGRADE: "without their payload"}
"""Causes of rows about messages that are no loss: not wanted, or with their fields kept."""
_MAX_NAMES = 5


@dataclass(frozen=True, slots=True)
class Completeness:
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
        untransformed: Messages whose points or poses are not in the frame asked for.
        untested: Messages that lack what the predicate asks for, since their payloads were
            deleted; known after the answer.
        late: Sentences about messages that are not written or not indexed yet.
        sentences: Everything that the answer lacks, in sentences, those of `late` included.
    """

    messages: int
    is_exact: bool
    reduced: int = 0
    expired: int = 0
    not_copied: int = 0
    rows: tuple[Mapping[str, Any], ...] = ()
    unwritten: int | None = 0
    unindexed: int = 0
    untransformed: int = 0
    untested: int = 0
    late: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()

    @property
    def has_losses(self) -> bool:
        """True if any message is lost."""
        return bool(self.messages) or not self.is_exact

    def __str__(self) -> str:
        """The missing messages in words: `4 messages are lost`, and payloads by cause."""
        from hybridlog.schema.states import without_payload

        gone = (without_payload(number, state) for state, number in _gone(self).items())
        return "; ".join([self._losses(), *gone])

    def _losses(self) -> str:
        if not self.has_losses:
            return "no message is lost"
        are = "is" if self.messages == 1 else "are"
        return f"{_number(self.messages, is_exact=self.is_exact)} {are} lost"

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
        problems = {
            f"{self._losses()} in this range; `hybridlog info --losses` says where.": (
                self.has_losses
            ),
            " ".join(self.late): self.late,
            f"{counted(self.untransformed, 'message')} without a transform.": self.untransformed,
            f"{counted(self.untested, 'message')} could not be tested: their arrays were deleted, "
            "or not copied yet.": self.untested,
            f"Of {self.reduced} messages in this range only the fields are stored.": (
                payloads and self.reduced
            ),
        }
        for problem, is_there in problems.items():
            if is_there:
                raise IncompleteError(f"{problem} Without --strict the rest is given.")


def not_written(name: str, messages: int | None, interval_ns: int) -> str:
    """Sentence about messages not yet written; None for an unknown number of them."""
    what = f"up to {interval_ns / 1e9:g} s" if messages is None else counted(messages, "message")
    return f"{name} is being recorded: {what} not written yet, nor in this answer."


def not_indexed(lacks: Iterable[tuple[str, int]]) -> Iterator[str]:
    """Messages that the index lacks, by the name of their recording."""
    total: Counter[str] = Counter()
    for name, number in lacks:
        total[name] += number
    if total:
        are = "is" if total.total() == 1 else "are"
        yield (
            f"{counted(total.total(), 'message')} of {listed(total, _MAX_NAMES)} {are} not in the "
            "index, nor in this answer of MongoDB; `hybridlog index rebuild` brings in those of "
            "recordings that have ended."
        )


def _gone(counted: Completeness | Counters) -> dict[State, int]:
    """Number of messages without their payloads, by state; none is 0."""
    from hybridlog.schema.states import GONE, State

    found = {State.REDUCED: counted.reduced - counted.expired - counted.not_copied}
    found |= {state: getattr(counted, state) for state in GONE}
    return {state: number for state, number in found.items() if number}


def left_out(question: Question, counters: Counters, expired: str) -> Iterator[str]:
    """Messages that an answer could not read or has no payload of."""
    from hybridlog.schema.states import State, without_fields, without_payload

    if counters.unreadable > counters.without_arrays:
        yield _unreadable(counters.unreadable - counters.without_arrays, question)
    if counters.without_arrays:
        its = "its payload was" if counters.without_arrays == 1 else "their payloads were"
        yield (
            f"{counted(counters.without_arrays, 'message')} could not be tested: {its} {expired}; "
            "of long arrays only summaries are left."
        )
    for state, number in _gone(counters).items():
        yield (
            f"{without_payload(number, state)}: not in this answer; --where and --fields find "
            "the fields."
        )
    if counters.lacking:
        yield f"{without_fields(counters.lacking, State.EXPIRED, expired)}; these are null."
    reasons: Counter[str] = Counter()
    for why, number in counters.no_transform:
        reasons[why] += number
    for why, number in reasons.items():
        yield f"{counted(number, 'message')} without a transform {why}."
    yield from dict.fromkeys(counters.of_frames)


def _unreadable(messages: int, question: Question) -> str:
    """A number of messages whose fields could not be read."""
    one, predicate = messages == 1, question.predicate
    if predicate is None or not predicate.asks_fields:
        return (
            f"{unfit(messages)} and {'is' if one else 'are'} not in this answer; --format raw, "
            "mcap or bag gives the payloads."
        )
    if predicate.filters:
        why = "it has no fields in the index" if one else "they have no fields in the index"
    elif one:
        why = "it does not fit its definition, or has none"
    else:
        why = "they do not fit their definition, or have none"
    return f"{counted(messages, 'message')} could not be tested: {why}."


def about_losses(name: str, rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Rows of the ledger of a recording."""
    if any(row["cause"] == MANIFEST_LOST for row in rows):
        yield f"{name} has lost its manifest once, so this answer may not be complete."
    for row in rows:
        if row["cause"] == Cause.THROTTLE:
            yield f"{name}: {line_of(row)} while it was recorded."
    lost = [row for row in rows if row["cause"] not in {MANIFEST_LOST, *NOT_LOST}]
    if lost:
        causes = listed(dict.fromkeys(row["cause"] for row in lost), _MAX_NAMES)
        yield (
            f"{name} is not complete, so this answer may not be: {in_words(lost)} ({causes}); "
            f"`hybridlog info {quote(name)}` says where."
        )


def in_words(losses: Collection[Mapping[str, Any]]) -> str:
    """The number of lost messages: `at least 4 messages lost in 2 places`."""
    is_exact = all(loss["count"] is not None for loss in losses)
    known = _number(sum(loss["count"] or 0 for loss in losses), is_exact=is_exact)
    return f"{known} lost in {counted(len(losses), 'place')}"


def _number(lost: int, *, is_exact: bool) -> str:
    """A number of lost messages, which is the least one if it is not exact."""
    known = counted(lost, "message")
    return known if is_exact else f"at least {known}" if lost else "an unknown number of messages"


def line_of(loss: Mapping[str, Any]) -> str:
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


def coverage(entry: RecordingEntry, losses: Collection[Mapping[str, Any]]) -> str:
    """The completeness of a recording in words: `complete`, or the number of missing messages."""
    from hybridlog.schema.states import expired_messages, without_payload

    found = _coverage(entry, [loss for loss in losses if loss["cause"] not in NOT_LOST])
    for cause, what in NOT_LOST.items():
        messages = sum(loss["count"] or 0 for loss in losses if loss["cause"] == cause)
        found += f"; {counted(messages, 'message')} {what}" if messages else ""
    gone = (without_payload(number, state) for state, number in expired_messages(entry).items())
    return "; ".join([found, *gone, *copies_of(entry)])


def copies_of(entry: RecordingEntry) -> list[str]:
    """Where payloads are that a recording lacks, in words."""
    return [f"{address} has more payloads of {entry.name}" for address in entry.copies]


def _coverage(entry: RecordingEntry, losses: Collection[Mapping[str, Any]]) -> str:
    if not losses:
        if entry.status == "open":
            return "being recorded"
        if entry.status == "unproven":
            return "not known: its manifest was lost, so a segment may be missing"
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
