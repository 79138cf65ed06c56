"""Intervals from messages: states, changes, windows around events, times near other topics.

Marks are such messages, too: what happened, at a moment or for a while.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial, reduce
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec.structs import replace

from hybridlog.arrays.message_arrays import plain_type
from hybridlog.columns.fields import joined
from hybridlog.message import Message, messages_in
from hybridlog.query.answers.completeness import lost_times
from hybridlog.query.intervals import Intervals, changing, clipped, holding
from hybridlog.query.planner import Planner, log_spans
from hybridlog.query.predicate.tree import (
    And,
    Condition,
    Near,
    Node,
    Not,
    Or,
    Predicate,
    check,
    nodes,
)
from hybridlog.query.question import Counters, Question, windows_in
from hybridlog.query.times import TIME_LIMIT, DurationLike, decoded_time, parse_duration
from hybridlog.record.marks import MARK
from hybridlog.schema.arrow_types import is_list, lengths_of
from hybridlog.schema.column import ranges
from hybridlog.wording import listed
from hybridlog_storage.errors import HybridlogError, UsageError, WhereError
from hybridlog_storage.times import END, earlier, inside, placed

if TYPE_CHECKING:
    from hybridlog.session import Session

EVENT: Final = "foxglove.Event"
_NAMES: Final = ("text", "name", "title", "event", "type")
"""Keys of the metadata of an event that may say what it is, the best first."""


class Mark(NamedTuple):
    """A mark, or an event of Foxglove.

    Attributes:
        recording: Id of its recording.
        begin: ns since the epoch.
        end: The same; None for a moment.
        text: What happened.
        tags: Further values by name.
    """

    recording: str
    begin: int
    end: int | None
    text: str
    tags: Mapping[str, str]


def mark_topics(session: Session, recordings: Collection[str] | None = None) -> tuple[str, ...]:
    """Full names of the topics with marks in some recordings (ids), or in all."""
    known = session.look(recordings).kinds
    return tuple(sorted({one.topic for one in known if plain_type(one.type) in {MARK, EVENT}}))


def marks(session: Session, question: Question, counters: Counters | None = None) -> Iterator[Mark]:
    """The marks among the messages of a question, in their order.

    Unreadable ones are left out; `counters.unreadable` counts them.
    """
    planner = Planner(session, question, counters)
    for run in planner.runs():
        for message in messages_in(run):
            if plain_type(message.type) not in {MARK, EVENT}:
                continue
            try:
                yield _mark_of(message)
            except HybridlogError:
                planner.counters.unreadable += 1


def marks_in(session: Session, recordings: Collection[str]) -> Iterator[Mark]:
    """All marks of some recordings, in order of log time."""
    topics = mark_topics(session, recordings)
    having = {one.id for one in session.snapshot().having(topics)}
    chosen = tuple(one for one in recordings if one in having)
    if chosen:
        yield from marks(session, Question(topics, chosen))


def _mark_of(message: Message) -> Mark:
    fields: dict[str, Any] = message.fields
    begin: int | None
    if plain_type(message.type) == MARK:
        begin, end = message.log_time_ns, fields.get("end")
        text, tags = fields.get("text"), fields.get("tags")
    else:
        begin, end = (decoded_time(fields.get(f"{edge}_time")) for edge in ("start", "end"))
        found = fields.get("metadata")
        pairs = [one for one in found if isinstance(one, dict)] if isinstance(found, list) else []
        tags = {str(one.get("key")): str(one.get("value")) for one in pairs}
        known = next((tags[name] for name in _NAMES if name in tags), None)
        text = known or ", ".join(f"{key}={value}" for key, value in tags.items())
    begin = message.log_time_ns if begin is None else begin
    lasts = isinstance(end, int) and end > begin
    return Mark(
        message.recording,
        begin,
        end if lasts else None,
        str(text or ""),
        tags if isinstance(tags, dict) else {},
    )


if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Part, Question, Span
    from hybridlog.query.rows import RowBatch
    from hybridlog.session import Session

    Places = NDArray[np.intp]

_NONE = np.empty(0, np.int64)


class IntervalQueries:
    """Answers one question with intervals."""

    def __init__(self, session: Session, question: Question, counters: Counters) -> None:
        self._session = session
        self._question = question
        self._planner = Planner(session, question, counters)

    def states(self, max_gap: DurationLike | None, state: str | None = None) -> Intervals:
        """Intervals in which the predicate holds, or in another state; see `Query.intervals`."""
        if state is None:
            return Intervals(self.held(max_gap))
        if state not in {"held", "not held", "unknown"}:
            raise UsageError(f"Unknown state {state!r}; choose held, not held or unknown.")
        # What was lost before the range may have changed the state at its beginning.
        everywhere = replace(self._question, bounds=None, during=None)
        lost = lost_times(self._session, everywhere)
        if state != "unknown":
            return Intervals(self.held(max_gap, lost, is_held=state == "held"))
        spans = log_spans(self._session, self._question)
        known = [*self.held(max_gap, lost), *self.held(max_gap, lost, is_held=False)]
        return Intervals((one.id, np.array([[*span, 0]], np.int64)) for one, span in spans).without(
            Intervals(known)
        )

    def held(
        self, max_gap: DurationLike | None, lost: Intervals | None = None, *, is_held: bool = True
    ) -> Iterator[tuple[str, NDArray[np.int64]]]:
        """The intervals in which the predicate holds, or does not, some at a time.

        From what is lost to the next stored message, nothing is known.
        """
        self._check("A state")
        gap = None if max_gap is None else parse_duration(max_gap)
        if gap == 0:
            raise UsageError("max_gap is 0; a state needs a gap of more than 0.")
        for part, span in self._spans():
            own = None if lost is None else lost.of_recording(part.recording.id)
            yield part.recording.id, self._states_in(part, span, gap, own, is_held=is_held)

    def changes(self, fields: Sequence[str], pause: DurationLike, tolerance: float) -> Intervals:
        """Intervals in which fields change; see `Query.changes`."""
        self._check("A change")
        if not tolerance >= 0 or tolerance == np.inf:
            raise UsageError(f"A tolerance is a number that is 0 or greater, not {tolerance}.")
        quiet = parse_duration(pause)
        paths = [field.replace("[*]", "").replace("[]", "") for field in fields]
        return Intervals(
            (part.recording.id, changing(self._steps_in(part, span, paths, tolerance), quiet))
            for part, span in self._spans()
        )

    def windows(self, before: DurationLike, after: DurationLike) -> Intervals:
        """Time around each message; see `Query.windows`."""
        if len(self._question.topics) > 1 and not self._question.returns_all:
            raise UsageError(
                "Windows around only some messages of several topics: ask for one topic, or "
                "without `limit` and `every`."
            )
        are_marks = {*self._question.topics} <= {*mark_topics(self._session)}
        if parse_duration(before) == parse_duration(after) == 0 and not are_marks:
            raise UsageError("A window needs a length: give before, after or both.")
        found = [*(self._lasting() if are_marks else self._moments())]
        known = self._session.snapshot().by_id
        # Windows that begin together are in the order of the recordings' keys.
        found.sort(key=lambda item: known[item[0]].key)
        chosen = [(name, known[name]) for name, _ in found]
        whole = {name: (0, END) if one.span is None else one.extent for name, one in chosen}
        return Intervals(found).widened(before, after).within(whole)

    def _lasting(self) -> Iterator[tuple[str, NDArray[np.int64]]]:
        """Begin and end of marks, by recording."""
        for one in marks(self._session, self._question, self._planner.counters):
            end = one.begin if one.end is None else one.end
            yield one.recording, np.array([[one.begin, end, 1]], np.int64)

    def _moments(self) -> Iterator[tuple[str, NDArray[np.int64]]]:
        """The time of each message as an interval without length, by recording."""
        if self._question.returns_all:
            found = ((p.recording.id, self._planner.times(p)) for p in self._planner.parts())
        else:
            found = (
                (run.channels[index].recording.id, run.batch.log_time[run.batch.channel == index])
                for run in self._planner.runs()
                for index in np.unique(run.batch.channel).tolist()
            )
        for recording, times in found:
            begin = placed(times)
            yield recording, np.stack([begin, begin, np.ones_like(begin)], axis=1)

    def _spans(self) -> Iterator[tuple[Part, Span]]:
        """The one part of each recording, without a time range, with each span of the question."""
        resolved = log_spans(self._session, self._question)
        # All stored messages of the topic may be lost: then nothing is known of its state.
        found = [
            (part, [span for _, span in spans])
            for summary, spans in groupby(resolved, key=itemgetter(0))
            for part in self._planner.parts_in(summary)
        ]
        # MongoDB is asked once for all.
        parts = self._planner.decided([part for part, _ in found])
        for part, (_, spans) in zip(parts, found, strict=True):
            for span in spans:
                yield part, span

    def _states_in(
        self,
        part: Part,
        span: Span,
        gap: int | None,
        lost: NDArray[np.int64] | None,
        *,
        is_held: bool,
    ) -> NDArray[np.int64]:
        # The last message before the range determines the state at its beginning.
        last = self._last_before(part, span, self._planner.outcomes)
        outcomes = self._planner.outcomes(_bounded(part, span))
        found = [(one.log_time, one.holds) for one in outcomes]
        begun = (last.log_time[-1:], last.holds[-1:]) if last else (_NONE, _NONE.astype(np.bool_))
        time, holds = (np.concatenate(column) for column in zip(begun, *found, strict=True))
        holds = holds == is_held
        if lost is not None and len(time):
            holds &= ~inside(time, lost)
            begins = lost[lost[:, 0] >= time[0], 0]
            time = np.concatenate([time, begins])
            order = np.argsort(time, kind="stable")
            time, holds = time[order], np.append(holds, np.zeros(len(begins), np.bool_))[order]
        end = part.recording.extent[1]
        return clipped(holding(time, holds, end, gap, before=len(begun[0])), span)

    def _last_before(
        self, part: Part, span: Span, ask: Callable[[Part], Iterator[RowBatch]]
    ) -> RowBatch | None:
        """The last rows before a span, if there are any; unreadable messages do not count."""
        counters = self._planner.counters
        unreadable = counters.unreadable, counters.without_arrays
        recorded = part.recording.span
        if recorded is None or span[0] <= recorded[0]:
            return None
        for begin in earlier(span[0], recorded[0]):
            last = None
            for found in ask(_bounded(part, (begin, span[0]))):
                last = found
            counters.unreadable, counters.without_arrays = unreadable
            if last is not None:
                return last
        return None

    def _steps_in(
        self, part: Part, span: Span, paths: Collection[str], tolerance: float
    ) -> NDArray[np.int64]:
        """Log times of the messages in a span that differ from the one before."""
        from hybridlog.frames.answer import columns

        ask = partial(columns, self._planner, fields=paths)
        before = self._last_before(part, span, ask)
        carried = None if before is None else before.records[-1:]
        found = [_NONE]
        for rows in ask(_bounded(part, span)):
            whole = joined([rows.records] if carried is None else [carried, rows.records])
            numbers = np.arange(len(whole))
            differs = rows_differ(whole, numbers, np.maximum(numbers - 1, 0), tolerance)
            found.append(rows.log_time[differs[len(whole) - len(rows.log_time) :]])
            carried = whole[-1:]
        return np.concatenate(found)

    def _check(self, subject: str) -> None:
        question = self._question
        if len(question.topics) != 1:
            raise UsageError(
                f"{subject} is one topic's; this question has {len(question.topics)}: name one "
                f"of {listed(question.topics)}."
            )
        if not question.returns_all or question.reverse:
            raise UsageError(
                f"{subject} uses all messages; it cannot be combined with limit, every or reverse."
            )


def _bounded(part: Part, span: Span) -> Part:
    return replace(part, windows=windows_in(None, span))


# Conditions on other topics: each becomes the log time around the messages that satisfy it.


def near_others(
    session: Session,
    question: Question,
    text: str,
    nodes: Sequence[Node],
    reach: tuple[DurationLike, DurationLike],
) -> tuple[Question, list[tuple[Question, Counters]]]:
    """The question in the times at which conditions hold, each asked in those of the last one.

    `reach` is before and after a message of another topic. Also the questions about other topics.
    """
    asked: list[tuple[Question, Counters]] = []
    everything = np.array([[0, TIME_LIMIT - 1, 0]], np.int64)
    whole = Intervals((one.id, everything) for one in session.summaries_of(question))

    def holding(node: Node, within: Question) -> Intervals:
        if isinstance(node, Not):
            return whole.without(holding(node.item, within))
        if isinstance(node, And | Or):
            join = Intervals.common if isinstance(node, And) else Intervals.union
            return reduce(join, (holding(item, within) for item in node.items))
        assert isinstance(node, Near)
        found = _question_about(session, within, node.topic, *reach)
        if checked := Predicate(node.item, text):
            check(checked, session.field_types(found.topics, found.recordings))
            found = replace(found, predicate=checked)
        counters = Counters()
        asked.append((found, counters))
        with counters.timed():
            return IntervalQueries(session, found, counters).windows(*reach).merged()

    for node in nodes:
        question = question.within(holding(node, question))
    return question, asked


def split_own(node: Node) -> tuple[list[Node], list[Node]]:
    """The conditions on the message itself, and those on other topics. All of both must hold."""
    if not any(isinstance(inner, Near) for inner in nodes(node)):
        return [node], []
    if isinstance(node, And):
        found = [split_own(item) for item in node.items]
        return [one for own, _ in found for one in own], [one for _, far in found for one in far]
    for inner in nodes(node):
        if isinstance(inner, Condition):
            raise WhereError(
                f"{inner.field.path!r} is of the message itself, and can only be joined by "
                "`and` with conditions on other topics. Name its topic to let any message near "
                "in time satisfy it."
            )
    return [], [node]


def _question_about(
    session: Session, question: Question, topic: str, before: DurationLike, after: DurationLike
) -> Question:
    """The question about another topic, in the same recordings and only where it matters.

    Wanted messages are at most `before` in front of one of the other topic, and `after` behind it.
    """
    found = session.question([topic], question.recordings)
    if question.is_unbounded or not question.is_by_log_time:
        return found
    if {*found.topics} <= {*mark_topics(session)}:
        return found  # marks may last
    spans = log_spans(session, question)
    rows = ((one.id, np.array([[begin, end, 0]], np.int64)) for one, (begin, end) in spans)
    near = Intervals(rows).widened(after, before).merged()
    return replace(found, during=near)


# Comparison of messages: numbers by value, strings by bytes, lists by length and elements.


def rows_differ(
    column: pa.Array[Any], one: Places, other: Places, tolerance: float = 0.0
) -> NDArray[np.bool_]:
    """True where rows of a column, possibly nested, differ from other rows of it.

    NaN equals NaN, -0 equals 0, and null equals only null; numbers are equal if they differ by at
    most the tolerance. Lists of different lengths differ.
    """
    kind = column.type
    if isinstance(kind, pa.BaseExtensionType):  # JSON text
        return rows_differ(column.storage, one, other)
    if pa.types.is_null(kind):
        return np.zeros(len(one), np.bool_)
    valid: NDArray[np.bool_] = np.asarray(column.is_valid(), np.bool_)
    differs: NDArray[np.bool_] = valid[one] != valid[other]
    there = valid[one] & valid[other]
    if pa.types.is_struct(kind):
        for inner in column.flatten():
            differs |= there & rows_differ(inner, one, other, tolerance)
        return differs
    if is_list(kind):
        rows = np.flatnonzero(there)
        differs[rows] = _lists(column, one[rows], other[rows], tolerance)
        return differs
    differs |= there & _values(column, one, other, tolerance)
    return differs


def _values(
    column: pa.Array[Any], one: Places, other: Places, tolerance: float
) -> NDArray[np.bool_]:
    kind = column.type
    if not (pa.types.is_primitive(kind) and not pa.types.is_decimal(kind)):
        codes = pc.fill_null(column.dictionary_encode().indices, -1)
        values = codes.to_numpy(zero_copy_only=False)
    else:
        if pa.types.is_temporal(kind):
            column = column.view(pa.int64())
        values = pc.fill_null(column, False if pa.types.is_boolean(kind) else 0).to_numpy(
            zero_copy_only=False
        )
    left, right = values[one], values[other]
    same = left == right
    if left.dtype.kind == "f":
        same |= np.isnan(left) & np.isnan(right)
    if tolerance and left.dtype.kind in "iuf" and pa.types.is_primitive(kind):
        with np.errstate(invalid="ignore"):  # inf - inf is NaN, which is not near
            same |= np.abs(left.astype(np.float64) - right.astype(np.float64)) <= tolerance
    differs: NDArray[np.bool_] = ~same
    return differs


def _lists(
    column: pa.Array[Any], one: Places, other: Places, tolerance: float
) -> NDArray[np.bool_]:
    length = lengths_of(column)
    if pa.types.is_fixed_size_list(column.type):
        start = (column.offset + np.arange(len(column))) * column.type.list_size
    else:
        start = column.offsets.to_numpy()[:-1].astype(np.int64)
    elements = column.values
    count = length[one]
    found: NDArray[np.bool_] = count != length[other]
    alike = np.flatnonzero(~found & (count > 0))
    if len(alike):
        count = count[alike]
        differs = rows_differ(
            elements,
            ranges(start[one[alike]], count),
            ranges(start[other[alike]], count),
            tolerance,
        )
        found[alike] = np.logical_or.reduceat(differs, np.cumsum(count) - count)
    return found
