"""The question that a user holds: built step by step, answered on access.

```python
scans = store.topic("scan").between("+10s", "+11s").where("ranges.min < 0.5")
for message in scans: ...
frame = scans.to_pandas()
```

Each step returns a new query; nothing is read before the answer is accessed. `counters`
then has the cost of the answer.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from msgspec.structs import asdict, replace

from hybridlog.query.choice import Choice, choose
from hybridlog.query.planner import Planner
from hybridlog.query.question import Clock, Counters, Question, RecordedChannel, Span, windows_in
from hybridlog.query.times import DurationLike, TimeLike, parse_duration, parse_time
from hybridlog.wording import Rows, listed, meant
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    PayloadError,
    TopicError,
    UsageError,
)
from hybridlog_storage.times import span_of

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.across.align import Aligned
    from hybridlog.message import Message
    from hybridlog.query.answers.completeness import Completeness
    from hybridlog.query.answers.follow import Following
    from hybridlog.query.answers.interval_queries import IntervalQueries
    from hybridlog.query.answers.statistics import FieldStatistics, TopicCheck
    from hybridlog.query.intervals import Intervals
    from hybridlog.query.predicate.tree import Predicate
    from hybridlog.session import Asked
    from hybridlog_storage.messages import Batch

_MAX_STEP = 2**62  # longer than any topic, and an int64


class Query:
    """A question about some topics of an open store. Immutable: each step returns a new one.

    Args:
        source: The open store, or one moment of it.
        question: The question.

    Attributes:
        question: The question, as a value that can be compared, hashed and pickled.
        counters: The cost of the last answer.
        conditions: Queries about other topics, whose answers are in the question.
    """

    def __init__(
        self,
        source: Asked,
        question: Question,
        counters: Counters | None = None,
        conditions: tuple[Query, ...] = (),
    ) -> None:
        self.question = question
        self.counters = Counters() if counters is None else counters
        self.conditions = conditions
        self.source = source

    def __eq__(self, other: object) -> bool:
        """True if both are the same question to the same open store."""
        if not isinstance(other, Query):
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
        return tuple(one.id for one in self.source.now().summaries_of(self.question))

    def __copy__(self) -> Query:
        """The same question with separate counters."""
        return Query(self.source, self.question, conditions=self.conditions)

    def __repr__(self) -> str:
        question = self.question
        try:
            known = self.source.now().summaries_of(question)
            those = f"recording {known[0].name}" if len(known) == 1 else f"{len(known)} recordings"
        except HybridlogError as error:
            those = str(error)
        words = [listed(self.topics, 3), those]
        if question.bounds is not None:
            words.append("between {} and {}".format(*question.bounds))
        if question.predicate is not None:
            words.append(f"where {question.predicate.text[:200]}")
        return f"<Query {'; '.join(words)}>"

    # Steps.

    def between(self, begin: TimeLike | None, end: TimeLike | None = None) -> Query:
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

    def clock(self, clock: str) -> Query:
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
    ) -> Query:
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
        checked = self.source.now().predicate(predicate, self.topics, self.question.recordings)
        if checked.is_across:
            return self._near(checked, within)
        if within is not None:
            raise UsageError(
                "`within` is for conditions on other topics: where('/odom: twist.twist.linear.x > "
                "0.5', within='0.1s'). A second predicate is a second where()."
            )
        return self._satisfying(checked)

    def _near(
        self, predicate: Predicate, within: DurationLike | tuple[DurationLike, DurationLike] | None
    ) -> Query:
        """Only messages near others, and those that satisfy the rest of a predicate."""
        from hybridlog.query.answers.interval_queries import near_others, split_own
        from hybridlog.query.predicate.tree import And

        if within is None:
            raise UsageError(
                "A condition on another topic needs a time within which its message is, such as "
                "0.1s."
            )
        if not isinstance(within, tuple):  # the message that is exactly so far away belongs to it
            within = within, f"{parse_duration(within) + 1}ns"
        own, others = split_own(predicate.root)
        query = self._satisfying(replace(predicate, root=And(tuple(own))))
        session, text = self.source.now(), predicate.text
        question, asked = near_others(session, query.question, text, others, within)
        conditions = (Query(self.source, *one) for one in asked)
        return Query(self.source, question, conditions=(*self.conditions, *conditions))

    def _satisfying(self, predicate: Predicate) -> Query:
        known = self.question.predicate
        return self._with(predicate=(predicate if known is None else known & predicate) or None)

    def limit(self, count: int) -> Query:
        """At most this many messages.

        Raises:
            UsageError: a negative number.
        """
        if type(count) is not int or count < 0:
            raise UsageError(f"A limit is a whole number and not negative; {count!r} is not.")
        return self._with(limit=count)

    def every(self, step: int) -> Query:
        """Only every n-th message of each topic, beginning with the first.

        Raises:
            UsageError: less than one.
        """
        if type(step) is not int or step < 1:
            raise UsageError(f"every(n) needs a number n of at least 1, not {step!r}.")
        return self._with(every=min(step, _MAX_STEP))

    def reverse(self) -> Query:
        """Latest message first."""
        return self._with(reverse=not self.question.reverse)

    def fields(self, *paths: str) -> Query:
        """Only these fields in tables (`header.stamp`, `pose.position`, `ranges.min`).

        `publish_time`, `stamp` (of the header), `seq` (arrival number), `sequence` (the
        sender's), `topic` and `recording` are also columns, unless a field has that name.

        Raises:
            TopicError: no topic of the query has such a field.
        """
        from hybridlog.frames.names import is_own

        if not all(isinstance(path, str) for path in paths):
            raise UsageError('Fields are names: fields("header.stamp", "ranges.min").')
        known = field_types(self)
        for path in paths:
            if known and not (_is_field(path, known) or is_own(path)):
                raise TopicError(_no_field(path, known, self.topics))
        return self._with(fields=tuple(paths))

    def in_frame(self, frame: str, *, tf_topics: Sequence[str] = ()) -> Query:
        """Points and poses in tables and arrays in another frame, at the times of their headers.

        By the rules of tf2. A message without a transform keeps its row, without a place;
        `remarks` says why. Scans and clouds become lists of the fields of their points.

        Args:
            frame: Its name.
            tf_topics: Topics with transforms; empty for `tf` and `tf_static` of the topic's
                innermost namespace that has them, and for frames that these lack, of the root.
        """
        topics = self.source.now().resolve_in(tf_topics, self.question.recordings)
        return self._with(frame=frame, tf_topics=tuple(topics))

    def in_recording(self, *names: str) -> Query:
        """Only these recordings, by name, id or glob; `Store.recordings` chooses by more.

        Raises:
            TopicError: no such recording exists, or none has the topic.
        """
        summaries, problem = choose(self.source.now(), Choice.of(names))
        if problem:
            raise TopicError(problem)
        ids = [summary.id for summary in summaries]
        return self._with(recordings=self.source.now().about(self.topics, ids).recordings)

    def during(self, intervals: Intervals) -> Query:
        """Only messages whose log time is in one of some intervals of their recording.

        A message in several intervals is returned once. After two calls, both must hold.

        Args:
            intervals: From `intervals`, `changes` or `windows` of any query of this store,
                or made by hand; recordings are given by id or by name.

        Raises:
            TopicError: an interval is of a recording that is not in the store.
        """
        session = self.source.now()
        ids = {name: session.named([name])[0].id for name in intervals.recordings}
        intervals = intervals.by_id(ids)
        return Query(self.source, self.question.within(intervals), conditions=self.conditions)

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

    # Messages.

    def __iter__(self) -> Iterator[Message]:
        """The messages as they came, ordered by log time, recording and arrival.

        Raises:
            UsageError: it has `in_frame`, which is for tables and arrays.
        """
        self._as_they_came("Loops and `at`")
        from hybridlog.message import messages_in
        from hybridlog.query.answers.current import picture_of

        planner = self._planner()
        picture = picture_of(planner.session)
        for run in planner.runs():
            yield from messages_in(run, picture)

    def follow(self, *names: str) -> Following:
        """The messages that running recordings flush from now on, until all of them have ended.

        With `between`, also those that are flushed already. Each comes once; those that are
        flushed together are in order of log time. MongoDB is not needed.

        Args:
            names: The topics as they were written: globs take topics that appear later.

        Raises:
            UsageError: No recording of the question is running, or it has `reverse`, `during`
                or a filter that MongoDB answers.
        """
        from hybridlog.query.answers.follow import Following

        self.counters.reset()
        return Following(self.source, self.question, self.counters, names)

    def at(self, moment: TimeLike) -> Message:
        """The message that was current at a time: the last one not after it.

        Its arrays are read-only: copy to change them.

        Raises:
            TopicError: no such message exists.
            UsageError: the question has a time range, `in_frame`, or another clock than log
                time.
        """
        self._as_they_came("Loops and `at`")
        return _message_at(self, moment)

    def batches(self) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
        """The messages in order, many at once; `batch.channel` indexes the channels.

        Messages without payload are left out; `counters.reduced` counts them.
        """
        from hybridlog.query.chunk_scan import with_payloads

        for run in self._planner().runs():
            whole = with_payloads(run, self.counters)
            if len(whole.batch):
                yield whole.batch, run.channels

    def latched(
        self, *, original_times: bool = False
    ) -> Iterator[tuple[Batch, Sequence[RecordedChannel]]]:
        """Latched messages from before the time range that are in force when it begins.

        They are those that a subscriber receives which joins at that time, and the frames of
        video topics from the last key frame on. Their log time is the beginning of the range.
        Take them before `batches`, and with separate counters.
        """
        from hybridlog.query.answers.current import in_force

        self.counters.reset()
        return in_force(
            self.source.now(), self.question, self.counters, original_times=original_times
        )

    def count(self) -> int:
        """Number of messages."""
        with self.counters.timed():
            found = Planner(self.source.now(), self.question, self.counters).count()
            self.counters.messages = found
        return found

    def to_numpy(self) -> NDArray[Any] | list[NDArray[Any]]:
        """Every message as an array (`Message.to_numpy`): stacked if all are alike.

        Messages that cannot be arrays are left out; `counters.unreadable` counts them. Points
        with `in_frame` have `x`, `y` and `z` as float64, NaN without a transform, before their
        other fields.

        Raises:
            PayloadError: None of the messages can be an array.
            DefinitionError: The first of them has no definition.
        """
        if self.question.frame is not None:
            from hybridlog.tf.in_frame import points_of

            self.counters.reset()
            found = points_of(self.source.now(), self.question, self.counters)
            return _stacked([one.points for one in found])
        arrays: list[NDArray[Any]] = []
        refused: PayloadError | DefinitionError | None = None
        for message in of_now(self):
            try:
                arrays.append(message.to_numpy())
            except (PayloadError, DefinitionError) as error:
                refused = refused or error
                self.counters.unreadable += 1
        if refused is not None and not arrays:
            raise refused
        return _stacked(arrays)

    # Tables.

    def to_arrow(self) -> pa.Table:
        """A table: scalars and strings as columns, arrays as lists, first column log time."""
        import pyarrow as pa

        from hybridlog.frames.answer import to_arrow

        if self.question.frame is not None:
            return pa.concat_tables(tables_of(self), promote_options="permissive")
        return to_arrow(self._planner())

    def to_polars(self) -> Any:
        """A polars frame of the same columns, `log_time` among them.

        Raises:
            MissingDependencyError: polars is not installed.
        """
        from hybridlog.frames.frame import to_polars

        return to_polars(self.to_arrow())

    def to_pandas(self) -> pd.DataFrame:
        """A frame of the same columns, indexed by log time (UTC, ns)."""
        from hybridlog.frames.frame import frame_of

        frame = frame_of(self.to_arrow())
        frame.attrs["hybridlog"] = asdict(self.counters)
        return frame

    def resample(
        self,
        step: DurationLike,
        how: str = "asof",
        tolerance: DurationLike | None = None,
    ) -> Aligned:
        """The topics at regular log times: every `step` from the beginning of each recording.

        With `between` or `during`, from the beginning of the range. Columns are those of
        `Store.align`; those of a single topic have no prefix.

        Args:
            step: Time between two rows, a duration.
            how: `asof`, `nearest` or `interpolate`, as for `Store.align`.
            tolerance: Greatest distance in time; None for any.

        Raises:
            UsageError: an unknown way, a step of 0, another clock than the log's, or limit,
                every or reverse.
            TimeError: no duration, or a range outside of all recordings.
        """
        from hybridlog.across.align import resampled

        return resampled(self.source.now(), self.question, step, how, tolerance)

    def check(self) -> list[TopicCheck]:
        """Check how regularly the topics came: rate, jitter, gap, late start, early stop, losses.

        Returns:
            One for each recording and topic, also for topics without messages; those that were
            silent for most of their usual periods first, then those that have lost most.

        Raises:
            UsageError: `limit`, `every`, `reverse`, or another clock than the log's.
            TimeError: a range outside of all recordings.
        """
        from hybridlog.query.answers.statistics import check

        with self.counters.timed():
            return Rows(check(self.source.now(), self.question, self.counters))

    def stats(self, *fields: str) -> list[FieldStatistics]:
        """Statistics of the numeric fields: count, NaN, infinite, least, greatest, mean, deviation.

        Args:
            fields: Paths; also summaries (`ranges.min`), and arrays, for all their elements.
                None for every field that is a number.

        Raises:
            TopicError: no such field exists.
            UsageError: `limit`, `every`, `reverse`, or no field is a number.
            TimeError: a range outside of all recordings.
        """
        from hybridlog.query.answers.statistics import statistics

        self._as_they_came("Statistics")
        now = of_now(self)
        query = now.fields(*fields) if fields else now
        with self.counters.timed():
            return Rows(statistics(now.source.now(), query.question, self.counters))

    # Intervals.

    def intervals(self, max_gap: DurationLike | None = None, state: str | None = None) -> Intervals:
        """The longest intervals in which the predicate of `where` holds.

        At any time, the last message of the topic (by log time, then arrival) determines the
        state. Before the first message the state is unknown, and no interval covers it.
        A state lasts until the next message, or the end of the recording. The range of
        `between` cuts intervals; the message before it determines the state at its start.
        Without `where`, any message holds: `max_gap` then finds when the topic was active.

        Args:
            max_gap: Longest time for which a message is valid; by default, until the next one.
            state: `held`, `not held` or `unknown`: three parts of the asked time, without
                each other. Unknown is the time before the first message, after `max_gap`, and
                from a loss to the next stored message. Without, what the stored messages say.

        Returns:
            Intervals; their `messages` are those of this state, none where it is unknown.

        Raises:
            UsageError: several topics, `limit`, `every`, `reverse`, another clock than the
                log's, or an unknown state.
            TimeError: no duration, or a range outside of all recordings.
        """
        with self.counters.timed():
            return self._intervals().states(max_gap, state)

    def changes(
        self, *fields: str, pause: DurationLike = "1s", tolerance: float = 0.0
    ) -> Intervals:
        """Changes of fields: runs of messages that differ from the one before them.

        Steps are found among the messages of one recording that satisfy `where`. A step is a
        message with any of the fields different from the message before it. Steps at most
        `pause` apart belong to one change, whatever messages are between them. A change begins
        at the log time of its first step, and ends 1 ns after that of its last one.

        Args:
            fields: Paths (`position`, `position.x`); arrays are compared element by element.
            pause: Longest time between steps of one change.
            tolerance: Numbers are equal if they differ by at most this.

        Returns:
            Intervals; their `messages` are the steps.

        Raises:
            TopicError: no such field exists.
            UsageError: no field, several topics, `limit`, `every`, `reverse`, or another
                clock than the log's.
            TimeError: no duration, or a range outside of all recordings.
        """
        if not fields:
            raise UsageError("Name at least one field; `hybridlog info -t TOPIC` lists them.")
        self._as_they_came("Changes")
        self.fields(*fields)  # refuses unknown fields
        with self.counters.timed():
            return self._intervals().changes(fields, pause, tolerance)

    def gaps(
        self, longer_than: DurationLike | None = None, periods: float | None = None
    ) -> Intervals:
        """Times without messages of a topic, in its recordings.

        A gap lasts from one message to the next, from the beginning of the recording (or of
        the range) to the first message, or from the last message to the end. The usual period
        is the 0.9 quantile of the times from one message to the next in the recording.

        Args:
            longer_than: Only gaps longer than this, a duration.
            periods: Only gaps longer than so many usual periods; without both, 5.

        Returns:
            Intervals; their `messages` are 0.

        Raises:
            UsageError: several topics, `limit`, `every`, `reverse`, another clock than the
                log's, or no number of periods.
            TimeError: no duration, or a range outside of all recordings.
        """
        from hybridlog.query.answers.statistics import gaps

        with self.counters.timed():
            return gaps(self.source.now(), self.question, self.counters, longer_than, periods)

    # What an answer lacks.

    def completeness(self) -> Completeness:
        """Completeness of the last answer, or, without one, of an answer given now.

        Losses of topics in conditions count as an unknown number.
        """
        from hybridlog.query.answers.completeness import completeness_of

        session, others = self.source.now(), [(q.question, q.counters) for q in self.conditions]
        return completeness_of(session, self.question, self.counters, *others)

    def _intervals(self) -> IntervalQueries:
        from hybridlog.query.answers.interval_queries import IntervalQueries

        return IntervalQueries(self.source.now(), self.question, self.counters)

    def _with(self, **changes: Any) -> Query:
        return Query(self.source, replace(self.question, **changes), conditions=self.conditions)

    def _as_they_came(self, what: str) -> None:
        """Refuse `in_frame` for answers that it would not change."""
        if self.question.frame is not None:
            raise UsageError(f"{what} are of messages as they came: leave out in_frame.")

    def _planner(self) -> Planner:
        """A planner for an answer, of a moment that begins now."""
        self.counters.reset()
        return Planner(self.source.now(), self.question, self.counters)


def of_now(query: Query) -> Query:
    """The same question with the same counters, at the moment that begins now."""
    return Query(query.source.now(), query.question, query.counters, query.conditions)


def narrowed(query: Query, *topics: str) -> Query:
    """The same question about one or some of its topics, by their full names.

    If the question is about several recordings, tables of each topic name them.
    """
    session, question = query.source.now(), query.question
    several = question.names_recording or len(session.summaries_of(question)) > 1
    about = session.about(topics, question.recordings)
    question = replace(
        question, topics=topics, recordings=about.recordings, names_recording=several
    )
    return Query(query.source, question, conditions=query.conditions)


def at_time(query: Query, moment: TimeLike) -> Query:
    """The question about the message of `Query.at` alone.

    What is lost between the message and the moment may have been the current one: that is a
    condition of it.
    """
    now = of_now(query)
    found = _message_at(now, moment)
    time = found.log_time_ns
    only: dict[str, Any] = {"recordings": (found.recording,), "bounds": span_of(time, time)}
    only |= {"clock": "log", "reverse": True, "limit": 1, "every": 1}
    question = replace(query.question, **only)
    start, end = now.source.now().snapshot().by_id[found.recording].extent
    latest = max(parse_time(moment, start=start, end=end), time)
    since = Query(query.source, replace(question, bounds=(time, latest + 1)))
    return Query(query.source, question, conditions=(*query.conditions, since))


def _message_at(query: Query, moment: TimeLike) -> Message:
    if not query.question.is_unbounded or query.question.clock != "log":
        raise UsageError(
            "A message at a time is the last one by log time; `between`, `during` and "
            "`clock` cannot be combined with it."
        )
    from hybridlog.query.answers.current import message_at

    with query.counters.timed():
        found = message_at(query.source.now(), query.question, query.counters, moment)
    if found is None:
        raise TopicError(f"No message of {', '.join(query.topics)} is at or before {moment}.")
    return found


def tables_of(query: Query) -> Iterator[pa.Table]:
    """The answer in order, in Arrow tables of bounded size; at least one, possibly empty."""
    from hybridlog.frames.answer import stream
    from hybridlog.tf.in_frame import stream_in_frame

    query.counters.reset()
    planner = Planner(query.source.now(), query.question, query.counters)
    return (stream if planner.question.frame is None else stream_in_frame)(planner)


def channels_of(query: Query) -> list[RecordedChannel]:
    """Every channel of a question."""
    return Planner(query.source.now(), query.question, query.counters).channels()


def field_types(query: Query) -> dict[str, str] | None:
    """Paths that can be queried and their types; None when a topic has no fixed fields."""
    return query.source.now().field_types(query.topics, query.question.recordings)


def spans_of(query: Query) -> dict[str, Span]:
    """Log time `[begin, end)` of the messages of each recording, ns; by id, oldest first.

    It is known without reading messages: those at its ends may not satisfy the predicate,
    or a range of another clock.
    """
    found: dict[str, Span] = {}
    for part in Planner(query.source.now(), query.question).split():
        cut = windows_in(part.windows, part.span)
        if len(cut):
            extent = int(cut[0, 0]), int(cut[-1, 1])
            low, high = found.get(part.recording.id, extent)
            found[part.recording.id] = min(low, extent[0]), max(high, extent[1])
    return found


def _is_field(path: str, known: Mapping[str, str]) -> bool:
    from hybridlog.frames.names import is_summary

    if is_summary(path, known):
        return True
    return any(p == path or p.startswith((f"{path}.", f"{path}[")) for p in known)


def _no_field(path: str, known: Mapping[str, str], topics: Sequence[str]) -> str:
    if re.search(r"\[[0-9:]", path):
        return f"{path!r} is a part of an array, and no column: take the array, or ask in SQL."
    return (
        f"There is no field {path!r} on {', '.join(topics)}; {meant(path, known)} "
        "`hybridlog info -t TOPIC` lists them all."
    )


def _stacked(arrays: list[NDArray[Any]]) -> NDArray[Any] | list[NDArray[Any]]:
    alike = {(a.shape, a.dtype) for a in arrays}
    return np.stack(arrays) if len(alike) == 1 else arrays or np.empty(0)
