"""The steps that choose what a question asks, and what is known without reading messages."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self, TypeVar, cast

from hybridlog.query.choice import Choice
from hybridlog.query.counters import Counters
from hybridlog.query.planner import Planner
from hybridlog.query.question import Clock, Question
from hybridlog.query.times import parse_duration, parse_time
from hybridlog.wording import listed
from hybridlog_storage.errors import (
    TopicError,
    UsageError,
)

if TYPE_CHECKING:
    from hybridlog.query.answers.interval_queries import IntervalQueries
    from hybridlog.query.choice import During, Tags, Texts
    from hybridlog.query.intervals import Intervals
    from hybridlog.query.times import DurationLike, TimeLike
    from hybridlog.session import Asked, Session
    from hybridlog_storage.summary import RecordingSummary

_Query = TypeVar("_Query", bound="Steps")
_MAX_STEP = 2**62  # longer than any topic, and an int64


class Steps:
    """Chooses what a question asks: each step returns a new one.

    Args:
        source: The open store, or one moment of it.
        question: The question.

    Attributes:
        question: The question, as a value that can be compared, hashed and pickled.
        counters: The cost of the last answer.
        conditions: Queries about other topics, whose answers are in the question.
    """

    def __init__(
        self, source: Asked, question: Question, conditions: tuple[Steps, ...] = ()
    ) -> None:
        self.question = question
        self.counters = Counters()
        self.conditions = conditions
        self.source = source

    @property
    def session(self) -> Session:
        """The store at the moment that an answer is about: now, or that of a snapshot.

        Raises:
            UsageError: It was opened before this process was forked.
        """
        return self.source.now()

    def __eq__(self, other: object) -> bool:
        """True if both are the same question to the same open store."""
        if not isinstance(other, Steps):
            return NotImplemented
        return self.source is other.source and self.question == other.question

    def __hash__(self) -> int:
        """Hash of the question."""
        return hash((id(self.source), self.question))

    @property
    def topics(self) -> tuple[str, ...]:
        """Full names of the topics."""
        return self.question.topics

    @property
    def recordings(self) -> tuple[str, ...]:
        """Ids of the recordings, oldest first."""
        return tuple(summary.id for summary in self.summaries())

    def __copy__(self) -> Self:
        """The same question with separate counters."""
        return type(self)(self.source, self.question, self.conditions)

    def between(self, begin: TimeLike | None, end: TimeLike | None = None) -> Self:
        """Only messages with `begin <= time < end`.

        Args:
            begin: An int is nanoseconds since the epoch, a float seconds; text is ISO 8601,
                or relative to each recording (`+5s`, `-10s`); None for its start.
            end: The same; None for its end.
        """
        # As ints, so that equal questions are equal values: 5 is nanoseconds, 5.0 seconds.
        bounds = (
            parse_time(time, start=None, end=None) if isinstance(time, float) else time
            for time in (begin, end)
        )
        return self._with(bounds=tuple(bounds))

    def clock(self, clock: str) -> Self:
        """The time that `between` refers to: `log` (default), `publish` or `header`.

        Raises:
            UsageError: an unknown clock.
        """
        if clock not in {"log", "publish", "header"}:
            raise UsageError(f"Unknown clock {clock!r}; choose log, publish or header.")
        return self._with(clock=cast(Clock, clock))

    def where(
        self,
        predicate: str | Mapping[str, object],
        within: DurationLike | tuple[DurationLike, DurationLike] | None = None,
    ) -> Self:
        """Only messages that satisfy a predicate; several are joined by *and*.

        Args:
            predicate: `"ranges.min < 0.5 and header.frame_id == 'laser'"`, or a MongoDB
                filter, as a mapping or JSON, for MongoDB to answer from its index.
                `"/odom: twist.twist.linear.x > 0.5"` asks for a message of another topic, near
                in log time, in the same recording. Such conditions are answered now, and
                joined by `and`, `or`, `not` and brackets.
            within: Greatest distance in time of these messages, either way; or how long
                before and after such a message: `t - before <= time < t + after`.

        Raises:
            WhereError: it cannot be parsed, does not fit the fields, or is not allowed.
            UsageError: `within` lacks for other topics, or there are none for it.
            TopicError: no such topic exists.
            TimeError: `within` is no duration.
        """
        if isinstance(predicate, str):
            if ":" in predicate:
                from hybridlog.query.predicate.across import names_topics

                if names_topics(predicate):
                    return self._near(predicate, within)
            checked = self.session.predicate(predicate, self.topics, self.question.recordings)
        else:
            from hybridlog.query.predicate.mongo_filter import mongo_filter

            types = self.session.field_types(self.topics, self.question.recordings)
            checked = mongo_filter(predicate, types)
        if within is not None:
            raise UsageError(
                "`within` is for conditions on other topics: where('/odom: twist.twist.linear.x > "
                "0.5', within='0.1s'). A second predicate is a second where()."
            )
        if self.question.predicate is not None:
            checked = self.question.predicate & checked
        return self._with(predicate=checked or None)

    def _near(
        self, text: str, within: DurationLike | tuple[DurationLike, DurationLike] | None
    ) -> Self:
        """The query with the conditions on other topics as intervals."""
        from hybridlog.query.near import everything, intervals_of, question_about, split_own
        from hybridlog.query.predicate.across import Near, parse_across

        if within is None:
            raise UsageError(
                "A condition on another topic needs a time within which its message is, such as "
                "0.1s."
            )
        if isinstance(within, tuple):
            before, after = within
        else:
            # The message that is exactly so far away belongs to it.
            before, after = within, f"{parse_duration(within) + 1}ns"
        own, others = split_own(parse_across(text))
        query = now = of_now(self)
        for predicate in own:
            query = query.where(predicate)
        conditions: list[Self] = []

        def windows(condition: Near) -> Intervals:
            question = question_about(now.session, query.question, condition.topic, before, after)
            events = type(self)(now.source, question)
            if condition.predicate:
                events = events.where(condition.predicate)
            conditions.append(events)
            return events.windows(before, after)

        whole = everything(now.session, self.question)
        for condition in others:
            query = query.during(intervals_of(condition, windows, whole))
        return type(self)(self.source, query.question, (*self.conditions, *conditions))

    def limit(self, count: int) -> Self:
        """At most this many messages.

        Raises:
            UsageError: a negative number.
        """
        if not isinstance(count, int) or count < 0:
            raise UsageError(f"A limit is a whole number and not negative; {count!r} is not.")
        return self._with(limit=count)

    def every(self, step: int) -> Self:
        """Only every n-th message of each topic, beginning with the first.

        Raises:
            UsageError: less than one.
        """
        if not isinstance(step, int) or step < 1:
            raise UsageError(f"every(n) needs a number n of at least 1, not {step!r}.")
        return self._with(every=min(step, _MAX_STEP))

    def reverse(self) -> Self:
        """Latest message first."""
        return self._with(reverse=not self.question.reverse)

    def fields(self, *paths: str) -> Self:
        """Only these fields in tables (`header.stamp`, `pose.position`, `ranges.min`).

        `publish_time`, `stamp` (of the header), `seq` (arrival number), `sequence` (the
        sender's), `topic` and `recording` are also columns, unless a field has that name.

        Raises:
            TopicError: no topic of the query has such a field.
        """
        from hybridlog.frames.names import is_own

        if not all(isinstance(path, str) for path in paths):
            raise UsageError('Fields are names: fields("header.stamp", "ranges.min").')
        known = self.session.field_types(self.topics, self.question.recordings)
        for path in paths:
            if known and not (_is_field(path, known) or is_own(path)):
                raise TopicError(_no_field(path, known, self.topics))
        return self._with(fields=tuple(paths))

    def in_frame(self, frame: str) -> Self:
        """Points and poses in tables and arrays in another frame, at the times of their headers.

        By the rules of tf2. A message without a transform keeps its row, without a place;
        `remarks` says why. Scans and clouds become lists of the fields of their points.

        Args:
            frame: Its name.
        """
        return self._with(frame=frame)

    def tags(self, *keys: str) -> Self:
        """Tags of the recordings as columns of tables, behind `topic` and `recording`.

        A field with the name of such a column gets a trailing underscore. A recording without
        the tag has null.

        Raises:
            TopicError: no recording of the query has such a tag.
        """
        session = self.session
        places = session.chosen(self.question).tolist()
        snapshot = session.snapshot()
        known = {key for place in places for key in snapshot.summaries[place].tags}
        for key in keys:
            if key not in known:
                raise TopicError(
                    f"No recording of this query has a tag {key!r}. The tags are: "
                    f"{listed(sorted(known))}."
                )
        return self._with(tags=tuple(dict.fromkeys(keys)))

    def in_recording(
        self,
        *names: str,
        tag: Tags = None,
        has: Texts = None,
        type: Texts = None,  # noqa: A002 - the word of the command line
        during: During = None,
        where: Texts = None,
        older_than: DurationLike | None = None,
    ) -> Self:
        """Only these recordings: by name, id or glob, and as `Store.recordings`.

        Raises:
            TopicError: no such recording exists, or none has the topic.
        """
        from hybridlog.query.choosing import choose

        choice = Choice.of(
            names,
            tag=tag,
            has=has,
            type=type,
            during=during,
            where=where,
            older_than=older_than,
        )
        chosen = choose(self.session, choice)
        if chosen.problem:
            raise TopicError(chosen.problem)
        return self._on(self.topics, [summary.id for summary in chosen.summaries])

    def during(self, intervals: Intervals) -> Self:
        """Only messages whose log time is in one of some intervals of their recording.

        A message in several intervals is returned once. After two calls, both must hold.

        Args:
            intervals: From `intervals`, `changes` or `windows` of any query of this store,
                or made by hand; recordings are given by id or by name.

        Raises:
            TopicError: an interval is of a recording that is not in the store.
        """
        intervals = intervals.by_id(self.session.snapshot().ids_called())
        if self.question.during is not None:
            intervals = self.question.during.common(intervals)
        return self._with(during=intervals.merged())

    def windows(self, before: DurationLike = 0, after: DurationLike = 0) -> Intervals:
        """Time around each message: `t - before <= time < t + after`, within its recording.

        A mark with an end counts from its beginning to its end.

        One window per message: windows may overlap; `during` and `merged` join them.

        Args:
            before: Time before the message, a duration.
            after: Time after the message, a duration.

        Raises:
            TimeError: `before` or `after` is no duration.
            UsageError: both are zero, or `limit` or `every` of several topics.
        """
        with self.counters.timed():
            return self._intervals().windows(before, after)

    def summaries(self) -> list[RecordingSummary]:
        """The recordings in short, oldest first; some may have no message in the answer."""
        session = self.session
        places = session.chosen(self.question).tolist()
        return [session.snapshot().summaries[place] for place in places]

    def _intervals(self) -> IntervalQueries:
        from hybridlog.query.answers.interval_queries import IntervalQueries

        return IntervalQueries(self.session, self.question, self.counters)

    def _with(self, **changes: Any) -> Self:
        return type(self)(self.source, replace(self.question, **changes), self.conditions)

    def _on(self, topics: Sequence[str], recordings: Sequence[str] | None) -> Self:
        """The same conditions on other topics and recordings."""
        session = self.session
        topics, chosen = session.having(topics, recordings)
        others = self.question.namesakes
        if others and recordings is not None:
            there = {*session.topics_of(recordings)}
            others = tuple(topic for topic in others if topic in there)
        return self._with(topics=topics, recordings=chosen, namesakes=others)

    def _as_they_came(self, what: str) -> None:
        """Refuse `in_frame` for answers that it would not change."""
        if self.question.frame is not None:
            raise UsageError(f"{what} are of messages as they came: leave out in_frame.")

    def _planner(self) -> Planner:
        """A planner for an answer, of a moment that begins now."""
        self.counters.reset()
        return Planner(self.session, self.question, self.counters)


def of_now(query: _Query) -> _Query:
    """The same question with the same counters, at the moment that begins now."""
    found = type(query)(query.session, query.question, query.conditions)
    found.counters = query.counters
    return found


def _is_field(path: str, known: Mapping[str, str]) -> bool:
    from hybridlog.frames.names import is_summary

    if is_summary(path, known):
        return True
    return any(p == path or p.startswith((f"{path}.", f"{path}[")) for p in known)


def _no_field(path: str, known: Mapping[str, str], topics: Sequence[str]) -> str:
    if re.search(r"\[[0-9:]", path):
        return f"{path!r} is a part of an array, and no column: take the array, or ask in SQL."
    near = difflib.get_close_matches(path, known, n=5, cutoff=0.4) or sorted(known)[:10]
    return (
        f"There is no field {path!r} on {', '.join(topics)}. Did you mean {', '.join(near)}? "
        "`hybridlog info -t TOPIC` lists them all."
    )
